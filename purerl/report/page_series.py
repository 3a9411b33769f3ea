"""What the charts of a page show: a metric's values in every run, thinned to what can be seen."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from purerl.report import bootstrap, run_reader, seed_statistics

MOST_POINTS = 400  # of a line; a chart is some 500 pixels wide
MOST_PANELS = 300  # a page with more is slow to open
HUGE = 1e150  # what is beyond cannot be drawn beside anything, and overflows when squared
MOST_BANDS = 6  # runs up to which each shows its own spread
RETURN = "eval/episode_return"
SPREAD = f"{RETURN}_std"  # over the episodes of one evaluation
NOT_CURVES = {"update", "steps", "wall_s", "digest", *(f"{RETURN}_{n}" for n in ("min", "max"))}
NOT_CURVES |= {SPREAD}
# A section of the page: its heading, and how the names of its metrics begin. The first that fits.
SECTIONS = (
    ("Return", (RETURN, "train/episode_return")),
    ("Evaluation: every metric", ("eval/",)),
    ("Training: reward terms and metrics of the episodes", ("train/episode", "train/reward")),
    ("Learning: losses and steps of the optimizer", ("train/",)),
    ("Others", ("",)),
)


class Series(NamedTuple):
    """One line of a chart."""

    label: str
    group: int
    run: int | None  # its number in the group; None: the interquartile mean of the group's runs
    steps: list[int]
    values: list[float]
    low: list[float] | None  # what a band spans
    high: list[float] | None


class Panel(NamedTuple):
    """One chart."""

    metric: str
    series: list[Series]


def metric_names(runs: Iterable[run_reader.RunRecord]) -> list[str]:
    """Returns the metrics that have curves, in the order in which the files name them."""
    names = dict.fromkeys(name for run in runs for line in run.lines for name in line)
    return [name for name in names if name not in NOT_CURVES]


def panels(groups: Sequence[seed_statistics.Group]) -> list[tuple[str, list[Panel]]]:
    """Returns the charts by section, sections without any left out."""
    names = metric_names(run for group in groups for run in group.runs)
    found: dict[str, list[Panel]] = {title: [] for title, _ in SECTIONS}
    names.sort(key=lambda name: name != RETURN)  # evaluation's return first
    for name in names[:MOST_PANELS]:
        series = series_of(groups, name)
        if series:
            found[section_of(name)].append(Panel(name, series))
    return [(title, inside) for title, inside in found.items() if inside]


def section_of(metric: str) -> str:
    """Returns the heading under which a metric stands."""
    (first, exactly), *others = SECTIONS
    if metric in exactly:
        return first
    return next(title for title, starts in others if metric.startswith(starts))


def series_of(groups: Sequence[seed_statistics.Group], metric: str) -> list[Series]:
    """Returns a line for each run, and for each group of several the interquartile mean."""
    number = sum(len(group.runs) for group in groups)
    found = []
    for g, group in enumerate(groups):
        for r, run in enumerate(group.runs):
            if visible(run.curve(metric)):
                found.append(_run_series(run, metric, g, r, number <= MOST_BANDS))
        # In training every update has a value: its interval would take minutes, and say little.
        if len(group.runs) > 1 and metric.startswith("eval/"):
            found += _group_series(group, metric, g)
    return found


def visible(curve: dict[int, float]) -> dict[int, float]:
    """Returns the points that a picture can have; what is nearly 0 is 0."""
    return {s: v if abs(v) > 1 / HUGE else 0.0 for s, v in curve.items() if abs(v) < HUGE}


def _run_series(run: run_reader.RunRecord, metric: str, g: int, r: int, spread: bool) -> Series:
    curve = visible(run.curve(metric))
    steps, values, low, high = thin(list(curve), list(curve.values()))
    if metric == RETURN and len(steps) == len(curve):
        std = visible(run.curve(SPREAD))
        low = [v - std.get(s, 0.0) for s, v in curve.items()]
        high = [v + std.get(s, 0.0) for s, v in curve.items()]
    band = (low, high) if spread and low != high else (None, None)
    return Series(run.path.name, g, r, steps, values, *band)


def _group_series(group: seed_statistics.Group, metric: str, g: int) -> list[Series]:
    curve = seed_statistics.learning_curve(group, metric)
    if curve is None or len(curve.runs) < 2 or any(visible(run) != run for run in curve.runs):
        return []
    iqm, low, high = (None if a is None else [float(v) for v in a] for a in curve.band)
    name = "IQM" if len(curve.runs) >= bootstrap.LEAST_IQM else "mean"
    return [Series(f"{name} of {len(curve.runs)}", g, None, curve.steps, iqm or [], low, high)]


def thin(
    steps: Sequence[int], values: Sequence[float], most: int = MOST_POINTS
) -> tuple[list[int], list[float], list[float], list[float]]:
    """Averages neighbours until at most `most` points are left.

    Returns:
      The last step of each, its mean, its least and its largest value.

    >>> thin([1, 2, 3, 4], [1.0, 3.0, 5.0, 5.0], 2)
    ([2, 4], [2.0, 5.0], [1.0, 5.0], [3.0, 5.0])
    """
    size = -(-len(steps) // most)
    parts = [values[i : i + size] for i in range(0, len(steps), max(size, 1))]
    ends = [min(i + size, len(steps)) - 1 for i in range(0, len(steps), max(size, 1))]
    means = [sum(part) / len(part) for part in parts]
    return [steps[i] for i in ends], means, list(map(min, parts)), list(map(max, parts))


def constant(panel: Panel) -> float | None:
    """Returns the only value that all runs have at all times; None if there are several."""
    values = {v for series in panel.series for v in series.values}
    return values.pop() if len(values) == 1 else None
