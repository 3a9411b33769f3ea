"""`import purerl`: the names that users get, and what imports only them."""

import ast
import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import purerl
from purerl import __main__ as commands

ROOT = Path(__file__).parent.parent
NAMES = [
    "Array", "Config", "Env", "EnvError", "Evaluation", "Experiment", "Network", "Normal",
    "Physics", "PhysicsState", "Policy", "PolicyOutput", "PyTree", "Run", "RunError", "State",
    "StoppedError", "UserError", "adapters", "check_env", "choose_engine", "exact", "find",
    "load", "lookup", "networks", "overflow_metric", "overflow_reading", "planner",
    "train",
]  # fmt: skip
MODULES = {"adapters", "exact", "lookup", "networks", "planner"}
BESIDE = ("purerl.envs", "purerl.experiments")  # of this repository, as these files themselves
# They measure the insides.
INSIDERS = {"benchmarks", "peers"}


def fresh(code: str) -> str:
    """Runs code in a process of its own; returns what it prints."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_these_are_the_public_names():
    assert purerl.__all__ == sorted(NAMES)
    assert set(NAMES) <= set(dir(purerl))
    for name in NAMES:
        assert inspect.ismodule(getattr(purerl, name)) == (name in MODULES), name
        assert re.search(rf"^  [^:]*\b{name}\b", str(purerl.__doc__), re.MULTILINE), name


def test_editors_know_the_same_names_from_the_same_modules():
    said = {}
    for node in ast.parse(Path(purerl.__file__).with_suffix(".pyi").read_text()).body:
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            is_module = alias.name in MODULES
            assert alias.asname == alias.name  # or type checkers take it for private
            said[alias.name] = f"{node.module}.{alias.name}" if is_module else node.module
    assert said == purerl.HOMES


def test_a_public_name_is_no_other_module():
    for name in NAMES:
        place = ROOT / "purerl" / name
        if place.is_dir() or place.with_suffix(".py").exists():
            assert purerl.HOMES[name] == f"purerl.{name}"


def test_importing_it_is_quick_and_starts_no_jax():
    code = "import sys, time; t = time.perf_counter(); import purerl; t = time.perf_counter() - t;"
    said = fresh(code + "print(t, [m for m in ('jax', 'mujoco', 'tyro') if m in sys.modules])")
    seconds, _, heavy = said.partition(" ")
    assert float(seconds) < 0.3 and heavy.strip() == "[]"


def test_a_folder_of_its_name_does_not_hide_it(tmp_path):
    """Such as the clone itself, for who works in the folder that holds it."""
    (tmp_path / "purerl").mkdir()
    elsewhere = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    words = [sys.executable, "-c", "import purerl; print(purerl.__version__)"]
    done = subprocess.run(words, cwd=tmp_path, env=elsewhere, capture_output=True, text=True)
    assert done.stdout == f"{purerl.__version__}\n", done.stderr


def test_lists_and_help_pages_start_no_jax():
    code = "import sys; sys.argv = ['purerl', *{words}]; from purerl.__main__ import main; main();"
    for words in (["--help"], ["run", "--help"], []):
        said = fresh(code.format(words=words) + "print('jax' in sys.modules)")
        assert said.split()[-1] == "False"


def test_the_commands_are_listed_a_line_each_and_called(capsys, tmp_path):
    here = {path.stem for path in (ROOT / "purerl").glob("*.py")} - {"__init__", "__main__"}
    here |= {path.parent.name for path in (ROOT / "purerl").glob("*/__main__.py")}
    assert set(commands.COMMANDS) == here
    assert commands.main(["--help"]) == 0
    lines = capsys.readouterr().out.split("\n\n")[0].splitlines()
    assert [line.split()[0] for line in lines] == list(commands.COMMANDS)
    assert all(len(line.split()) > 3 for line in lines)
    assert commands.main(["evaluate", str(tmp_path)]) == 2
    assert "is no run" in capsys.readouterr().err
    assert commands.main(["evalute"]) == 2
    assert re.search("Did you mean .?evaluate.?\\?", capsys.readouterr().err)


def test_the_console_script_is_the_list_of_commands():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"purerl": "purerl.__main__:console"} and callable(commands.console)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("from purerl.config import Config", "write `from purerl import Config`."),
        ("import purerl.experiment", "write `from purerl import Experiment`."),
        ("from purerl.env import State", "write `from purerl import Env`."),
        ("from purerl.physics import Physics", "write `from purerl import Physics`."),
        ("from purerl.types import Array", "the names to import from purerl are Array, Config"),
        ("from purerl import Confg", "write `from purerl import Config`."),
    ],
)
def test_an_import_that_moved_is_one_line_that_says_what_to_write(line, message):
    with pytest.raises(ModuleNotFoundError, match="has moved, or never was: ") as error:
        exec(line)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_wrong_attribute_is_told_with_the_nearest():
    with pytest.raises(AttributeError, match="no name 'Experimnt': write .*import Experiment`"):
        purerl.Experimnt  # noqa: B018
    assert not hasattr(purerl, "HOME")


def public_files() -> list[Path]:
    files = [*(ROOT / "envs").rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]
    return [file for file in files if not INSIDERS & set(file.parts)]


@pytest.mark.parametrize("file", public_files(), ids=lambda file: str(file.relative_to(ROOT)))
def test_environments_and_experiments_import_the_front_door_and_nothing_deeper(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            assert not [a.name for a in node.names if a.name.startswith("purerl.")]
        if isinstance(node, ast.ImportFrom) and node.module.startswith(BESIDE):
            continue
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "purerl":
            assert node.module == "purerl", f"line {node.lineno}"
            assert {alias.name for alias in node.names} <= set(NAMES), f"line {node.lineno}"


def test_there_are_files_to_check():
    names = {file.name for file in public_files()}
    assert {"ant_run.py", "custom_network.py", "compose.py", "base.py"} <= names
    assert not {"scaling.py", "sb3.py"} & names


def test_the_list_of_experiments_is_what_a_newcomer_wants_to_see():
    from purerl.experiment.loading import available, summary

    names = [name for name, path in available().items() if path.parent == ROOT / "experiments"]
    assert names == [
        "cartpole_swingup", "ant_run", "ant_gaps", "rodent_run", "rodent_gaps", "suite",
        "suite_gpu", "suite_humanoid", "custom_network",
    ]  # fmt: skip
    assert all(len(summary(available()[name])) < 90 for name in names)
