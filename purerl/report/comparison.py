"""Runs compared with each other: `compare` gathers everything, `write` puts it into files."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError
from purerl.report import bit_diff, run_reader, seed_statistics
from purerl.report.seed_statistics import Curve
from purerl.runs.files import write_json


def compare(
    places: Iterable[Path], metric: str, group_by: Sequence[str]
) -> tuple[dict[str, Any], list[Curve]]:
    """Compares runs bit by bit where they should be equal, and by statistics over seeds.

    Args:
      places: runs, folders of runs, or patterns.
      metric: what is compared.
      group_by: settings that make a group; none: all in which the runs differ, but the seed.

    Returns:
      The whole comparison as JSON values, and the groups' learning curves.

    Raises:
      UserError: an argument means no run, or there is no such metric or setting.
    """
    runs = [run_reader.read(path) for path in run_reader.find_runs(places)]
    pairs = [bit_diff.compare_bits(a, b) for a, b in bit_diff.repeats(runs)]
    groups = seed_statistics.make_groups(runs, group_by)
    summaries, unscored = [], ""
    try:
        run_reader.check_metric(runs, metric)
        summaries = [seed_statistics.summarize(group, metric) for group in groups]
        seed_statistics.check_scored(summaries, metric)
    except UserError as error:
        if not pairs:
            raise
        groups, summaries, unscored = [], [], str(error)  # the bits can be compared all the same
    against = [seed_statistics.versus(group, groups[0], metric) for group in groups[1:]]
    curves = [seed_statistics.learning_curve(group, metric) for group in groups]
    result = {
        "metric": metric,
        "runs": len(runs),
        "settings_that_differ": seed_statistics.differing(runs),
        "conditions_that_differ": bit_diff.differing_conditions(runs),
        "pairs": [pair._asdict() for pair in pairs],
        "unscored": unscored,
        "groups": [_as_json(summary) for summary in summaries],
        "versus_first": [_as_json(v) for v in against if v is not None],
    }
    return result, [curve for curve in curves if curve is not None]


def breaks_a_promise(result: dict[str, Any]) -> bool:
    """Tells whether two runs that promise the same bits have not the same."""
    return any(pair["same"] is False and pair["promised"] for pair in result["pairs"])


def _as_json(record: Any) -> dict[str, Any]:
    """Returns a NamedTuple as a dict, intervals as {"low", "high"}."""
    return {k: v._asdict() if hasattr(v, "_asdict") else v for k, v in record._asdict().items()}


# --- files ---


def write(folder: Path, result: dict[str, Any], curves: Sequence[Curve]) -> None:
    """Writes everything that was found, and the learning curves as numbers and as a picture."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "compare.json", result)
        _write_csv(folder / "groups.csv", group_rows(result))
        _write_csv(folder / "curves.csv", curve_rows(curves))
        if curves:
            plot(folder / "curves.png", curves, result["metric"])
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror}.") from error


def group_rows(result: dict[str, Any]) -> Iterable[list[Any]]:
    """Yields groups.csv, row by row."""
    names = ["label", "n", "done", "failed", "unfinished", "iqm", "mean", "tenth", "worst"]
    names.append("worst_run")
    yield [*names, "low", "high"]
    for group in result["groups"]:
        ends = group["interval"] or {"low": None, "high": None}
        yield [*(group[name] for name in names), ends["low"], ends["high"]]


def curve_rows(curves: Sequence[Curve]) -> Iterable[list[Any]]:
    """Yields curves.csv, row by row."""
    yield ["group", "n", "steps", "iqm", "low", "high"]
    for curve in curves:
        band = curve.band
        for i, steps in enumerate(curve.steps):
            ends = [None if line is None else line[i] for line in (band.low, band.high)]
            yield [curve.label, curve.n, steps, band.iqm[i], *ends]


def _write_csv(path: Path, rows: Iterable[Sequence[Any]]) -> None:
    """Writes rows; None is an empty cell."""
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def plot(path: Path, curves: Sequence[Curve], metric: str) -> None:
    """Draws each group's IQM, its band, and its runs as thin lines."""
    import matplotlib  # most of a second

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5), layout="constrained")
    for i, curve in enumerate(curves):
        color = f"C{i % 10}"
        for run in curve.runs:
            axes.plot(list(run), list(run.values()), color=color, linewidth=0.5, alpha=0.4)
        low, high = curve.band.low, curve.band.high
        if low is not None and high is not None:
            axes.fill_between(curve.steps, low, high, color=color, alpha=0.2, linewidth=0)
        label = f"{curve.label} (n = {curve.n})"
        axes.plot(curve.steps, curve.band.iqm, color=color, linewidth=2, label=label)
    axes.set(xlabel="control steps", ylabel=metric, title="Interquartile mean, 95% intervals")
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
