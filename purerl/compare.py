"""Compares runs: `python -m purerl.compare RUN RUN ... [--metric eval/episode_return] [--out DIR]`.

Runs of one configuration and seed: the same to the last bit, or the update and the leaf where they
part. Runs of several seeds: interquartile means with 95% bootstrap intervals, the probability that
one configuration beats another, differences on the same seeds, learning curves.

Exit codes: 0 compared; 1 two runs that promise the same bits have not; 2 a mistake in the command.
"""

import csv
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from purerl.core.errors import FAILURE, UserError, leave, tell


@dataclass(frozen=True)
class Options:
    """Compares runs: bit by bit where configuration and seed agree, else by statistics over seeds.

    Ten seeds of this against ten of that: python -m purerl.compare 'runs/ant/a*' 'runs/ant/b*'
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Runs, folders of runs (runs/ant_run), or patterns ('runs/ant_run/wide*'). The group of the
    first one is what the others are compared with."""
    metric: str = "eval/episode_return"
    """What to compare; a run's score is its last value."""
    group_by: tuple[str, ...] = ()
    """Settings that make a group, such as ppo.learning_rate or experiment; by default all in which
    the runs differ, but the seed."""
    out: Path | None = None
    """Folder for compare.json, groups.csv, curves.csv and curves.png."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    from purerl.runs.command_line import parse

    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        options = parse(Options, arguments, "python -m purerl.compare")
        result, curves = compare_runs(options)
        print("\n".join(describe(result)))
        if options.out is not None:
            write(options.out, result, curves)
    except UserError as error:
        return tell(error)
    broken = [pair for pair in result["pairs"] if pair["same"] is False and pair["promised"]]
    return FAILURE if broken else 0


def compare_runs(options: Options) -> tuple[dict[str, Any], list[Any]]:
    """Returns the whole comparison as JSON values, and the learning curves.

    Raises:
      UserError: an argument means no run, or there is no such metric or setting.
    """
    from purerl.report import bit_diff, run_reader, seed_statistics

    if not options.runs:
        raise UserError("Give the runs to compare: python -m purerl.compare RUN RUN ...")
    runs = [run_reader.read(path) for path in run_reader.find_runs(options.runs)]
    pairs = [bit_diff.compare(a, b) for a, b in bit_diff.twins(runs)]
    found = seed_statistics.make_groups(runs, options.group_by)
    summaries, unscored = [], ""
    try:
        run_reader.check_metric(runs, options.metric)
        summaries = [seed_statistics.summarize(group, options.metric) for group in found]
        seed_statistics.check_scored(summaries, options.metric)
    except UserError as error:
        if not pairs:
            raise
        found, summaries, unscored = [], [], str(error)  # whether bits are equal can still be told
    against = [seed_statistics.versus(group, found[0], options.metric) for group in found[1:]]
    curves = [seed_statistics.learning_curve(group, options.metric) for group in found]
    result = {
        "metric": options.metric,
        "runs": len(runs),
        "settings_that_differ": seed_statistics.differing(runs),
        "conditions_that_differ": conditions(runs),
        "pairs": [pair._asdict() for pair in pairs],
        "unscored": unscored,
        "groups": [as_json(summary) for summary in summaries],
        "versus_first": [as_json(v) for v in against if v is not None],
    }
    return result, [curve for curve in curves if curve is not None]


def as_json(record: Any) -> dict[str, Any]:
    """Returns a NamedTuple as a dict, intervals as {"low", "high"}."""
    return {k: v._asdict() if hasattr(v, "_asdict") else v for k, v in record._asdict().items()}


def conditions(runs: Sequence[Any]) -> list[str]:
    """Lists in what the machines and versions of the runs differ from the first one's."""
    from purerl.runs import manifest

    found = [manifest.differences(runs[0].manifest, run.manifest) for run in runs[1:]]
    return list(dict.fromkeys(line for lines in found for line in lines))


# --- for a person ---


def describe(result: dict[str, Any]) -> list[str]:
    """Returns the comparison as lines."""
    lines = [f"{result['runs']} runs, {result['metric']} at the end"]
    for pair in result["pairs"]:
        lines += [f"{pair['first']} and {pair['second']}, of one configuration and seed:"]
        lines += [f"  {line}" for line in pair["lines"]]
    for name, values in result["settings_that_differ"].items():
        lines.append(f"differs: {name} is {' | '.join(map(str, values))}")
    lines += [f"other conditions: {line}" for line in result["conditions_that_differ"]]
    if result["unscored"]:
        return [*lines, f"No scores: {result['unscored']}"]
    lines += table(group_rows(result["groups"]))
    if result["versus_first"]:
        lines += ["", f"against {result['versus_first'][0]['baseline']}:"]
        lines += table(versus_rows(result["versus_first"]))
        if any(v["same_seeds"] for v in result["versus_first"]):
            lines.append(
                "Paired: differences between runs of one seed, which begin with the same weights "
                "if the networks have one shape; the surer figure then."
            )
    if result["pairs"]:
        lines.append("Runs of one configuration and seed count once, as the first of them.")
    return lines + notes(result["groups"])


