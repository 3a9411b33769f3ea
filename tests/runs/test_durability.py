"""What a run says on the disk is its own, or refused; nothing good is put aside."""

import builtins
import errno
import hashlib
import json
import os
import shutil
import threading
import time
import types
from pathlib import Path

import jax.numpy as jnp
import pytest

from purerl.core.errors import FAILURE, SUCCESS, RunError, UserError
from purerl.machine import array_files, files, state_arrays
from purerl.machine.lock import FolderLock
from purerl.runs import checkpoint, checkpoint_folder
from tests.training.test_run import (
    checkpoints,
    digest,
    folder,
    lines,
    refused,
    start,
    whole,  # noqa: F401 (a fixture)
)

# Bits are compared with those of runs that are compiled so too.
pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept")

WORDS = ("--checkpoints", "4")


@pytest.fixture
def stopped(tmp_path, stop_after):
    """A run that was stopped after two of its four checkpoints, and may go on."""
    stop_after(14)
    start(tmp_path, *WORDS)
    assert len(checkpoints(tmp_path)) >= 2 and checkpoints(tmp_path)[-1] < 12
    stop_after(10**9)
    return tmp_path


def go_on(runs: Path, *words: str) -> int:
    return start(runs, *WORDS, "--resume", *words)


def newest(runs: Path) -> Path:
    return checkpoint_folder.path_of(folder(runs) / "checkpoints", checkpoints(runs)[-1])


def content(place: Path) -> dict[str, bytes]:
    found = {str(f.relative_to(place)): f for f in place.rglob("*") if f.is_file()}
    return {name: file.read_bytes() for name, file in found.items() if ".lock" not in name}


# --- whose file it is ---


def test_a_lost_config_is_not_replaced_by_another(stopped, capsys):
    (folder(stopped) / "config.json").unlink()
    before = content(folder(stopped))
    for words in (["--ppo.gamma", "0.5", "--resume"], ["--resume"], []):
        assert "its config.json is gone" in refused(capsys, start(stopped, *WORDS, *words))
    assert content(folder(stopped)) == before


def test_another_seeds_checkpoint_is_refused(stopped, whole, capsys):  # noqa: F811
    start(stopped, *WORDS, "--seed", "2")
    capsys.readouterr()
    foreign = folder(stopped, "seed2") / "checkpoints" / f"{12:012d}"
    there = folder(stopped) / "checkpoints" / foreign.name
    shutil.copytree(foreign, there)
    said = refused(capsys, go_on(stopped))
    assert str(there) in said and "seed 2" in said and "move it out of the folder" in said
    shutil.rmtree(there)
    assert go_on(stopped) == SUCCESS
    assert lines(stopped) == lines(whole)


def test_a_checkpoint_under_other_settings_is_refused(stopped, capsys):
    start(stopped, *WORDS, "--name", "other", "--ppo.gamma", "0.5")
    facts = folder(stopped, "other") / "manifest.json"
    mine = json.loads((folder(stopped) / "manifest.json").read_text())["run_id"]
    facts.write_text(json.dumps(json.loads(facts.read_text()) | {"run_id": mine}))
    (folder(stopped, "other") / "metrics.jsonl").unlink()
    other = folder(stopped, "other") / "checkpoints" / f"{12:012d}"
    meta = json.loads((other / "meta.json").read_text())
    meta["run"]["run_id"] = mine
    del meta["meta_sha256"]
    meta["meta_sha256"] = checkpoint_folder.hash_meta(meta)
    (other / "meta.json").write_text(json.dumps(meta))
    shutil.copytree(other, folder(stopped) / "checkpoints" / other.name)
    capsys.readouterr()
    assert "under other settings or conditions" in refused(capsys, go_on(stopped))


def test_a_renamed_checkpoint_is_refused(stopped, capsys):
    newest(stopped).rename(newest(stopped).with_name(f"{11:012d}"))
    said = refused(capsys, go_on(stopped))
    assert "has been renamed" in said


@pytest.mark.slow
@pytest.mark.parametrize("name", ["config.json", "manifest.json", "experiment.py"])
def test_a_file_that_the_run_did_not_write_so_is_named(stopped, capsys, name):
    file = folder(stopped) / name
    old = '"gamma": 0.99' if name == "config.json" else '"num_shards": 1'
    new = old.replace("0.99", "0.98").replace("1", "2") if name != "experiment.py" else ""
    text = file.read_text()
    file.write_text(text.replace(old, new) if new else text + "\n# edited\n")
    assert file.read_text() != text
    assert "is not what the run wrote" in refused(capsys, go_on(stopped))


def cut_a_line(text: str) -> str:
    kept = text.splitlines(keepends=True)
    return "".join(kept[:2] + kept[3:])


