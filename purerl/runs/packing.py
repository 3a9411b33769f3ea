"""A run in one file, with all of its own that it reads: what a colleague needs to go on with it."""

import glob
import gzip
import io
import json
import shlex
import sys
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from purerl.core.errors import UserError, one_line
from purerl.experiment.source_hashes import IMPORTED, PACKAGE
from purerl.machine import file_reads, output
from purerl.runs import checkpoint_folder, restored_run
from purerl.runs.folder import CODE, CONFIG, MANIFEST, check_manifest, read_run, runs_in


def pack(run: Path, trust: bool) -> dict[Path, bytes]:
    """Returns a run, and what it reads of the folder that this process is in, by their names there.

    Of its checkpoints come the newest and the best. What is no longer as the run had it is told.

    Args:
      run: its folder, wherever it is.
      trust: as for `restored_run.restore`.
    """
    here = Path.cwd()
    # Neither hidden files nor Python's compiled ones.
    seen = [here / name for name in glob.iglob("**", root_dir=here, recursive=True)]
    with file_reads.reads_among(file for file in seen if file.is_file()) as read:
        restored = restored_run.restore(run.absolute(), "latest", output.show, trust=trust)
    folder, facts = restored.folder, restored.folder.manifest
    # Of an empty file nothing is read.
    read |= {*seen} & {place / "__init__.py" for file in read for place in file.parents}
    others = {(PACKAGE / room).resolve() for room in ("", *IMPORTED)}
    others |= {folder.path.resolve(), Path(sys.prefix)}
    own = sorted(file for file in read if others.isdisjoint(file.resolve().parents))
    packed = {file.relative_to(here): file.read_bytes() for file in own if file.suffix != ".pyc"}
    original = Path(facts["experiment_file"])
    name = original.relative_to(here) if here in original.parents else Path(original.name)
    if others.isdisjoint(original.resolve().parents):
        packed[name] = folder.code  # as the run had it
    best = [update for _, update in checkpoint_folder.best_by_stage(folder.checkpoints).values()]
    place = Path("runs", restored.source.name, folder.path.name)
    kept = {restored.saved.meta["update"], *best[-1:]}
    saved = (checkpoint_folder.path_of(folder.checkpoints, update).rglob("*") for update in kept)
    files = [folder.path / CONFIG, folder.metrics, *(file for some in saved for file in some)]
    for file in filter(Path.is_file, files):
        packed[place / file.relative_to(folder.path)] = file.read_bytes()
    # Here it stands elsewhere, and whose machine this is concerns nobody.
    manifest = json.dumps(facts | {"experiment_file": str(name)}, indent=2).encode()
    return packed | {place / CODE: folder.code, place / MANIFEST: manifest}


def as_archive(packed: dict[Path, bytes]) -> bytes:
    """Returns files, by their names, as an archive (tar.gz) that says nothing of who made it."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for name, text in packed.items():
            member = tarfile.TarInfo(str(name))
            member.size = len(text)
            archive.addfile(member, io.BytesIO(text))
    return content.getvalue()


def unpack(file: Path, folder: Path) -> None:
    """Writes what an archive has into a new folder; executes nothing of it.

    Raises:
      UserError: it is damaged, or has anything but files that stay in that folder; or there is such
        a folder. Nothing has been written then.
    """
    try:
        whole = io.BytesIO(gzip.decompress(file.read_bytes()))  # its checksum, too
        with tarfile.open(fileobj=whole) as archive:
            for member in archive.getmembers():
                if not member.isreg() or {"/", ".."} & {*Path(member.name).parts}:
                    raise ValueError(f"{member.name} is no file of a run")
            folder.mkdir()
            archive.extractall(folder, filter="data")
    except (tarfile.TarError, OSError, EOFError, zlib.error, ValueError) as error:
        raise UserError(f"{file} cannot be opened: {one_line(error)}.") from error


def how_to_go_on(folder: Path) -> Iterator[str]:
    """Yields what to do with a folder that `unpack` has written, as lines."""
    yield f"Read the Python files in {folder}: a command that you give there may execute them."
    yield f"cd {shlex.quote(str(folder))}"
    for run in runs_in(folder / "runs"):
        file = check_manifest(read_run(run))["experiment_file"]
        experiment = file if (folder / file).is_file() else run.parent.name
        yield shlex.join(["purerl", "evaluate", str(run.relative_to(folder)), "--trust"])
        yield shlex.join(["purerl", "run", experiment, "--name", run.name, "--resume"])
