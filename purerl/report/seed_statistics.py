"""Groups of runs: which runs belong together, what each group scored, how two groups differ."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from purerl.core.errors import UserError, unknown_name
from purerl.report import bootstrap
from purerl.report.bit_diff import configuration_and_seed
from purerl.report.bootstrap import Interval
from purerl.report.run_reader import RunRecord


class Group(NamedTuple):
    """Runs that differ in nothing but their seed, or in what the grouping leaves aside."""

    label: str
    runs: list[RunRecord]  # each seed of a configuration once
    strata: dict[str, list[RunRecord]]  # what the grouping leaves aside -> its runs


class Summary(NamedTuple):
    """What one group scored at the end of its runs."""

    label: str
    n: int  # runs that count
    done: int
    failed: int  # stopped by non-finite numbers; count with the last value they reached
    unfinished: int  # do not count
    iqm: float | None
    interval: Interval | None
    mean: float | None
    worst: float | None
    worst_run: str
    tenth: float | None  # 10th percentile
    runs: dict[str, float]  # path -> score


class Versus(NamedTuple):
    """One group against the first."""

    label: str
    baseline: str
    difference: float  # of the IQMs
    difference_interval: Interval | None
    improvement: float  # probability that a run of this group beats one of the baseline
    improvement_interval: Interval | None
    same_seeds: int  # runs of this group with a partner of the same seed
    paired_difference: float | None  # IQM of the differences between partners
    paired_interval: Interval | None


class Curve(NamedTuple):
    """A group's learning curve, at the steps that all its runs have."""

    label: str
    n: int
    steps: list[int]
    band: bootstrap.Band
    runs: list[dict[int, float]]


def differing(runs: Sequence[RunRecord]) -> dict[str, list[Any]]:
    """Returns the settings in which the runs differ, each with its values."""
    settings = [run.settings for run in runs]
    names = list(dict.fromkeys(name for s in settings for name in s))
    values = {n: {repr(s.get(n)): s.get(n) for s in settings} for n in names}
    return {name: list(found.values()) for name, found in values.items() if len(found) > 1}


def make_groups(runs: Sequence[RunRecord], group_by: Sequence[str]) -> list[Group]:
    """Groups runs by the settings named, or by all in which they differ (but the seed).

    Raises:
      UserError: there is no such setting.
    """
    valid = {name for run in runs for name in run.settings}
    by = [name.replace("-", "_") for name in group_by] or list(differing(runs))
    for name in by:
        if name not in valid:
            raise UserError(unknown_name("setting", name, sorted(valid), " to group by"))
    members: dict[str, dict[str, RunRecord]] = {}
    for run in runs:
        members.setdefault(label_of(run, by), {}).setdefault(configuration_and_seed(run), run)
    return [
        Group(label, list(found.values()), strata_of(list(found.values()), by))
        for label, found in members.items()
    ]


def label_of(run: RunRecord, by: Sequence[str]) -> str:
    """Returns a group's name: the experiment, and the settings that make the difference."""
    words = [f"{name}={run.settings.get(name)}" for name in by if name != "experiment"]
    named = "experiment" in by or not words
    return " ".join([run.settings["experiment"], *words] if named else words)


def strata_of(runs: Sequence[RunRecord], by: Sequence[str]) -> dict[str, list[RunRecord]]:
    """Sorts a group's runs by the settings that the grouping leaves aside."""
    strata: dict[str, list[RunRecord]] = {}
    for run in runs:
        rest = {k: v for k, v in run.settings.items() if k not in by}
        strata.setdefault(repr(sorted(rest.items())), []).append(run)
    return dict(sorted(strata.items()))


# --- scores ---


def score(run: RunRecord, metric: str) -> float | None:
    """Returns a run's last value of the metric; None if it does not count."""
    curve = run.curve(metric)
    return curve[max(curve)] if curve and run.status != "unfinished" else None


def by_seed(runs: Sequence[RunRecord], metric: str) -> dict[int, float]:
    """Returns seed -> score of the runs of a stratum that count; it has each seed once."""
    return {run.seed: s for run in runs if (s := score(run, metric)) is not None}


