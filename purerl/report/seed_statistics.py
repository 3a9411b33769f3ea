"""Groups of runs: which runs belong together, what each group scored, how two groups differ."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from purerl.core.errors import UserError, unknown_name
from purerl.report import bootstrap
from purerl.report.run_reader import RunRecord

LEAST_TENTH = 10  # runs that have a 10th percentile


class Group(NamedTuple):
    """Runs that differ in nothing but their seed, or in settings that the grouping ignores."""

    label: str
    runs: list[RunRecord]  # each seed of a configuration once
    strata: dict[str, list[RunRecord]]  # the ignored settings, as text -> their runs


class Curve(NamedTuple):
    """A group's learning curve, at the steps that all its runs have, but for those that failed."""

    label: str
    steps: list[int]
    band: bootstrap.Band
    runs: list[dict[int, float]]  # steps -> value


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
        members.setdefault(_label(run, by), {}).setdefault(run.identity, run)
    groups = {label: list(found.values()) for label, found in members.items()}
    return [Group(label, found, _strata(found, by)) for label, found in groups.items()]


def _label(run: RunRecord, by: Sequence[str]) -> str:
    """Returns a group's name: the experiment, and the settings that make the difference."""
    words = [f"{name}={run.settings.get(name)}" for name in by if name != "experiment"]
    named = "experiment" in by or not words
    return " ".join([run.settings["experiment"], *words] if named else words)


def _strata(runs: Iterable[RunRecord], by: Sequence[str]) -> dict[str, list[RunRecord]]:
    """Sorts a group's runs by the settings that the grouping ignores."""
    strata: dict[str, list[RunRecord]] = {}
    for run in runs:
        rest = {k: v for k, v in run.settings.items() if k not in by}
        strata.setdefault(repr(sorted(rest.items())), []).append(run)
    return dict(sorted(strata.items()))


# --- scores ---


def _score(run: RunRecord, metric: str) -> float | None:
    """Returns a run's last value of the metric; None if it does not count."""
    curve = run.curve(metric)
    return curve[max(curve)] if curve and run.status != "unfinished" else None


def _scores(group: Group, metric: str) -> dict[str, dict[int, float]]:
    """Returns stratum -> seed -> score of the runs that count; a stratum has each seed once."""
    found = {
        key: {run.seed: s for run in runs if (s := _score(run, metric)) is not None}
        for key, runs in group.strata.items()
    }
    return {key: scores for key, scores in found.items() if scores}


def _arrays(strata: dict[str, dict[int, float]]) -> list[np.ndarray]:
    return [np.array(list(scores.values())) for scores in strata.values()]


def _as_json(**found: Any) -> dict[str, Any]:
    """Returns results with intervals as {"low", "high"}."""
    return {k: v._asdict() if isinstance(v, bootstrap.Interval) else v for k, v in found.items()}


def check_metric(runs: Iterable[RunRecord], metric: str) -> None:
    """Raises UserError, with the nearest name, unless some run has the metric."""
    names = {name for run in runs for line in run.lines for name in line}
    names -= {"update", "steps", "wall_s", "digest"}
    if metric not in names:
        raise UserError(unknown_name("metric", metric, sorted(names), " in these runs"))


def check_scored(runs: Iterable[RunRecord], groups: Iterable[Group], metric: str) -> None:
    """Raises UserError unless some run has the metric, and some run that counts too."""
    check_metric(runs, metric)
    if not any(_scores(group, metric) for group in groups):
        raise UserError(
            f"No run that is done has a value of {metric}: let one come to its end, or choose "
            "another --metric."
        )


