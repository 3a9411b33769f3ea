"""Pictures of the control suite's scores: each task's curves, and all tasks together."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from purerl.experiments.benchmarks.suite_clock import TIMES, Published
from purerl.experiments.benchmarks.suite_scores import (
    BEST,
    LEVELS,
    Seed,
    common_curve,
    profile,
    strata,
)
from purerl.report import bootstrap
from purerl.report.comparison import plotter

LINES = {"brax_ppo_end": ("brax PPO", "C1"), "reppo_end": ("REPPO, 200 M", "C2")}
POINTS = {"reppo": "C2", "brax_ppo": "C1", "brax_sac": "C3"}
COLUMNS = 5


def draw_tasks(
    path: Path,
    tasks: dict[str, list[Seed]],
    published: dict[str, dict[str, float]],
    by_time: Published,
    across: str,
) -> None:
    """Writes a picture with a panel for each task: IQM, interval, seeds, published returns.

    Args:
      path: of the PNG.
      tasks: `by_task`.
      published: `references`, drawn as lines.
      by_time: `suite_clock.references`, drawn as points at their seconds.
      across: "steps" or "seconds".
    """
    pyplot = plotter()
    columns = min(COLUMNS, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    figure, panels = pyplot.subplots(
        rows, columns, figsize=(3 * columns, 2.2 * rows), sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for panel in panels.flat[len(tasks) :]:
        panel.set_axis_off()
    for panel, (task, seeds) in zip(panels.flat, tasks.items(), strict=False):
        _draw_task(panel, seeds, published.get(task, {}), across)
        for name, color in POINTS.items():
            if task in by_time and name in by_time[task]:
                values = [np.nan if x is None else x for x in by_time[task][name]]
                panel.plot(TIMES, values, "o:", color=color, markersize=3, linewidth=1, label=name)
        panel.set_title(f"{task} (n = {len(seeds)})", fontsize="small")
    panels.flat[0].legend(fontsize="x-small")
    figure.supxlabel("control steps" if across == "steps" else "seconds")
    figure.supylabel("return; IQM, 95% interval")
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _draw_task(panel: Any, seeds: Sequence[Seed], published: dict[str, float], across: str) -> None:
    for s in seeds:
        panel.plot(getattr(s, across), s.returns, color="C0", linewidth=0.5, alpha=0.4)
    found = common_curve(seeds)
    if found is not None:
        steps, band, seconds = found
        _draw_band(panel, steps if across == "steps" else seconds, band)
    for column, (label, color) in LINES.items():
        if column in published:
            panel.axhline(published[column], color=color, linewidth=1, linestyle="--", label=label)
    panel.set_ylim(0, BEST * 1.03)
    if across == "steps":
        panel.xaxis.set_major_formatter(_in_millions)
    panel.grid(alpha=0.3)


def _draw_band(panel: Any, x: Sequence[float] | np.ndarray, band: bootstrap.Band) -> None:
    panel.plot(x, band.iqm, color="C0", linewidth=2, label="purerl")
    if band.low is not None:
        panel.fill_between(x, band.low, band.high, color="C0", alpha=0.2, linewidth=0)


def _in_millions(steps: float, _: int) -> str:
    return f"{steps / 1e6:g} M"


def draw_together(path: Path, tasks: dict[str, list[Seed]]) -> None:
    """Writes a picture of all tasks: IQM over steps, and the performance profile at the end."""
    pyplot = plotter()
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    if (found := together(tasks)) is not None:
        _draw_band(left, *found)
    left.xaxis.set_major_formatter(_in_millions)
    left.set(xlabel="control steps", ylabel="return", title=f"IQM of {len(tasks)} tasks")
    share, low, high = profile(tasks)
    right.plot(LEVELS, share, color="C0", linewidth=2)
    right.fill_between(LEVELS, low, high, color="C0", alpha=0.2, linewidth=0)
    right.set(xlabel="return", ylabel="share of runs above", title="performance profile")
    for panel in (left, right):
        panel.grid(alpha=0.3)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def together(tasks: dict[str, list[Seed]]) -> tuple[list[int], bootstrap.Band] | None:
    """Returns the steps that every curve has, and the IQM there; None: there are none.

    Other numbers of steps or environments are evaluated at other steps, so a curve is a line from
    one evaluation to the next. A seed that failed keeps its last return, as in its score.
    """
    curves = [s for seeds in tasks.values() for s in seeds if s.status != "failed" and s.steps]
    if not curves:
        return None
    first, last = max(s.steps[0] for s in curves), min(s.steps[-1] for s in curves)
    steps = sorted({n for s in curves for n in s.steps if first <= n <= last})
    if not steps:
        return None
    values = [np.array([_returns_at(steps, s) for s in seeds]) for seeds in tasks.values()]
    return steps, bootstrap.curve_band(values, number=500)


def _returns_at(steps: Sequence[int], seed: Seed) -> np.ndarray:
    if not seed.steps:
        return np.zeros(len(steps))
    return np.interp(steps, seed.steps, seed.returns)


def summary(tasks: dict[str, list[Seed]]) -> str:
    """Returns one line: the IQM of all tasks' seeds, with its interval."""
    scores = strata(tasks)
    interval = bootstrap.iqm_interval(scores)
    of = f" ({interval.low:.1f} to {interval.high:.1f})" if interval else ""
    number = sum(map(len, scores))
    return f"IQM of {len(tasks)} tasks, {number} runs: {bootstrap.pooled_iqm(scores):.1f}{of}"
