"""Checkpoints: exact, checked leaf by leaf, and never trusted when damaged."""

import errno
import hashlib
import math
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.errors import UserError
from purerl.machine import array_files, state_arrays
from purerl.runs import checkpoint, checkpoint_folder


def make_state(number: float = 1.0):
    return {
        "params": {"w.x": jnp.full((30, 4), number), "half": jnp.ones(3, jnp.bfloat16)},
        "key": jax.random.key(3),
        "keys": jax.random.split(jax.random.key(4), 2),
        "empty": jnp.zeros((0, 3)),
        "counts": (jnp.int32(7), None, jnp.bool_(True), jnp.uint32(2**32 - 1)),
    }


def abstract():
    return jax.eval_shape(make_state)


def digest(state) -> str:
    return state_arrays.digest_leaves(state_arrays.flatten(state))


def save(
    folder: Path, update: int, number: float | None = None, score: float | None = None, **more
):
    leaves = state_arrays.flatten(make_state(float(update) if number is None else number))
    meta = {"update": update, "digest": state_arrays.digest_leaves(leaves), "eval_return": score}
    meta |= {"steps": 8 * update, "wall_s": 0.5, "metrics_bytes": 0, "metrics_sha256": ""}
    return checkpoint.save(folder, leaves, meta | more)


def largest_file(path: Path) -> Path:
    """Returns the file with the arrays of a checkpoint."""
    return max(
        (f for f in (path / "state").rglob("*") if f.is_file()), key=lambda f: f.stat().st_size
    )


def test_a_state_comes_back_bit_for_bit(tmp_path):
    state = make_state(0.1)
    saved = checkpoint.load_checkpoint(save(tmp_path, 5, 0.1), abstract())
    assert saved.meta["update"] == 5
    assert jax.tree.structure(saved.state) == jax.tree.structure(state)
    assert digest(saved.state) == digest(state) == saved.meta["digest"]
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(saved.state), strict=True):
        assert old.dtype == new.dtype and old.shape == new.shape
    draw = jax.random.normal(state["key"], (3,))
    np.testing.assert_array_equal(draw, jax.random.normal(saved.state["key"], (3,)))


def test_the_digest_is_what_its_definition_says():
    leaves = {"b": np.arange(3, dtype=np.int32), "a": np.zeros((2, 0), np.float32)}
    text = b"a\0float32\0(2, 0)\0" + b"b\0int32\0(3,)\0" + np.arange(3, dtype=np.int32).tobytes()
    assert state_arrays.digest_leaves(leaves) == hashlib.sha256(text).hexdigest()


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s | {"counts": (jnp.int32(8), *s["counts"][1:])},
        lambda s: s | {"key": jax.random.key(4)},
        lambda s: s | {"key": jax.random.key(3, impl="rbg")},
        lambda s: s | {"empty": jnp.zeros((0, 4))},
        lambda s: s | {"counts": (jnp.uint32(7), *s["counts"][1:])},
        lambda s: {("other" if k == "keys" else k): v for k, v in s.items()},
    ],
)
def test_the_digest_sees_every_kind_of_change(change):
    assert digest(change(make_state())) != digest(make_state())


def test_flatten_copies():
    # On a CPU a jax.Array hands out a read-only view of its buffer, which donation may overwrite.
    for path, array in state_arrays.flatten(make_state()).items():
        assert array.flags.owndata and array.flags.writeable, path


def test_a_bit_flipped_after_reading_is_noticed_and_its_leaf_named(tmp_path, monkeypatch):
    # The files are whole, so it is the memory, or Orbax: nothing is damaged.
    path = save(tmp_path, 1)
    read = array_files.read

    def flipped(*arguments):
        leaves = read(*arguments)
        leaves["params/w.x"].view(np.uint8).reshape(-1)[17] ^= 4
        return leaves

    monkeypatch.setattr(array_files, "read", flipped)
    with pytest.raises(UserError, match="params/w.x"):
        checkpoint.load_checkpoint(path, abstract())


def test_a_checkpoint_that_a_run_deletes_meanwhile_is_no_damage(tmp_path, monkeypatch):
    said, read = [], array_files.read
    old, new = save(tmp_path, 1), save(tmp_path, 2)
    new.rename(tmp_path / "new")

    def late(*arguments):
        if old.exists():  # the run that goes on saves, and deletes what is being read
            (tmp_path / "new").rename(new)
            shutil.rmtree(old)
        return read(*arguments)

    monkeypatch.setattr(array_files, "read", late)
    (found,) = checkpoint.newest([tmp_path], abstract(), said.append, rename=False)
    assert found.meta["update"] == 2 and said == []