DAMAGE = {
    "a digit": lambda text: text.replace('"steps": 96', '"steps": 97'),
    "a line removed": cut_a_line,
    "a line twice": lambda text: text.splitlines(keepends=True)[0] + text,
    "a line overwritten": lambda text: "x" * 40 + text[40:],
    "cut": lambda text: text[: len(text) // 2],
    "gone": lambda text: None,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGE)
def test_metrics_that_the_run_did_not_write_are_refused(stopped, capsys, name, whole):  # noqa: F811
    file = folder(stopped) / "metrics.jsonl"
    text = file.read_text()
    new = DAMAGE[name](text)
    assert new != text
    file.unlink() if new is None else file.write_text(new)
    said = refused(capsys, go_on(stopped))
    assert "metrics.jsonl is not what the run wrote" in said and "--allow-changes" in said
    assert (file.read_text() if new is not None else None) == new  # nothing was changed
    file.write_text(text)
    assert go_on(stopped) == SUCCESS
    assert lines(stopped) == lines(whole)


@pytest.mark.slow
@pytest.mark.parametrize("name", DAMAGE)
def test_a_run_whose_metrics_were_lost_goes_on_when_told_to(stopped, capsys, name, whole):  # noqa: F811
    file = folder(stopped) / "metrics.jsonl"
    new = DAMAGE[name](file.read_text())
    file.unlink() if new is None else file.write_text(new)
    assert go_on(stopped, "--allow-changes") == SUCCESS
    assert "its whole lines are kept" in capsys.readouterr().out
    assert digest(stopped) == digest(whole)
    assert {json.dumps(x) for x in lines(stopped)} & {json.dumps(x) for x in lines(whole)}
    (facts,) = json.loads((folder(stopped) / "manifest.json").read_text())["allowed_changes"]
    assert "metrics.jsonl" in facts["changes"][0]


def test_checkpoints_that_were_deleted_are_not_begun_anew(stopped, capsys):
    shutil.rmtree(folder(stopped) / "checkpoints")
    before = content(folder(stopped))
    assert "nothing to go on from" in refused(capsys, go_on(stopped))
    assert content(folder(stopped)) == before


def test_leaves_that_look_alike_stay_apart():
    state = {"foot": {"left": jnp.float32(1)}, "foot/left": jnp.float32(2), "foot~1": jnp.zeros(2)}
    leaves = state_arrays.flatten(state)
    assert len(leaves) == 3
    changed = state | {"foot": {"left": jnp.float32(3)}}
    assert state_arrays.digest_leaves(state_arrays.flatten(changed)) != state_arrays.digest_leaves(
        leaves
    )
    rebuilt = state_arrays.unflatten(leaves, state)
    assert rebuilt["foot"]["left"] == 1 and rebuilt["foot/left"] == 2


# --- what has no checkpoint ---


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--resume"]])
def test_a_mistake_found_late_does_not_block_its_own_correction(tmp_path, whole, stop_after, more):  # noqa: F811
    stop_after(0)
    start(tmp_path, *WORDS, "--ppo.gamma", "0.5", "--num-shards", "2")
    assert (folder(tmp_path) / "config.json").exists() and checkpoints(tmp_path) == []
    stop_after(10**9)
    assert start(tmp_path, *WORDS, *more) == SUCCESS
    assert lines(tmp_path) == lines(whole)


# --- what cannot be read is not damaged ---


def no_orbax(monkeypatch):
    imported = builtins.__import__

    def broken(name, *arguments, **options):
        if name.startswith("orbax"):
            raise ImportError("libtensorstore.so: cannot open shared object file")
        return imported(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", broken)


def too_many_files(monkeypatch):
    opened = os.open

    def refuse(path, *how, **more):
        if "/checkpoints/0" in str(path):
            raise OSError(errno.EMFILE, "Too many open files", str(path))
        return opened(path, *how, **more)

    monkeypatch.setattr(os, "open", refuse)


def no_memory(monkeypatch):
    def refuse(*_):
        raise MemoryError("cannot allocate 20 GiB")

    monkeypatch.setattr(array_files, "read", refuse)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [no_orbax, too_many_files, no_memory])
def test_a_fault_in_reading_puts_nothing_aside(stopped, whole, monkeypatch, capsys, fault):  # noqa: F811
    before = content(folder(stopped))
    with monkeypatch.context() as patched:
        fault(patched)
        assert "cannot be read" in refused(capsys, go_on(stopped))
    assert content(folder(stopped)) == before
    assert go_on(stopped) == SUCCESS
    assert lines(stopped) == lines(whole)


def test_what_was_set_aside_is_looked_at_again(stopped, whole, capsys):  # noqa: F811
    good = newest(stopped)
    good.rename(good.with_name(f"damaged-0-{good.name}"))
    assert go_on(stopped) == SUCCESS
    assert "is whole after all" in capsys.readouterr().out
    assert lines(stopped) == lines(whole)


def test_folders_made_by_hand_are_no_checkpoints(stopped, whole):  # noqa: F811
    (folder(stopped) / "checkpoints" / "99").mkdir()
    (folder(stopped) / "checkpoints" / "notes").mkdir()
    assert go_on(stopped) == SUCCESS
    assert lines(stopped) == lines(whole)
    assert (folder(stopped) / "checkpoints" / "99").is_dir()


# --- faults that pass, and those that do not ---


def test_one_failure_to_save_is_made_good_at_once(tmp_path, whole, monkeypatch, capsys):  # noqa: F811
    """As when the clock is set forward by hours: what waits inside of Orbax then times out."""
    write, failed = array_files.write, []

    def once(place, arrays):
        if not failed:
            failed.append(place)
            raise TimeoutError("Timed out after 7200 seconds.")
        return write(place, arrays)

    monkeypatch.setattr(array_files, "write", once)
    assert start(tmp_path, *WORDS) == SUCCESS
    assert "could not be saved" not in capsys.readouterr().out
    assert failed and checkpoints(tmp_path) == checkpoints(whole)
    assert lines(tmp_path) == lines(whole)


@pytest.mark.slow
@pytest.mark.parametrize("step", [7_200.0, -7_200.0, 30 * 365 * 86_400.0])
def test_a_clock_that_is_set_changes_nothing(tmp_path, whole, monkeypatch, step):  # noqa: F811
    clock, calls = time.time, []

    def stepped():
        calls.append(None)
        return clock() + (step if len(calls) > 40 else 0.0)

    monkeypatch.setattr(time, "time", stepped)
    assert start(tmp_path, *WORDS) == SUCCESS
    assert len(calls) > 40 and lines(tmp_path) == lines(whole)


def test_a_run_that_is_moved_while_it_trains_says_so(tmp_path, monkeypatch, capsys):
    save = checkpoint.save

    def move(where, leaves, meta):
        path = save(where, leaves, meta)
        if meta["update"] == 3:
            folder(tmp_path).rename(tmp_path / "elsewhere")
        return path

    monkeypatch.setattr(checkpoint, "save", move)
    assert start(tmp_path, *WORDS) == FAILURE
    said = capsys.readouterr()
    assert "has been moved or removed" in said.err and "Done" not in said.out
    (tmp_path / "elsewhere").rename(folder(tmp_path))
    assert go_on(tmp_path) == SUCCESS


def test_metrics_that_are_removed_while_the_run_writes_them_end_it(tmp_path, monkeypatch, capsys):
    save = checkpoint.save

    def remove(where, leaves, meta):
        (where.parent / "metrics.jsonl").unlink(missing_ok=True)
        return save(where, leaves, meta)

    monkeypatch.setattr(checkpoint, "save", remove)
    assert start(tmp_path, *WORDS) == FAILURE
    assert "metrics.jsonl has been removed or replaced" in capsys.readouterr().err


def test_a_deleted_lock_file_lets_nobody_in(tmp_path):
    held = FolderLock(tmp_path / "run")
    (tmp_path / "run" / ".lock").unlink()
    with pytest.raises(UserError, match=f"process (unknown|{os.getpid()})"):
        FolderLock(tmp_path / "run")
    held.close()
    FolderLock(tmp_path / "run").close()


def test_who_only_looks_whether_a_run_is_locked_keeps_nobody_out(tmp_path):
    """A look holds the lock for a moment, which the one who wants to train waits for."""
    held = FolderLock(tmp_path / "run")
    threading.Timer(0.2, held.close).start()
    with pytest.raises(UserError):
        FolderLock(tmp_path / "run", patience=0.0)
    FolderLock(tmp_path / "run").close()


@pytest.mark.parametrize("refuses", ["folders", "everything"])
def test_a_file_system_without_locks_is_used_all_the_same(tmp_path, monkeypatch, refuses):
    import fcntl

    real = fcntl.flock

    def flock(handle, how):
        if refuses == "everything" or os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(errno.EBADF, "Bad file descriptor")
        real(handle, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    held = FolderLock(tmp_path / "run")
    assert held.locks == (refuses == "folders")
    if held.locks:
        with pytest.raises(UserError, match=f"process {os.getpid()}"):
            FolderLock(tmp_path / "run")
    held.check()
    (tmp_path / "run").rename(tmp_path / "away")
    with pytest.raises(RunError, match="moved or removed"):
        held.check()


def test_a_file_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "x.json"
    files.write_json(path, {"a": 1})

    def refuse(handle):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(UserError, match="x.json cannot be written: Input/output error"):
        files.write_json(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 1}


def test_what_cannot_be_raised_is_told_while_python_ends(monkeypatch):
    monkeypatch.setattr(array_files, "sys", None)  # as modules are then
    late, other = (types.SimpleNamespace(exc_value=e) for e in ("Event loop is closed", "other"))
    array_files._print_unraisable(late)  # not told
    with pytest.raises(TypeError, match="UnraisableHookArgs"):  # of Python
        array_files._print_unraisable(other)


def test_the_hash_of_files_is_that_of_their_bytes(tmp_path):
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "f").write_bytes(b"abc")
    assert files.hash_files(tmp_path) == {"d/f": hashlib.sha256(b"abc").hexdigest()}
