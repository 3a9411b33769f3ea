"""The figures of several updates as one line of metrics."""

from collections.abc import Mapping, Sequence
from typing import Any

from purerl.runs.metrics_file import Record

COUNTS = ("episodes", "nonfinite_resets", "replayed_resets", "skipped_minibatches")


def summarize(window: Sequence[Mapping[str, Any]]) -> Record:
    """Joins the metrics of several updates: counts are summed, the rest is averaged.

    Metrics of episodes that ended (`episode...`) are averaged over the episodes, not over the
    updates. They are None if no episode ended.
    """
    counts = [float(metrics["episodes"]) for metrics in window]
    record: Record = {}
    for name in window[0]:
        values = [float(metrics[name]) for metrics in window]
        if name in COUNTS:
            record[name] = sum(values)
        elif name == "skipped_in_a_row":
            record[name] = values[-1]
        elif name.startswith("episode"):
            # An update without an ended episode has nothing to say: not 0, and not NaN.
            weighted = sum(v * n for v, n in zip(values, counts, strict=True) if n)
            record[name] = weighted / sum(counts) if sum(counts) else None
        else:
            record[name] = sum(values) / len(values)
    return record
