"""Runs compared: `compare` gathers everything, `describe` tells it, `write` makes files of it."""

import contextlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from purerl.core.errors import UserError
from purerl.machine.files import as_csv, write_file, write_json, writing
from purerl.machine.output import printable
from purerl.report import bit_diff, run_reader, seed_statistics
from purerl.report.bootstrap import LEAST_IQM, LEAST_RUNS, Interval
from purerl.report.seed_statistics import Curve
from purerl.runs import manifest

# A table's columns: what stands above, and the key of the value.
GROUPS = [
    ("group", "label"), ("n", "n"), ("IQM", "iqm"), ("95% interval", "interval"), ("mean", "mean"),
    ("10th pct", "tenth"), ("worst", "worst"), ("in", "worst_run"), ("failed", "failed"),
]  # fmt: skip
VERSUS = [
    ("group", "label"), ("difference", "difference"), ("95% interval", "difference_interval"),
    ("P(better)", "improvement"), ("95% interval", "improvement_interval"),
    ("pairs", "same_seeds"),
    ("paired", "paired_difference"), ("95% interval", "paired_interval"),
]  # fmt: skip
GROUPS_CSV = ["label", "n", "done", "failed", "unfinished", "iqm", "mean", "tenth", "worst"]
GROUPS_CSV += ["worst_run", "low", "high"]
CURVES_CSV = ["group", "n", "steps", "iqm", "low", "high"]
MANY = 3  # files of source code that differ, beyond which they are counted
CURVES = f"Interquartile mean (mean below {LEAST_IQM} seeds), 95% intervals from {LEAST_RUNS} on"
LONGEST_LABEL = 60  # beside the other columns it fits a wide terminal


def compare(
    places: Sequence[Path], metric: str, group_by: Sequence[str]
) -> tuple[dict[str, Any], list[Curve]]:
    """Compares runs bit by bit where they should be equal, and by statistics over seeds.

    Args:
      places: runs, folders of runs, or patterns.
      metric: what is compared.
      group_by: settings that make a group; none: all in which the runs differ, but the seed.

    Returns:
      The whole comparison as JSON values, and the groups' learning curves.

    Raises:
      UserError: a place means no run, or there is no such metric or setting.
    """
    result, curves = compare_records(run_reader.read_runs(places, "compare"), metric, group_by)
    if result["unscored"] and not result["pairs"]:  # else the bits can be compared all the same
        raise UserError(result["unscored"])
    return result, curves


def compare_records(
    runs: Sequence[run_reader.RunRecord], metric: str, group_by: Sequence[str]
) -> tuple[dict[str, Any], list[Curve]]:
    """Compares runs that were read, as `compare`; "unscored" says why there are no scores."""
    first: dict[str, run_reader.RunRecord] = {}
    any_code = [run._replace(settings=run.settings | {"code": ""}).identity for run in runs]
    repeats = [(first.setdefault(name, run), run) for name, run in zip(any_code, runs, strict=True)]
    pairs = [bit_diff.compare_bits(a, b) for a, b in repeats if a is not b]
    groups = seed_statistics.make_groups(runs, group_by)
    unscored = ""
    try:
        seed_statistics.check_scored(runs, groups, metric)
    except UserError as error:
        groups, unscored = [], str(error)
    first_of_all, *others = [run.manifest for run in runs]
    conditions = [line for other in others for line in manifest.differences(first_of_all, other)]
    against = [seed_statistics.versus(group, groups[0], metric) for group in groups[1:]]
    curves = [seed_statistics.learning_curve(group, metric) for group in groups]
    result = {
        "metric": metric,
        "runs": len(runs),
        "settings_that_differ": seed_statistics.differing(runs),
        "conditions_that_differ": list(dict.fromkeys(conditions)),
        "pairs": pairs,
        "unscored": unscored,
        "groups": [seed_statistics.summarize(group, metric) for group in groups],
        "versus_first": [found for found in against if found is not None],
    }
    return result, [curve for curve in curves if curve is not None]


# --- text ---


def describe(result: dict[str, Any]) -> list[str]:
    """Returns what `compare` found as lines of text."""
    lines = [f"{result['runs']} runs, {result['metric']} at the end"]
    for pair in result["pairs"]:
        lines += [f"{pair['first']} and {pair['second']}, of one configuration and seed:"]
        lines += [f"  {line}" for line in pair["lines"]]
    for name, values in result["settings_that_differ"].items():
        lines.append(f"differs: {name} is {' | '.join(map(str, values))}")
    conditions = manifest.count_files(result["conditions_that_differ"], MANY)
    lines += [f"other conditions: {line}" for line in conditions]
    if result["unscored"]:
        return [*lines, f"No scores: {result['unscored']}"]
    groups, versus = result["groups"], result["versus_first"]
    said = short_names([g["label"] for g in groups])
    lines += [f"group {name} is {label}" for label, name in said.items() if name != label]
    rows = [g | {"worst_run": Path(g["worst_run"]).name, "label": said[g["label"]]} for g in groups]
    lines += table(GROUPS, rows)
    if versus:
        lines += ["", f"against {said[versus[0]['baseline']]}:"]
        lines += table(VERSUS, [v | {"label": said[v["label"]]} for v in versus])
        if any(v["same_seeds"] for v in versus):
            lines.append(
                "Paired: differences between runs of one seed, which begin with the same weights "
                "if the networks have one shape; the surer figure then."
            )
    if result["metric"] != "eval/episode_return":
        lines.append("More counts as better: 'worst' and '10th pct' are the low end.")
    if result["pairs"]:
        lines.append("Runs of one configuration, code and seed count once, as the first of them.")
    return lines + notes(groups)


