"""A run's folder: its files' names, and one record of what it held when it was read.

`read` looks at the disk, `write` and `note` change it. All that is asked of a folder is asked of
the record, so that one command sees one state of it, and says when it looks again.
"""

import contextlib
import os
from pathlib import Path
from typing import Any, NamedTuple

from purerl.core.errors import UserError, reason
from purerl.experiment import loading
from purerl.machine import files, lock
from purerl.runs import checkpoint_folder
from purerl.runs.manifest import fingerprint

CONFIG, MANIFEST, CODE = "config.json", "manifest.json", "experiment.py"
METRICS, CHECKPOINTS = "metrics.jsonl", "checkpoints"
OURS = {lock.LOCK, CONFIG, MANIFEST, CODE, METRICS, CHECKPOINTS}


class Folder(NamedTuple):
    """What a run's folder held when it was read.

    The three files that describe a run are written in one go, `config.json` last: without it there
    is no run, and `config`, `manifest` and `code` are empty.
    """

    path: Path
    exists: bool
    names: frozenset[str]  # of what is in it
    links: frozenset[str]  # of what a run would write through, and is no file of its own
    config: dict[str, Any]  # config.json: every setting
    manifest: dict[str, Any]  # manifest.json: all that the bits depend on besides
    code: bytes  # experiment.py
    updates: tuple[int, ...]  # that have a checkpoint, oldest first; one may be damaged
    damaged: tuple[str, ...]  # checkpoints that were set aside

    @property
    def is_run(self) -> bool:
        """Whether it holds a run."""
        return CONFIG in self.names

    @property
    def checkpoints(self) -> Path:
        """The folder of its checkpoints."""
        return self.path / CHECKPOINTS

    @property
    def metrics(self) -> Path:
        """The file of its metrics."""
        return self.path / METRICS

    @property
    def is_edited(self) -> bool:
        """Whether one of the three files is not what the run wrote."""
        written = fingerprint(self.config, self.manifest, self.code)
        return self.manifest.get("fingerprint") != written

    @property
    def is_begun(self) -> bool:
        """Whether it has, or had, a checkpoint; a run without one has nothing to protect."""
        had = self.manifest.get("had_checkpoint")
        return self.is_run and bool(self.updates or self.damaged or had)


def read(path: Path) -> Folder:
    """Reads a folder, whether it holds a run or not; executes nothing of it.

    Raises:
      UserError: it cannot be read, or a file of a run is missing or broken.
    """
    listed = _list(path)
    if not listed.is_run:
        return listed
    config, manifest = files.read_json(path / CONFIG), files.read_json(path / MANIFEST)
    return listed._replace(config=config, manifest=manifest, code=files.read_bytes(path / CODE))


def _list(path: Path) -> Folder:
    """Returns what shows without opening a file.

    A folder in it, such as `checkpoints`, may be a link: that is how a large one is kept elsewhere.
    """
    try:
        entries = list(os.scandir(path)) if path.is_dir() else []
        links = [e.name for e in entries if not (e.is_file(follow_symlinks=False) or e.is_dir())]
        updates, damaged = checkpoint_folder.listed(path / CHECKPOINTS)
        names = frozenset(entry.name for entry in entries)
        return Folder(path, path.exists(), names, frozenset(links), {}, {}, b"", updates, damaged)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {reason(error)}.") from error


def read_run(path: Path) -> Folder:
    """Reads the folder of a run; UserError, with the runs inside of it, if it holds none."""
    check_is_run(path)
    folder = read(path)
    files.check_object(str(path / CONFIG), folder.config, experiment=str, settings=dict)
    return folder


def check_manifest(folder: Folder) -> dict[str, Any]:
    """Returns manifest.json; UserError unless it has what is needed to use the run."""
    where = str(folder.path / MANIFEST)
    facts = files.check_object(
        where, folder.manifest, run_id=str, name=str, fingerprint=str, experiment_file=str,
        engine=str, source=dict, num_shards=int, model=str | None,
    )  # fmt: skip
    for change in allowed_changes(folder):
        files.check_object(f"{where}: allowed_changes", change, fingerprint=str, after_update=int)
        files.check_object(f"{where}: allowed_changes", change.get("of", {}))
    return facts


def allowed_changes(folder: Folder) -> list[dict[str, Any]]:
    """Returns what --allow-changes has let pass, in order."""
    where = str(folder.path / MANIFEST)
    known = {"allowed_changes": [], **folder.manifest}
    return files.check_object(where, known, allowed_changes=list)["allowed_changes"]


def write(folder: Folder, config: dict[str, Any], manifest: dict[str, Any], code: bytes) -> Folder:
    """Writes the three files that describe a run; config.json last, it makes it a run."""
    manifest = manifest | {"fingerprint": fingerprint(config, manifest, code)}
    files.make_folder(folder.checkpoints)
    files.write_file(folder.path / CODE, code)
    files.write_json(folder.path / MANIFEST, manifest)
    files.write_json(folder.path / CONFIG, config)
    names = folder.names | {CONFIG, MANIFEST, CODE, CHECKPOINTS}
    return folder._replace(names=names, config=config, manifest=manifest, code=code)


def note(folder: Folder, **facts: Any) -> Folder:
    """Adds to manifest.json what is learned of a run later, and to the record."""
    if all(folder.manifest.get(name) == value for name, value in facts.items()):
        return folder
    manifest = folder.manifest | facts
    files.write_json(folder.path / MANIFEST, manifest)
    return folder._replace(manifest=manifest)


def check_no_links(folder: Folder) -> None:
    """Raises UserError if what is written would not stay in the folder."""
    for name in sorted(folder.links):
        raise UserError(f"{folder.path / name} is no file, but a link or worse: remove it.")


def check_is_run(path: Path) -> None:
    """Raises UserError unless a folder holds a run; the message lists the runs inside of it."""
    found = runs_in(path) or runs_in("runs" / path)
    if found != [path]:
        runs = f" Runs found: {', '.join(map(str, found))}." if found else ""
        what = f"no run: it has no {CONFIG}" if path.is_dir() else "no folder"
        known = sorted(place.name for place in loading.POLICIES.glob("*"))
        played = f" Policies that come with purerl: {', '.join(known)}."
        lone = played if not path.is_dir() and path.parent == Path() else ""
        raise UserError(f"{path} is {what}.{runs}{lone}")


def runs_in(place: Path) -> list[Path]:
    """Returns the run that a folder is, or the runs one or two levels below it; [] for none."""
    try:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            (place / CONFIG).stat()
            return [place]
        below = (sorted(place.glob(f"{stars}/{CONFIG}")) for stars in ("*", "*/*"))
        return [file.parent for file in next(filter(None, below), [])]
    except (OSError, ValueError) as error:
        raise UserError(f"{place} cannot be read: {reason(error)}.") from error
