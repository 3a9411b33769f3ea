"""Runs of one configuration and seed: the same to the last bit, or where they part."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from purerl.report.run_reader import History
from purerl.runs import checkpoint, manifest

SHOWN = 3  # differing leaves that are named


class Comparison(NamedTuple):
    """Two runs that should be one."""

    first: str
    second: str
    same: bool | None  # None: no checkpoint of the same update to compare
    promised: bool  # both bit-exact, manifest and source agree: any difference is a fault
    lines: list[str]  # what was found, for a person
    last_equal: int | None  # the last update whose digests agree, before they part
    parted: int | None  # the first update whose digests, or else metrics, do not
    leaves: list[str]  # that differ in the earliest checkpoint that shows it, in path order


def twins(runs: Sequence[History]) -> list[tuple[History, History]]:
    """Returns pairs of runs of one configuration and seed: the first with each other one."""
    first: dict[str, History] = {}
    pairs = []
    for run in runs:
        known = first.setdefault(identity(run), run)
        if known is not run:
            pairs.append((known, run))
    return pairs


def identity(run: History) -> str:
    """Returns what decides a run's bits as far as its settings go."""
    return repr((run.experiment, run.seed, sorted(run.settings.items(), key=str)))


def compare(a: History, b: History) -> Comparison:
    """Compares two runs by the digests in their metrics, and by their checkpoints' leaves."""
    conditions = manifest.differences(a.manifest, b.manifest)
    if a.source != b.source:
        conditions.append("experiment.py: the files differ")
    ours, theirs = a.digests(), b.digests()
    common = sorted(ours.keys() & theirs.keys())
    parted = [update for update in common if ours[update] != theirs[update]]
    equal = [update for update in common if not parted or update < parted[0]]
    lines, leaves = _metrics_part(a, b), list[str]()
    if not common:
        lines.insert(0, "they have no checkpoint of the same update, so no digests to compare")
    elif not parted:
        lines.insert(0, f"same: {len(common)} digests, the last {ours[common[-1]]} of update "
                        f"{common[-1]}")  # fmt: skip
    else:
        before = f"the same at update {equal[-1]}, " if equal else ""
        lines.insert(0, f"different: {before}not at update {parted[0]}")
        leaf_line, leaves = _leaves_part(a, b)
        lines.append(leaf_line)
    if conditions:
        lines += [f"other conditions: {line}" for line in conditions]
    return Comparison(
        first=str(a.path),
        second=str(b.path),
        same=not parted if common else None,
        promised=not conditions and all(run.manifest.get("bit_exact", True) for run in (a, b)),
        lines=lines,
        last_equal=equal[-1] if equal else None,
        parted=parted[0] if parted else None,
        leaves=leaves,
    )


def _metrics_part(a: History, b: History) -> list[str]:
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


def _leaves_part(a: History, b: History) -> tuple[str, list[str]]:
    """Finds the earliest checkpoint that both still have and in which a leaf differs."""
    folders = [run.path / "checkpoints" for run in (a, b)]
    both = sorted(set(checkpoint.updates(folders[0])) & set(checkpoint.updates(folders[1])))
    for update in both:
        try:
            ours, theirs = (_hashes(folder, update) for folder in folders)
        except checkpoint.DamagedError as error:
            return f"leaves cannot be compared: a checkpoint of {update} is damaged: {error}", []
        paths = sorted({*ours, *theirs})
        leaves = [path for path in paths if ours.get(path) != theirs.get(path)]
        if leaves:
            named = ", ".join(leaves[:SHOWN]) + (", ..." if len(leaves) > SHOWN else "")
            line = (
                f"{len(leaves)} of {len(paths)} leaves differ in the checkpoint of update {update}"
            )
            return f"{line}, the first {named}", leaves
    return "leaves cannot be compared: the checkpoints that differ are deleted (see --keep)", []


def _hashes(folder: Any, update: int) -> dict[str, dict[str, Any]]:
    """Returns path -> dtype, shape and sha256 of a checkpoint's leaves."""
    return checkpoint.load_meta(folder / f"{update:012d}")["leaves"]
