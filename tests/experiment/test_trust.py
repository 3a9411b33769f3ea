"""A run's folder from a stranger: what of it is executed."""

# ruff: noqa: F811 (fixtures of another file)
import hashlib
import json
import py_compile
import sys
from pathlib import Path

import pytest

import purerl
from purerl import compare, evaluate, record, render, run
from purerl.core.errors import SUCCESS, USAGE
from purerl.experiment import trust
from tests.runs.test_foreign_files import (  # noqa: F401
    FEW,
    TOY,
    change,
    given,
    only_line,
    trained,
)

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    """A home in which nothing has been trained."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def stranger(given) -> Path:
    """A run whose code leaves a mark when executed; the original that it names came along."""
    text = (given / "experiment.py").read_text() + f"open({str(mark(given))!r}, 'w').close()\n"
    for file in (given / "experiment.py", given.with_name("original.py")):
        file.write_text(text)
    change(given / "manifest.json", experiment_file=str(given.with_name("original.py")))
    return given


def mark(folder: Path) -> Path:
    return folder.with_name("executed")


@pytest.mark.parametrize("command", [evaluate, record, render], ids=lambda c: c.__name__)
def test_a_strangers_code_is_not_executed(stranger, capsys, command):
    assert command.main([str(stranger)]) == USAGE
    said = only_line(capsys)
    assert not mark(stranger).exists()
    assert said.endswith(
        f"{stranger} holds code of its own, experiment.py, that is not known on this machine: read "
        "it, then add --trust (in Python: trust=True)."
    )


def test_neither_from_python_nor_by_looking_at_it(stranger):
    found = purerl.load(stranger)
    assert found.metrics()["update"][-1] == 12
    with pytest.raises(purerl.UserError, match="trust=True"):
        found.policy  # noqa: B018
    assert compare.main([str(stranger)]) == SUCCESS
    assert not mark(stranger).exists()


def test_trust_is_given_once(stranger, home):
    assert evaluate.main([str(stranger), *FEW, "--trust"]) == SUCCESS
    assert mark(stranger).exists()
    assert evaluate.main([str(stranger), *FEW]) == SUCCESS
    text = (stranger / "experiment.py").read_bytes()
    (line,) = (home / "purerl" / "trusted").read_text().splitlines()
    assert line.split()[0] == hashlib.sha256(text).hexdigest()
    (stranger / "experiment.py").write_bytes(text + b"\n")  # it is other code now
    assert evaluate.main([str(stranger), *FEW]) == USAGE
    assert purerl.load(stranger, trust=True).update == 12


def test_who_edits_an_experiment_still_evaluates_its_old_runs(tmp_path):
    file = tmp_path / "edited.py"
    file.write_text(TOY.read_text() + "# as it was trained\n")
    assert run.main([str(file), "--runs", str(tmp_path)]) == SUCCESS
    file.write_text("raise SystemExit('another experiment')\n")
    assert evaluate.main([str(tmp_path / "edited" / "seed1"), *FEW]) == SUCCESS


def test_an_experiment_of_the_folder_experiments_is_known(given, home, tmp_path, monkeypatch):
    assert evaluate.main([str(given), *FEW]) == USAGE
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").mkdir()
    named = Path("experiments", "mine.py")
    named.write_bytes((given / "experiment.py").read_bytes() + b"\n")
    assert evaluate.main([str(given), *FEW]) == USAGE
    named.write_bytes((given / "experiment.py").read_bytes())
    assert evaluate.main([str(given), *FEW]) == SUCCESS
    assert not home.exists()


def test_compiled_code_beside_a_known_experiment_is_not_executed(given):
    """Python would take it instead of the text, whatever the text is."""
    evil = given / "evil.py"
    evil.write_text(f"open({str(mark(given))!r}, 'w').close()\n" + TOY.read_text())
    cache = given / "__pycache__" / f"experiment.{sys.implementation.cache_tag}.pyc"
    unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
    py_compile.compile(str(evil), str(cache), invalidation_mode=unchecked)
    assert evaluate.main([str(given), *FEW]) == SUCCESS
    assert not mark(given).exists()


def test_known_code_reads_beside_where_it_was_known_not_where_a_stranger_says(
    given, trained, tmp_path
):
    (tmp_path / "elsewhere.py").write_bytes((given / "experiment.py").read_bytes())
    change(given / "manifest.json", experiment_file=str(tmp_path / "elsewhere.py"))
    (given / "experiment.py").touch()
    module = purerl.load(given).experiment.build_env.__globals__
    assert module["__file__"] == str(trained.parent.parent / "mine.py")


def test_with_trust_what_stood_beside_a_file_that_is_gone_is_looked_for_in_the_run(
    given, home, tmp_path
):
    """A project's folder was renamed: what its experiment reads is put beside the run's copy."""
    gone = tmp_path / "renamed_since" / "mine.py"
    trust.remember((given / "experiment.py").read_bytes(), gone)
    change(given / "manifest.json", experiment_file=str(gone))
    places = [
        purerl.load(given, trust=trust).experiment.build_env.__globals__["__file__"]
        for trust in (False, True, False)
    ]
    here = str((given / "experiment.py").resolve())
    assert places == [str(gone), here, here]


def test_with_trust_a_project_that_moved_with_its_runs_is_found_from_its_folder(
    given, home, tmp_path, monkeypatch
):
    name = json.loads((given / "config.json").read_text())["experiment"]
    change(given / "manifest.json", experiment_file=str(tmp_path / "renamed_since" / f"{name}.py"))
    (tmp_path / "project").mkdir()
    monkeypatch.chdir(tmp_path / "project")
    file = Path(f"{name}.py")
    for text, place in [
        (b"other = 1\n", given / "experiment.py"),  # another file of that name
        ((given / "experiment.py").read_bytes(), file),
    ]:
        file.write_bytes(text)
        loaded = purerl.load(given, trust=True).experiment.build_env.__globals__
        assert loaded["__file__"] == str(place.absolute())
        (home / "purerl" / "trusted").unlink()


def test_a_link_to_a_run_is_a_run_and_a_link_to_code_is_none(given, tmp_path, capsys):
    (tmp_path / "link").symlink_to(given)
    assert evaluate.main([str(tmp_path / "link"), *FEW]) == SUCCESS
    capsys.readouterr()
    (given / "experiment.py").rename(tmp_path / "outside.py")
    (given / "experiment.py").symlink_to(tmp_path / "outside.py")
    assert evaluate.main([str(given), *FEW, "--trust"]) == USAGE
    assert "leaves the run's folder" in only_line(capsys)


@pytest.mark.slow
def test_a_home_that_cannot_be_written_to_stops_no_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_STATE_HOME", "/dev/null/none")
    trained = purerl.train(TOY, {"ppo.num_steps": 32}, runs=tmp_path)
    assert trained.update == 1  # what this process has trained it may execute
    monkeypatch.setenv("XDG_STATE_HOME", "")
    monkeypatch.setattr(Path, "home", lambda: Path("/proc/none"))
    assert run.main([str(TOY), "--runs", str(tmp_path), "--name", "other"]) == SUCCESS
    assert "known on this machine" not in capsys.readouterr().err


def test_resuming_executes_the_named_file_and_not_the_copy(stranger, tmp_path, capsys):
    place = tmp_path / "toy_experiment"
    place.mkdir()
    stranger.rename(place / "seed1")
    assert run.main([str(TOY), "--runs", str(tmp_path), "--resume"]) == USAGE
    assert "experiment.py: " in capsys.readouterr().err
    words = [str(TOY), "--runs", str(tmp_path), "--resume", "--allow-changes"]
    assert run.main(words) == SUCCESS
    assert not mark(stranger).exists()


def test_no_name_adds_to_what_is_known(home):
    evil = b"import evil\n"
    line = f'{hashlib.sha256(evil).hexdigest()}  "/evil.py"'
    trust.remember(b"import good\n", Path(f"runs\n{line}\n"))
    trust.remember(b"import good\n", Path(f"runs\n{line}\n"))
    assert not trust.known_places(evil, "none")
    assert trust.known_places(b"import good\n", "none") == [Path(f"runs\n{line}\n")]
    list_ = home / "purerl" / "trusted"
    assert len(list_.read_text().splitlines()) == 1
    list_.write_bytes(b"\xff\xfe \n\n7\n" + hashlib.sha256(evil).hexdigest().encode() + b" {\n")
    assert not trust.known_places(evil, "none")
