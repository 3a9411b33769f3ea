"""Runs of one configuration and seed: the same to the last bit, or where they part."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from purerl.report.run_reader import RunRecord
from purerl.runs import checkpoint_folder, manifest

SHOWN = 3  # differing leaves that are named


class BitDiff(NamedTuple):
    """What was found in two runs that should be one."""

    first: str
    second: str
    same: bool | None  # None: no checkpoint of the same update to compare
    promised: bool  # both bit-exact, manifest and source agree: any difference is a fault
    lines: list[str]  # what was found, for a person
    last_equal: int | None  # the last update whose digests agree, before they part
    parted: int | None  # the first update whose digests, or else metrics, do not
    leaves: list[str]  # that differ in the earliest checkpoint that shows it, in path order


def repeats(runs: Iterable[RunRecord]) -> list[tuple[RunRecord, RunRecord]]:
    """Returns pairs of runs of one configuration and seed: the first with each later one."""
    first: dict[str, RunRecord] = {}
    pairs = ((first.setdefault(configuration_and_seed(run), run), run) for run in runs)
    return [(known, run) for known, run in pairs if known is not run]


def configuration_and_seed(run: RunRecord) -> str:
    """Returns all of a run's settings that its bits depend on, as text."""
    return repr((run.seed, sorted(run.settings.items(), key=str)))


def compare_bits(a: RunRecord, b: RunRecord) -> BitDiff:
    """Compares two runs by the digests in their metrics, and by their checkpoints' leaves."""
    conditions = manifest.differences(a.manifest, b.manifest)
    if a.source != b.source:
        conditions.append("experiment.py: the files differ")
    ours, theirs = a.digests(), b.digests()
    common = sorted(ours.keys() & theirs.keys())
    parted = next((update for update in common if ours[update] != theirs[update]), None)
    equal = [update for update in common if parted is None or update < parted]
    lines, leaves = _first_metrics_that_differ(a, b), list[str]()
    if not common:
        lines.insert(0, "they have no checkpoint of the same update, so no digests to compare")
    elif parted is None:
        last = f"the last {ours[common[-1]]} of update {common[-1]}"
        lines.insert(0, f"same: {len(common)} digests, {last}")
    else:
        before = f"the same at update {equal[-1]}, " if equal else ""
        lines.insert(0, f"different: {before}not at update {parted}")
        leaf_line, leaves = _first_leaves_that_differ(a, b)
        lines.append(leaf_line)
    return BitDiff(
        first=str(a.path),
        second=str(b.path),
        same=parted is None if common else None,
        promised=not conditions and all(run.manifest.get("bit_exact", True) for run in (a, b)),
        lines=lines + [f"other conditions: {line}" for line in conditions],
        last_equal=equal[-1] if equal else None,
        parted=parted,
        leaves=leaves,
    )


def differing_conditions(runs: Sequence[RunRecord]) -> list[str]:
    """Lists in what the machines and versions of the runs differ from the first one's."""
    found = [manifest.differences(runs[0].manifest, run.manifest) for run in runs[1:]]
    return list(dict.fromkeys(line for lines in found for line in lines))


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
    """Finds the earliest checkpoint that both still have and in which a leaf differs.

    Returns:
      A line for a person, and the paths of the leaves that differ.
    """
    folders = [run.path / "checkpoints" for run in (a, b)]
    for update in checkpoint_folder.common_updates(folders):
        try:
            ours, theirs = (_leaf_hashes(folder, update) for folder in folders)
        except checkpoint_folder.DamagedError as error:
            return f"leaves cannot be compared: a checkpoint of {update} is damaged: {error}", []
        paths = sorted({*ours, *theirs})
        leaves = [path for path in paths if ours.get(path) != theirs.get(path)]
        if leaves:
            named = ", ".join(leaves[:SHOWN]) + (", ..." if len(leaves) > SHOWN else "")
            where = f"leaves differ in the checkpoint of update {update}, the first {named}"
            return f"{len(leaves)} of {len(paths)} {where}", leaves
    return "leaves cannot be compared: the checkpoints that differ are deleted (see --keep)", []


def _leaf_hashes(folder: Path, update: int) -> dict[str, dict[str, Any]]:
    """Returns path -> dtype, shape and sha256 of a checkpoint's leaves."""
    return checkpoint_folder.load_meta(checkpoint_folder.path_of(folder, update))["leaves"]
