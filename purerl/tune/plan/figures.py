"""What planned episodes were like, in figures: returns, every metric, both rewards."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from purerl.report import comparison
from purerl.report.bootstrap import LEAST_RUNS, mean_interval
from purerl.tune.plan.episodes import TERM

Figures = dict[str, np.ndarray]  # name -> [E]
RETURN, LENGTH, LOST = "episode_return", "episode_length", "lost"


def table(groups: Mapping[str, Figures]) -> list[str]:
    """Returns lines with mean and 95% interval of every figure, returns first.

    With two groups, the episodes of which begin alike, also of the difference, episode by episode.
    """
    first, *rest = groups.values()
    names = sorted(set(first).union(*rest), key=lambda name: ("return" not in name, name))
    if rest:
        both = first.keys() & rest[0].keys()
        groups = {**groups, "difference": {name: rest[0][name] - first[name] for name in both}}
    rows = [{"": name} | {g: said(x.get(name)) for g, x in groups.items()} for name in names]
    return comparison.table([(head, head) for head in ("", *groups)], rows)


def notes(groups: Mapping[str, Figures]) -> list[str]:
    """Returns lines that say how to read a table, and what is wrong with its episodes."""
    lines = ["Returns are sums over an episode, other rows means over its steps (*_count: sums)."]
    number = len(next(iter(groups.values()))[LENGTH])
    if number < LEAST_RUNS:
        lines.append(f"Intervals need {LEAST_RUNS} episodes: --episodes {LEAST_RUNS}")
    for name, group in groups.items():
        if lost := int(group[LOST].sum()):
            lines.append(
                f"{name}: {lost} of {number} episodes were lost (a number was NaN or absurd) and "
                "count 0: `python -m purerl.check` says which number."
            )
        elif (group[LENGTH] <= 1).all():
            lines.append(f"{name}: every episode ended with its first step.")
    return lines


def said(values: np.ndarray | None) -> str:
    """Returns mean and interval of values [E] as text."""
    if values is None:
        return ""
    interval = mean_interval(values)
    known = "" if interval is None else f" [{interval.low:.4g}, {interval.high:.4g}]"
    return f"{values.mean():.4g}{known}"


def as_json(groups: Mapping[str, Figures], about: Mapping[str, Any]) -> str:
    """Returns JSON: what was asked for, and every figure with its values, mean and interval."""

    def one(x: np.ndarray) -> dict[str, Any]:
        return {"mean": float(x.mean()), "interval": mean_interval(x), "values": x.tolist()}

    found = {group: {n: one(x) for n, x in figures.items()} for group, figures in groups.items()}
    return json.dumps({**about, "figures": found}, indent=2, default=str) + "\n"


def judged(rows: Sequence[Mapping[str, Any]]) -> Figures:
    """Returns what each judge says of the episodes, of the rows of `episodes.advance`.

    A judge's episode may end before the one that was played: by its settings, nothing comes after.
    The return is a sum over its episode, terms of the reward are means over its steps.
    """
    running, found = np.concatenate([row["running"] for row in rows]), {}
    for judge in rows[0]["judged"]:
        told = {k: np.concatenate([row["judged"][judge][k] for row in rows])
                for k in rows[0]["judged"][judge]}  # fmt: skip
        ends = told.pop("over")
        counts = running & (np.cumsum(ends, axis=0) - ends == 0)
        length = counts.sum(axis=0)
        for part, values in told.items():
            whole = np.where(counts, values, 0.0).sum(axis=0, dtype=float)
            over = 1 if part == "return" else np.maximum(length, 1)
            found[f"{part} under {judge}"] = whole / over
        found[f"steps under {judge}"] = length.astype(float)
    return found


def compared(own: Figures, judged: Figures) -> Figures:
    """Returns the figures that two behaviours can be compared by.

    Of the return and of the terms of a reward, those that both settings judge: the weights of two
    settings are no difference between behaviours.
    """
    shared = {n: x for n, x in own.items() if n != RETURN and not n.startswith(TERM)}
    return shared | judged if judged else own
