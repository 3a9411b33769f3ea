"""Every mistake of the table is one line, which names the wrong value."""

import importlib.util
import shutil
import sys
from pathlib import Path

import jax
import pytest

from purerl.devices import memory
from tests.mistakes.play import Mistake, agree, make, prepare, read_table

TABLE = read_table()
NEED_A_RUN = ("a run", "no onnx", "no h5py", "MUJOCO_GL=glfw", "an unknown run")


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """A folder with a run of mine.py without a mistake."""
    place = tmp_path_factory.mktemp("trained")
    none = Mistake("", "", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        prepare(place, none)
        assert make(none)[0] == 0
    return place


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """An empty folder, in which this process is, and from which it imports."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    yield tmp_path
    sys.modules.pop("mine", None)


def arrange(given: str, place: Path, trained: Path, monkeypatch) -> None:
    """Makes it so that what is given holds."""
    if given in NEED_A_RUN:
        shutil.copytree(trained / "runs", place / "runs")
    if given == "an unknown run":
        monkeypatch.setenv("XDG_STATE_HOME", str(place / "state"))
    if given == "MUJOCO_GL=glfw":
        monkeypatch.setenv("MUJOCO_GL", "glfw")
    if given.startswith("no "):
        find, absent = importlib.util.find_spec, given.removeprefix("no ")
        found = lambda name, *of: None if name.startswith(absent) else find(name, *of)  # noqa: E731
        monkeypatch.setattr("importlib.util.find_spec", found)
    if given == "4 GB of memory":
        monkeypatch.setattr(memory, "room", lambda: 4_000_000_000)
    if given == "a folder with notes.txt":
        (place / "runs/mine/seed1").mkdir(parents=True)
        (place / "runs/mine/seed1/notes.txt").touch()


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize("mistake", TABLE, ids=[f"{m.where}-{m.title}" for m in TABLE])
def test_a_mistake_is_one_line(place, trained, monkeypatch, request, mistake):
    if mistake.says.endswith("`physics` of the type purerl.Physics."):
        request.getfixturevalue("opengl")  # `render` opens it before it reads the run
    arrange(mistake.given, place, trained, monkeypatch)
    prepare(place, mistake)
    x64, no_jit = (mistake.given == f"JAX_{x}=1" for x in ("ENABLE_X64", "DISABLE_JIT"))
    with jax.enable_x64(x64), jax.disable_jit(no_jit):
        code, said = make(mistake)
    assert code == mistake.code
    assert len(said.splitlines()) == 1 and "Traceback" not in said, said
    assert agree(mistake.says, said), said


def test_there_are_many_and_no_two_alike():
    assert len(TABLE) >= 60
    assert len({(mistake.where, mistake.title) for mistake in TABLE}) == len(TABLE)
