"""Runs of one configuration and seed: the same to the last bit, or where they part."""

from typing import Any

from purerl.core.errors import some
from purerl.report.run_reader import RunRecord
from purerl.runs import checkpoint_folder, manifest
from purerl.runs.folder import CHECKPOINTS


def compare_bits(a: RunRecord, b: RunRecord) -> dict[str, Any]:
    """Compares two runs by the digests in their metrics, and by their checkpoints' leaves.

    Returns:
      What was found, as JSON values; "lines" is for a person.
    """
    conditions = manifest.differences(a.manifest, b.manifest)
    for run in (a, b):
        if run.manifest.get("allowed_changes"):
            conditions.append(f"{run.path} went on after a change (manifest.json, allowed_changes)")
    if a.source != b.source:
        conditions.append("experiment.py: the files differ")
    ours, theirs = (
        {line["update"]: line["digest"] for line in run.lines if "digest" in line} for run in (a, b)
    )
    common = sorted(ours.keys() & theirs.keys())
    parted = next((update for update in common if ours[update] != theirs[update]), None)
    equal = [update for update in common if parted is None or update < parted]
    lines, leaves = _first_metrics_that_differ(a, b), list[str]()
    if not common:
        verdict = "they have no checkpoint of the same update, so no digests to compare"
    elif parted is None:
        last = f"the last {ours[common[-1]]} of update {common[-1]}"
        verdict = f"same: {len(common)} digests, {last}"
    else:
        before = f"the same at update {equal[-1]}, " if equal else ""
        verdict = f"different: {before}not at update {parted}"
        line, leaves = _first_leaves_that_differ(a, b)
        lines.append(line)
    return {
        "first": str(a.path),
        "second": str(b.path),
        "same": parted is None if common else None,  # None: there was nothing to compare
        # Both are bit-exact, and manifest and source agree: any difference is a fault.
        "promised": not conditions and all(run.manifest.get("bit_exact", True) for run in (a, b)),
        "lines": [verdict, *lines, *(f"other conditions: {line}" for line in conditions)],
        "last_equal": equal[-1] if equal else None,  # the last update before their digests part
        "parted": parted,  # the first update with other digests
        "leaves": leaves,  # that differ in the earliest checkpoint that shows it, in path order
    }


def _first_metrics_that_differ(a: RunRecord, b: RunRecord) -> list[str]:
    """Finds the first line of the metrics that differs: finer than checkpoints."""
    theirs = {line["update"]: line for line in b.lines}
    for line in a.lines:
        other = theirs.get(line["update"], line)
        names = [n for n in line if n in other and n not in ("wall_s", "digest")]
        differing = [n for n in names if line[n] != other[n]]
        if differing:
            name = differing[0]
            return [
                f"metrics part at update {line['update']}: {name} is {line[name]} and "
                f"{other[name]} ({len(differing)} of {len(names)} differ)"
            ]
    return []


def _first_leaves_that_differ(a: RunRecord, b: RunRecord) -> tuple[str, list[str]]:
    """Looks through the checkpoints that both still have; returns a line, and the leaves' paths."""
    folders = [run.path / CHECKPOINTS for run in (a, b)]
    for update in checkpoint_folder.common_updates(folders):
        paths = [checkpoint_folder.path_of(folder, update) for folder in folders]
        try:
            ours, theirs = (checkpoint_folder.load_meta(path)["leaves"] for path in paths)
        except checkpoint_folder.DamagedError as error:
            return f"leaves cannot be compared: a checkpoint of {update} is damaged: {error}", []
        every = sorted({*ours, *theirs})
        leaves = [leaf for leaf in every if ours.get(leaf) != theirs.get(leaf)]
        if leaves:
            where = f"leaves differ in the checkpoint of update {update}: {some(leaves, 3)}"
            return f"{len(leaves)} of {len(every)} {where}", leaves
    return "leaves cannot be compared: the checkpoints that differ are deleted (see --keep)", []