def group_rows(summaries: Iterable[dict[str, Any]]) -> list[list[str]]:
    """Returns the table of groups, its head first."""
    head = ["group", "n", "IQM", "95% interval", "mean", "10th pct", "worst", "in", "failed"]
    rows = [
        [s["label"], str(s["n"]), number(s["iqm"]), interval(s["interval"]), number(s["mean"]),
         number(s["tenth"]), number(s["worst"]), Path(s["worst_run"]).name, str(s["failed"])]
        for s in summaries
    ]  # fmt: skip
    return [head, *rows]


def versus_rows(against: Iterable[dict[str, Any]]) -> list[list[str]]:
    """Returns the table of groups against the first, its head first."""
    head = ["group", "IQM difference", "95% interval", "P(better)", "95% interval"]
    head += ["pairs", "paired IQM", "95% interval"]
    rows = [
        [v["label"], number(v["difference"]), interval(v["difference_interval"]),
         number(v["improvement"]), interval(v["improvement_interval"]),
         str(v["same_seeds"]), number(v["paired_difference"]), interval(v["paired_interval"])]
        for v in against
    ]  # fmt: skip
    return [head, *rows]


def notes(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns what a reader of the tables must know."""
    from purerl.report.bootstrap import LEAST_RUNS

    lines = []
    if any(s["interval"] is None for s in summaries):
        lines.append(
            f"No interval (-) below {LEAST_RUNS} seeds of a configuration, where it would be too "
            "narrow. Ten seeds are a good number."
        )
    if any(s["failed"] for s in summaries):
        lines.append("Failed runs (non-finite numbers) count with the last value they reached.")
    left_out = sum(s["unfinished"] for s in summaries)
    if left_out:
        lines.append(f"{left_out} unfinished runs are left out.")
    silent = sum(s["done"] + s["failed"] - s["n"] for s in summaries)
    if silent:
        lines.append(f"{silent} runs have no value of the metric and are left out.")
    return lines


def number(value: float | None) -> str:
    """Returns a number with four significant digits, whole where it is large."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def interval(value: dict[str, float] | None) -> str:
    """Returns an interval as [low, high]."""
    return f"[{number(value['low'])}, {number(value['high'])}]" if value else "-"


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns rows in columns, the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


# --- files ---


def write(folder: Path, result: dict[str, Any], curves: Sequence[Any]) -> None:
    """Writes everything that was found, and the learning curves as numbers and as a picture."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "compare.json").write_text(json.dumps(result, indent=2) + "\n")
        write_csv(folder / "groups.csv", group_table(result))
        write_csv(folder / "curves.csv", curve_table(curves))
        if curves:
            plot(folder / "curves.png", curves, result["metric"])
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}.") from error


def group_table(result: dict[str, Any]) -> Iterable[list[Any]]:
    """Yields groups.csv, row by row."""
    names = ["label", "n", "done", "failed", "unfinished", "iqm", "mean", "tenth", "worst"]
    yield [*names, "worst_run", "low", "high"]
    for s in result["groups"]:
        ends = s["interval"] or {"low": None, "high": None}
        yield [*(s[name] for name in names), s["worst_run"], ends["low"], ends["high"]]


def curve_table(curves: Sequence[Any]) -> Iterable[list[Any]]:
    """Yields curves.csv, row by row."""
    yield ["group", "n", "steps", "iqm", "low", "high"]
    for curve in curves:
        band = curve.band
        for i, steps in enumerate(curve.steps):
            ends = [None, None] if band.low is None else [band.low[i], band.high[i]]
            yield [curve.label, curve.n, steps, band.iqm[i], *ends]


def write_csv(path: Path, rows: Iterable[Sequence[Any]]) -> None:
    """Writes rows; None is an empty cell."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def plot(path: Path, curves: Sequence[Any], metric: str) -> None:
    """Draws each group's IQM, its band, and its runs as thin lines."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    for i, curve in enumerate(curves):
        color = f"C{i % 10}"
        for run in curve.runs:
            axes.plot(list(run), list(run.values()), color=color, linewidth=0.5, alpha=0.4)
        if curve.band.low is not None:
            axes.fill_between(
                curve.steps, curve.band.low, curve.band.high, color=color, alpha=0.2, linewidth=0
            )
        label = f"{curve.label} (n = {curve.n})"
        axes.plot(curve.steps, curve.band.iqm, color=color, linewidth=2, label=label)
    axes.set(xlabel="control steps", ylabel=metric, title="Interquartile mean, 95% intervals")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


if __name__ == "__main__":
    leave(main)