def summarize(group: Group, metric: str) -> dict[str, Any]:
    """Returns what a group scored at the end of its runs, as JSON values; None: nothing."""
    strata = _arrays(_scores(group, metric))
    each = {str(r.path): s for r in group.runs if (s := _score(r, metric)) is not None}
    values = np.array(list(each.values()))
    status = [run.status for run in group.runs]
    return _as_json(
        label=group.label,
        n=len(each),  # runs that count
        done=status.count("done"),
        failed=status.count("failed"),  # they count with the last value that they reached
        unfinished=status.count("unfinished"),  # they do not count
        iqm=float(bootstrap.pooled_iqm(strata)) if len(each) >= bootstrap.LEAST_IQM else None,
        score=float(bootstrap.pooled_iqm(strata)) if each else None,  # of fewer runs: their mean
        interval=bootstrap.iqm_interval(strata) if each else None,
        mean=float(values.mean()) if each else None,
        worst=float(values.min()) if each else None,
        worst_run=min(each, key=lambda path: each[path]) if each else "",
        # Percentile; that of fewer is made up of the two lowest.
        tenth=float(np.percentile(values, 10)) if len(each) >= LEAST_TENTH else None,
        runs=each,
    )


def versus(group: Group, baseline: Group, metric: str) -> dict[str, Any] | None:
    """Compares a group with the first one, as JSON values; None if either has no score.

    Strata are compared one by one where both groups have the same, else all runs with all.

    Runs of equal seeds are also compared in pairs. Equal seeds give networks of one shape the same
    initial weights, and these decide much: returns of eight seeds of brax's ant under three
    versions of the learner correlated by 0.71 to 0.84, and the paired interval was less than half
    as wide.
    """
    ours, theirs = _scores(group, metric), _scores(baseline, metric)
    if not ours or not theirs:
        return None
    xs, ys = _arrays(ours), _arrays(theirs)
    if ours.keys() != theirs.keys():
        xs, ys = [np.concatenate(xs)], [np.concatenate(ys)]
    shared = {key: ours[key].keys() & theirs[key].keys() for key in ours if key in theirs}
    pairs = [
        np.array([ours[key][seed] - theirs[key][seed] for seed in sorted(seeds)])
        for key, seeds in shared.items()
        if seeds
    ]
    return _as_json(
        label=group.label,
        baseline=baseline.label,
        difference=float(bootstrap.pooled_iqm(xs) - bootstrap.pooled_iqm(ys)),
        difference_interval=bootstrap.difference_interval(xs, ys),
        # Probability that a run of this group beats one of the baseline.
        improvement=float(bootstrap.stratified_probability(xs, ys)),
        improvement_interval=bootstrap.improvement_interval(xs, ys),
        same_seeds=sum(map(len, pairs)),  # runs with a partner
        paired_difference=float(bootstrap.pooled_iqm(pairs)) if pairs else None,
        paired_interval=bootstrap.iqm_interval(pairs) if pairs else None,
    )


def learning_curve(group: Group, metric: str) -> Curve | None:
    """Returns a group's learning curve; None where its runs share no step.

    A failed run goes on with the last value that it reached, which is its score: it would else end
    the curve of the others.
    """
    every = group.strata.values()
    counted = [[run for run in runs if _score(run, metric) is not None] for runs in every]
    strata = [[run.curve(metric) for run in runs] for runs in counted if runs]
    curves = [curve for found in strata for curve in found]
    sound = [run.curve(metric) for runs in counted for run in runs if run.status != "failed"]
    steps = sorted(set.intersection(*map(set, sound or curves))) if curves else []
    steps = [step for step in steps if all(min(curve) <= step for curve in curves)]
    if not steps:
        return None
    values = [np.array([_carried_on(curve, steps) for curve in found]) for found in strata]
    return Curve(group.label, steps, bootstrap.curve_band(values), curves)


def _carried_on(curve: dict[int, float], steps: Sequence[int]) -> list[float]:
    """Returns the last value of a curve up to each of `steps`."""
    known = sorted(curve)
    return [curve[known[i - 1]] for i in np.searchsorted(known, steps, side="right")]


def every_curve(group: Group, metric: str) -> Curve:
    """Returns a group's curve with all its runs, also those that do not count in a score."""
    counted = learning_curve(group, metric)
    runs = [curve for run in group.runs if (curve := run.curve(metric))]
    none = Curve(group.label, [], bootstrap.Band(np.array([]), None, None), [])
    return (counted or none)._replace(runs=runs)
