"""A comparison of runs as lines of text, for a person."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from purerl.report.bootstrap import LEAST_RUNS


def describe(result: dict[str, Any]) -> list[str]:
    """Returns what `comparison.compare` found as lines."""
    lines = [f"{result['runs']} runs, {result['metric']} at the end"]
    for pair in result["pairs"]:
        lines += [f"{pair['first']} and {pair['second']}, of one configuration and seed:"]
        lines += [f"  {line}" for line in pair["lines"]]
    for name, values in result["settings_that_differ"].items():
        lines.append(f"differs: {name} is {' | '.join(map(str, values))}")
    lines += [f"other conditions: {line}" for line in result["conditions_that_differ"]]
    if result["unscored"]:
        return [*lines, f"No scores: {result['unscored']}"]
    lines += columns(group_rows(result["groups"]))
    if result["versus_first"]:
        lines += ["", f"against {result['versus_first'][0]['baseline']}:"]
        lines += columns(versus_rows(result["versus_first"]))
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
    left_out = sum(s["unfinished"] for s in summaries)
    silent = sum(s["done"] + s["failed"] - s["n"] for s in summaries)
    found = {
        f"No interval (-) below {LEAST_RUNS} seeds of a configuration, where it would be too "
        "narrow. Ten seeds are a good number.": any(s["interval"] is None for s in summaries),
        "Failed runs (non-finite numbers) count with the last value they reached.": any(
            s["failed"] for s in summaries
        ),
        f"{left_out} unfinished runs are left out.": left_out,
        f"{silent} runs have no value of the metric and are left out.": silent,
    }
    return [note for note, holds in found.items() if holds]


def number(value: float | None) -> str:
    """Returns a number with four significant digits, whole where it is large."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 10_000 else f"{value:.4g}"


def interval(value: dict[str, float] | None) -> str:
    """Returns an interval as [low, high]."""
    return f"[{number(value['low'])}, {number(value['high'])}]" if value else "-"


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Returns rows in columns, the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    form = "  ".join(f"{{:{'>' if i else '<'}{width}}}" for i, width in enumerate(widths))
    return [form.format(*row).rstrip() for row in rows]
