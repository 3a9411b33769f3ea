"""A run's folder is read into one record, and no more often than a command has to look."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from purerl import run
from purerl.core.errors import SUCCESS, UserError
from purerl.runs import folder as run_folder
from purerl.runs.folder import Folder

TOY = Path(__file__).parent / "toy_experiment.py"
ROOT = TOY.parent.parent.parent
FILES = ("config.json", "manifest.json", "experiment.py")
COUNT = """
import collections, sys
opened = collections.Counter()
def note(event, arguments):
    if event == "open" and isinstance(arguments[0], (str, bytes)):
        opened[str(arguments[0]).rsplit("/", 1)[-1]] += 1
sys.addaudithook(note)
from purerl import run
assert run.main(sys.argv[1:]) == 0
print({name: opened[name] for name in FILES})
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A short run of the toy experiment."""
    place = tmp_path_factory.mktemp("trained")
    assert run.main([str(TOY), "--runs", str(place)]) == SUCCESS
    return place / "toy_experiment" / "seed1"


def reads(words: list[str]) -> dict[str, int]:
    """Returns how often a run command opens each file that describes its run."""
    code = COUNT.replace("FILES", repr(FILES))
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return eval(done.stdout.splitlines()[-1])


def test_a_resume_reads_the_manifest_twice_before_its_lock_and_after(trained):
    """5 s. The others once more, for settings that a command leaves out.

    The last checkpoint is taken away, so that the run goes on and writes.
    """
    last = sorted((trained / "checkpoints").iterdir())[-1]
    last.rename(trained.parent.parent / last.name)
    found = reads([str(TOY), "--runs", str(trained.parent.parent), "--resume"])
    assert found == dict.fromkeys(FILES, 3) | {run_folder.MANIFEST: 2}
    assert (trained / "checkpoints" / last.name).is_dir()


def test_names_of_files_are_spelled_in_one_place():
    found = []
    for file in (ROOT / "purerl").rglob("*.py"):
        if {"tune", "envs", "experiments"} & set(file.relative_to(ROOT).parts):
            continue  # a sweep has a manifest of its own
        text = file.read_text()
        found += [file.name for name in FILES if f'/ "{name}"' in text or f"/ '{name}'" in text]
    assert found == []
    assert all(f'"{name}"' in (ROOT / "purerl/runs/folder.py").read_text() for name in FILES)


def test_a_folder_that_is_no_run_is_read_too(tmp_path):
    assert not run_folder.read(tmp_path / "nowhere").exists
    (tmp_path / "notes.txt").touch()
    (tmp_path / "link").symlink_to(tmp_path / "notes.txt")
    (tmp_path / "checkpoints").symlink_to(tmp_path)  # a large folder may be kept elsewhere
    found = run_folder.read(tmp_path)
    assert found.exists and not found.is_run and not found.is_begun
    assert found.names == {"notes.txt", "link", "checkpoints"} and found.links == {"link"}
    with pytest.raises(UserError, match="is no run: it has no config.json"):
        run_folder.read_run(tmp_path)


def test_what_is_noted_is_in_the_file_and_in_the_record(trained):
    before = run_folder.read(trained)
    assert before.is_run and before.is_begun and before.updates and not before.is_edited
    after = run_folder.note(before, had_checkpoint="perhaps")
    assert after == run_folder.read(trained)
    assert after.manifest["had_checkpoint"] == "perhaps" != before.manifest["had_checkpoint"]
    assert run_folder.note(after, had_checkpoint="perhaps") is after
    assert not after.is_edited  # what is noted later is no part of the fingerprint
    run_folder.note(after, engine="another")
    assert run_folder.read(trained).is_edited


def test_a_run_without_its_manifest_is_told(trained, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"settings": {}}))
    with pytest.raises(UserError, match="manifest.json cannot be read"):
        run_folder.read(tmp_path)
    assert isinstance(run_folder.read(trained), Folder)