def test_no_flipped_bit_of_any_file_is_taken(tmp_path):
    path = save(tmp_path, 1)
    random = np.random.default_rng(0)
    for file in sorted(f for f in path.rglob("*") if f.is_file()):
        content = file.read_bytes()
        for place in random.integers(len(content) * 8, size=4):
            damaged = bytearray(content)
            damaged[place // 8] ^= 1 << (place % 8)
            file.write_bytes(damaged)
            with pytest.raises(checkpoint_folder.DamagedError, match=file.name):
                checkpoint.load_checkpoint(path, abstract())
        file.write_bytes(content)
    assert digest(checkpoint.load_checkpoint(path, abstract()).state) == digest(make_state(1.0))


def damage_cut(path: Path):
    file = largest_file(path)
    file.write_bytes(file.read_bytes()[:10])


def damage_meta(path: Path):
    file = path / "meta.json"
    file.write_text(file.read_text().replace('"update": 2', '"update": 3'))


def damage_no_meta(path: Path):
    (path / "meta.json").unlink()


def damage_empty(path: Path):
    shutil.rmtree(path)
    path.mkdir()


@pytest.mark.parametrize("damage", [damage_cut, damage_meta, damage_no_meta, damage_empty])
def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_used(tmp_path, damage):
    save(tmp_path, 1)
    damage(save(tmp_path, 2))
    said = []
    (saved,) = checkpoint.newest([tmp_path], abstract(), said.append)
    assert saved.meta["update"] == 1
    assert digest(saved.state) == digest(make_state(1.0))
    assert len(said) == 1 and "update 2" in said[0] and "damaged-0-000000000002" in said[0]
    assert checkpoint_folder.updates(tmp_path) == [1]
    assert (tmp_path / "damaged-0-000000000002").is_dir()


def test_a_reader_sets_nothing_aside(tmp_path):
    damage_cut(save(tmp_path, 2))
    assert checkpoint.newest([tmp_path], abstract(), print, rename=False) == []
    assert checkpoint_folder.updates(tmp_path) == [2]


def test_another_state_is_refused_with_the_leaf(tmp_path):
    path = save(tmp_path, 1)
    other = jax.eval_shape(lambda: make_state() | {"empty": jnp.zeros((2, 3))})
    with pytest.raises(UserError, match="leaf empty is .*0, 3.* in it and .*2, 3"):
        checkpoint.load_checkpoint(path, other)


def test_the_newest_and_the_best_are_kept(tmp_path):
    for update, score in [(1, None), (2, 9.0), (3, 1.0), (4, None), (5, 2.0)]:
        save(tmp_path, update, score=score)
    checkpoint_folder.retain(tmp_path, 2)
    assert checkpoint_folder.updates(tmp_path) == [2, 4, 5]
    assert checkpoint_folder.best_by_stage(tmp_path) == {None: (9.0, 2)}
    assert not list(tmp_path.glob(".deleting*"))


def test_the_best_of_each_stage_is_kept_and_the_last_stage_tells_which_is_best(tmp_path):
    """Its return was doubled until update 3, where --allow-changes let another reward pass."""
    stages = [(1, 50.0, "a"), (2, 80.0, "a"), (3, 60.0, "a"), (4, 30.0, "b"), (5, 20.0, "b")]
    for update, score, stage in [*stages, (6, None, "b")]:
        save(tmp_path, update, score=score, run={"fingerprint": stage})
    checkpoint_folder.retain(tmp_path, 1)
    assert checkpoint_folder.updates(tmp_path) == [2, 4, 6]
    found = checkpoint_folder.best_by_stage(tmp_path)
    assert list(found.items()) == [("a", (80.0, 2)), ("b", (30.0, 4))]


def test_a_stage_without_an_evaluation_has_no_best(tmp_path):
    for update, score, stage in [(1, 50.0, "a"), (2, None, "b")]:
        save(tmp_path, update, score=score, run={"fingerprint": stage})
    assert [*checkpoint_folder.best_by_stage(tmp_path).values()][-1] == (-math.inf, 2)


def test_of_seeds_together_those_are_kept_that_all_have(tmp_path):
    ahead, behind = tmp_path / "ahead", tmp_path / "behind"
    ahead.mkdir()
    behind.mkdir()
    for update in (1, 2, 3, 4):
        save(ahead, update)
    for update in (1, 2):
        save(behind, update)
    for folder in (ahead, behind):
        checkpoint_folder.retain(folder, 1, [ahead, behind])
    assert checkpoint_folder.updates(ahead) == [2, 3, 4] and checkpoint_folder.updates(behind) == [
        2
    ]
    found = checkpoint.newest([ahead, behind], abstract(), print)
    assert [saved.meta["update"] for saved in found] == [2, 2]
    checkpoint_folder.forget_after(ahead, 2)
    assert checkpoint_folder.updates(ahead) == [2]
    damage_cut(behind / f"{2:012d}")
    assert checkpoint.newest([ahead, behind], abstract(), print) == []
    assert checkpoint_folder.updates(ahead) == [2]


def test_a_failed_save_leaves_nothing_and_the_older_one_whole(tmp_path, monkeypatch):
    save(tmp_path, 1)
    (tmp_path / ".deleting-000000000000").mkdir()  # of an earlier crash

    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint.files, "sync_tree", full)
    with pytest.raises(OSError, match="No space"):
        save(tmp_path, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000000001"]


def test_what_orbax_did_not_write_is_no_checkpoint(tmp_path, monkeypatch):
    """It leaves out arrays, without an error, if a folder cannot be listed while it merges."""
    save(tmp_path, 1)
    write = array_files.write

    def partly(folder, arrays):
        write(folder, {name: array for name, array in arrays.items() if name != "params/half"})

    monkeypatch.setattr(array_files, "write", partly)
    with pytest.raises(Exception, match="params/half"):
        save(tmp_path, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["000000000001"]