def scores(group: Group, metric: str) -> dict[str, np.ndarray]:
    """Returns the scores of the runs that count, [n_k] for each stratum that has any."""
    found = {key: by_seed(runs, metric) for key, runs in group.strata.items()}
    return {key: np.array(list(values.values())) for key, values in found.items() if values}


def summarize(group: Group, metric: str) -> Summary:
    """Returns what a group scored."""
    strata = list(scores(group, metric).values())
    each = {str(r.path): s for r in group.runs if (s := score(r, metric)) is not None}
    values = np.array(list(each.values()))
    status = [run.status for run in group.runs]
    known = len(values) > 0
    return Summary(
        label=group.label,
        n=len(values),
        done=status.count("done"),
        failed=status.count("failed"),
        unfinished=status.count("unfinished"),
        iqm=float(bootstrap.pooled_iqm(strata)) if known else None,
        interval=bootstrap.iqm_interval(strata) if known else None,
        mean=float(values.mean()) if known else None,
        worst=float(values.min()) if known else None,
        worst_run=min(each, key=lambda path: each[path]) if known else "",
        tenth=float(np.percentile(values, 10)) if known else None,
        runs=each,
    )


def versus(group: Group, baseline: Group, metric: str) -> Versus | None:
    """Compares a group with the first one; None if either has no score.

    Strata are compared one by one where both groups have the same, else all runs with all.
    """
    ours, theirs = scores(group, metric), scores(baseline, metric)
    if not ours or not theirs:
        return None
    xs, ys = list(ours.values()), list(theirs.values())
    if ours.keys() != theirs.keys():
        xs, ys = [np.concatenate(xs)], [np.concatenate(ys)]
    pairs = paired_differences(group, baseline, metric)
    return Versus(
        label=group.label,
        baseline=baseline.label,
        difference=float(bootstrap.pooled_iqm(xs) - bootstrap.pooled_iqm(ys)),
        difference_interval=bootstrap.difference_interval(xs, ys),
        improvement=float(bootstrap.stratified_probability(xs, ys)),
        improvement_interval=bootstrap.improvement_interval(xs, ys),
        same_seeds=sum(map(len, pairs)),
        paired_difference=float(bootstrap.pooled_iqm(pairs)) if pairs else None,
        paired_interval=bootstrap.iqm_interval(pairs) if pairs else None,
    )


def paired_differences(group: Group, baseline: Group, metric: str) -> list[bootstrap.Values]:
    """Returns the group's scores minus the baseline's on the seeds that both have.

    Equal seeds give networks of one shape the same initial weights, and these decide much. Returns
    of eight seeds of brax's ant under three versions of the learner correlated by 0.71 to 0.84, and
    the paired interval was less than half as wide.

    Returns:
      [n_k] for each stratum that both groups have.
    """
    found = []
    for key in sorted(group.strata.keys() & baseline.strata.keys()):
        ours, theirs = (by_seed(one.strata[key], metric) for one in (group, baseline))
        seeds = sorted(ours.keys() & theirs.keys())
        found.append(np.array([ours[seed] - theirs[seed] for seed in seeds]))
    return [values for values in found if len(values)]


def learning_curve(group: Group, metric: str) -> Curve | None:
    """Returns a group's learning curve; None where its runs share no step."""
    strata = [
        [run.curve(metric) for run in runs if score(run, metric) is not None]
        for runs in group.strata.values()
    ]
    strata = [curves for curves in strata if curves]
    curves = [curve for stratum in strata for curve in stratum]
    steps = sorted(set.intersection(*(set(c) for c in curves))) if curves else []
    if not steps:
        return None
    values = [np.array([[curve[s] for s in steps] for curve in stratum]) for stratum in strata]
    return Curve(group.label, len(curves), steps, bootstrap.curve_band(values), curves)


def check_scored(summaries: Sequence[Summary], metric: str) -> None:
    """Raises UserError if no run has anything to compare."""
    if not any(summary.n for summary in summaries):
        raise UserError(
            f"No run that is done has a value of {metric}: let one come to its end, or choose "
            "another --metric."
        )