def short_names(labels: Sequence[str]) -> dict[str, str]:
    """Returns label -> what a table calls the group: a number, where a label is too long for it.

    >>> short_names(["ppo.gamma=0.9", "ppo.gamma=0.99"])
    {'ppo.gamma=0.9': 'ppo.gamma=0.9', 'ppo.gamma=0.99': 'ppo.gamma=0.99'}
    """
    if max(map(len, labels), default=0) <= LONGEST_LABEL:
        return {label: label for label in labels}
    return {label: f"{i + 1}" for i, label in enumerate(labels)}


def notes(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Returns what a reader of the tables must know."""
    left_out = sum(s["unfinished"] for s in summaries)
    silent = sum(s["done"] + s["failed"] - s["n"] for s in summaries)
    few = any(0 < s["n"] < LEAST_IQM for s in summaries)
    failed = any(s["failed"] for s in summaries)
    found = {
        f"Below {LEAST_IQM} seeds there is no IQM: what is compared and drawn is the mean.": few,
        f"No interval (-) below {LEAST_RUNS} seeds of a configuration, where it would be too "
        "narrow. Ten seeds are a good number.": any(s["interval"] is None for s in summaries),
        "Failed runs (non-finite numbers) count with the last value they reached.": failed,
        f"{left_out} unfinished runs are left out.": left_out,
        f"{silent} runs have no value of the metric and are left out.": silent,
    }
    return [note for note, holds in found.items() if holds]


def table(columns: Sequence[tuple[str, str]], records: Iterable[dict[str, Any]]) -> list[str]:
    """Returns a table's lines, its head first; the first column is flush left, others right."""
    rows = [[head for head, _ in columns]]
    rows += [[cell(record[key]) for _, key in columns] for record in records]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    form = "  ".join(f"{{:{'>' if i else '<'}{width}}}" for i, width in enumerate(widths))
    return [form.format(*row).rstrip() for row in rows]


def cell(value: Any) -> str:
    """Returns a number with four significant digits (whole where it is large), or [low, high]."""
    if value is None:
        return "-"
    if isinstance(value, dict | Interval):
        low, high = value.values() if isinstance(value, dict) else value
        return f"[{cell(low)}, {cell(high)}]"
    if isinstance(value, float):
        return f"{value:,.0f}" if 10_000 <= abs(value) < 1e15 else f"{value:.4g}"
    return str(value)


# --- files ---


def write(folder: Path, result: dict[str, Any], curves: Sequence[Curve]) -> None:
    """Writes everything that was found, and the learning curves as numbers and as a picture.

    Args:
      folder: made if need be.
      result: what `compare` returned first.
      curves: what it returned second.
    """
    groups = (group | (group["interval"] or {}) for group in result["groups"])
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "compare.json", result)
        write_file(folder / "groups.csv", as_csv(GROUPS_CSV, groups))
        write_file(folder / "curves.csv", as_csv(CURVES_CSV, _curve_rows(curves)))
        if curves:
            draw_curves(folder / "curves.png", curves, result["metric"])


def _curve_rows(curves: Iterable[Curve]) -> Iterator[dict[str, Any]]:
    for curve in curves:
        for i, steps in enumerate(curve.steps):
            band = {k: None if v is None else v[i] for k, v in curve.band._asdict().items()}
            yield {"group": curve.label, "n": len(curve.runs), "steps": steps} | band


def episodes_csv(groups: Iterable[tuple[dict[str, Any], Mapping[str, Any]]]) -> bytes:
    """Returns CSV: a row for each episode of each group.

    Args:
      groups: what stands in all rows of a group, and its figures, name -> [N].
    """
    rows = [
        about | {"episode": i} | {name: x[i].item() for name, x in figures.items()}
        for about, figures in groups
        for i in range(len(next(iter(figures.values()))))
    ]
    return as_csv(list(dict.fromkeys(name for row in rows for name in row)), rows)


def plotter() -> Any:
    """Returns matplotlib's pyplot, for pictures that are written to files alone."""
    import matplotlib  # most of a second

    matplotlib.use("Agg")
    # Labels have settings in them, any text; and text in a PDF stays text, as journals ask.
    matplotlib.rcParams.update({"text.parse_math": False, "pdf.fonttype": 42})
    from matplotlib import pyplot

    pyplot.style.use("tableau-colorblind10")
    return pyplot


@contextlib.contextmanager
def picture(path: Path, *shape: int, **options: Any) -> Iterator[tuple[Any, Any]]:
    """Yields a figure and its axes, of pyplot's `subplots`; then writes it.

    Raises:
      UserError: the disk refuses it.
    """
    pyplot = plotter()
    figure, axes = pyplot.subplots(*shape, layout="constrained", **options)
    try:
        yield figure, axes
        content = io.BytesIO()
        figure.savefig(content, format=path.suffix[1:], dpi=120)
        write_file(path, content.getvalue())
    finally:  # a notebook would draw what is left open
        pyplot.close(figure)


def draw_curves(path: Path, curves: Sequence[Curve], metric: str) -> None:
    """Writes a picture of each group's IQM, its band, and its runs as thin lines."""
    with picture(path, figsize=(8, 5)) as (_, axes):
        for i, curve in enumerate(curves):
            color = f"C{i % 10}"
            for run in curve.runs:
                axes.plot(list(run), list(run.values()), color=color, linewidth=0.5, alpha=0.4)
            iqm, low, high = curve.band
            if low is not None and high is not None:
                axes.fill_between(curve.steps, low, high, color=color, alpha=0.2, linewidth=0)
            label = printable(f"{curve.label} (n = {len(curve.runs)})")
            axes.plot(curve.steps, iqm, color=color, linewidth=2, label=label)
        axes.plot([], [], color="gray", linewidth=0.5, label="each run")
        axes.set(xlabel="control steps", ylabel=printable(metric), title=CURVES)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")
