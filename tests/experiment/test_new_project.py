"""`python -m purerl.new NAME`: what it refuses, and that what it writes works."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from purerl import new
from purerl.experiment.new_project import write_project
from tests import quick

ROOT = Path(new.__file__).parent.parent


@pytest.fixture
def inside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my-arm", "name is 'my-arm'; it must be a Python name"),
        ("class", "name is 'class'; it must be a Python name"),
        ("nowhere/arm", "there is no folder nowhere"),
        ("here", "here exists: choose another name"),
    ],
)
def test_what_it_refuses_in_one_line(inside, capsys, name, said):
    (inside / "here").mkdir()
    assert new.main([name]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert os.listdir(inside) == ["here"], "nothing half made is left"


def test_its_files_bear_its_name(inside):
    files = write_project(Path("crane"))
    assert {f.name for f in files} == {path.name for path in Path("crane").iterdir()}
    texts = [file.read_text() for file in files]
    assert not any("NAME" in text for text in texts)
    assert files[0].read_text().startswith("# crane\n")
    lint = [sys.executable, "-m", "ruff", "check", "--isolated", "--line-length", "100", "."]
    assert subprocess.run(lint, cwd="crane").returncode == 0


def said(project, module, *words):
    """Returns what a command prints in the project's folder; it has to succeed."""
    command = [sys.executable, "-m", module, *words]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "XLA_FLAGS": quick.FLAGS}
    done = subprocess.run(command, capture_output=True, text=True, cwd=project, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_its_own_tests_pass(inside):
    write_project(Path("crane"))
    assert "5 passed" in said("crane", "pytest", "-q", "-p", "no:cacheprovider")


@pytest.mark.slow
def test_it_is_checked_without_a_finding(inside):
    write_project(Path("crane"))
    found = said("crane", "purerl.check", "experiment.py", "--no-speed")
    assert found.endswith("experiment: 0 errors, 0 warnings\n")


@pytest.mark.slow
def test_it_trains(inside):
    write_project(Path("crane"))
    few = ["--ppo.num-steps", "8192", "--evaluation.num-episodes", "4", "--evaluation.number", "1"]
    lines = said("crane", "purerl.run", "experiment.py", *few)
    assert "Done: 8,192 steps" in lines and "warning" not in lines
