"""`import purerl`: the names that users get, and what imports only them."""

import ast
import importlib.util
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
MODULES = {"adapters", "clips", "exact", "eyes", "lookup", "networks", "planner"}
BESIDE = ("purerl.envs", "purerl.experiments")  # of this repository, as these files themselves
NAMES = purerl.__all__
# They measure the insides.
INSIDERS = {"benchmarks", "peers"}


def fresh(code: str) -> str:
    """Runs code in a process of its own; returns what it prints."""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_each_name_of_the_stub_is_what_its_line_imports():
    assert {"train", "Run", "Config", "check_env", "init", "update", "TrainState"} < set(NAMES)
    assert set(NAMES) <= set(dir(purerl))
    # Each in a process that has not imported it: one name may bring another's module.
    code = "import sys, purerl; print(type(getattr(purerl, sys.argv[1])).__name__)"
    for name in NAMES:
        said: dict = {}
        exec(f"from {purerl.HOMES[name]} import {name}", said)
        assert getattr(purerl, name) is said[name], name
        assert inspect.ismodule(said[name]) == (name in MODULES), name
    for name in ("lookup", "planner", "adapters"):
        done = subprocess.run([sys.executable, "-c", code, name], capture_output=True, text=True)
        assert done.stdout == "module\n", done.stderr


def test_type_checkers_take_each_line_of_the_stub_for_public():
    """They do if a name is imported as itself."""
    for package in (purerl, purerl.adapters, purerl.clips, purerl.exact):
        tree = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
        lines = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        names = {alias.name: alias.asname for line in lines for alias in line.names}
        assert all(name == its_name for name, its_name in names.items())
        assert sorted(names) == package.__all__


def test_a_public_name_is_no_other_module():
    """Or importing that module, as the command `evaluate`, would take the name's place."""
    for name in NAMES:
        place = ROOT / "purerl" / name
        if place.is_dir() or place.with_suffix(".py").exists():
            assert purerl.HOMES[name] == "purerl"


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


def test_the_version_is_printed(capsys):
    assert commands.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{purerl.__version__}\n"


def test_the_console_script_is_the_list_of_commands():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"purerl": "purerl.__main__:console"} and callable(commands.console)


def test_the_console_script_finds_what_is_here_and_hides_nothing_behind_it(tmp_path):
    (tmp_path / "mine.py").write_text("import beside\nfrom purerl import networks\n")
    (tmp_path / "beside.py").write_text("print('beside is found')\n")
    for decoy in ("typing_extensions", "rich", "jax", "statistics"):  # what is imported later
        (tmp_path / decoy).mkdir()
        (tmp_path / decoy / "__init__.py").write_text("raise SystemExit('the decoy')\n")
    code = "import sys; from purerl.__main__ import console; sys.argv[0] = 'purerl'; console()"
    words = [sys.executable, "-P", "-c", code, "run", "mine.py"]  # -P: as a script in bin/ begins
    path = str(ROOT)
    there = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(words, cwd=tmp_path, env=there, capture_output=True, text=True)
    assert done.stdout == "beside is found\n"
    assert (
        done.stderr
        == f"purerl: {tmp_path}/mine.py defines no `experiment = Experiment(...)` "
        + ("(it is None).\n")
    )


@pytest.mark.parametrize(
    ("line", "said", "hint"),
    [
        ("from purerl.config import Config", "No module named 'purerl.config'", "Config"),
        ("import purerl.lookups", "No module named 'purerl.lookups'", "lookup"),
        ("from purerl.env import State", "No module named 'purerl.env'", "Env"),
        ("from purerl.physics import Physics", "name 'Physics' from 'purerl.physics'", "Physics"),
        ("from purerl import Confg", "cannot import name 'Confg' from 'purerl'", "Config"),
        ("from purerl.ppo.config import Confg", "name 'Confg' from 'purerl.ppo.config'", "Config"),
    ],
)
def test_a_wrong_import_in_a_file_that_is_loaded_says_what_to_write(tmp_path, line, said, hint):
    """In plain Python it brings the ImportError of Python's own."""
    with pytest.raises(ImportError, match=said):
        exec(line)
    (tmp_path / "mine.py").write_text(f"# mine\n{line}\n")
    with pytest.raises(purerl.UserError) as error:
        purerl.find(str(tmp_path / "mine.py"))
    told = f"{tmp_path}/mine.py, line 2: "
    assert str(error.value).startswith(told) and said in str(error.value)
    assert str(error.value).endswith(f"; write `from purerl import {hint}`")


def test_what_is_like_no_name_brings_the_list_of_names(tmp_path):
    (tmp_path / "mine.py").write_text("from purerl.typing import Tensor\n")
    with pytest.raises(purerl.UserError, match="names to import from purerl are Array, Config, "):
        purerl.find(str(tmp_path / "mine.py"))


@pytest.mark.parametrize("package", ["envs", "experiments"])
def test_our_packages_are_named_whole_where_the_user_has_none(tmp_path, monkeypatch, package):
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p not in ("", str(ROOT))])
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, package, raising=False)
    (tmp_path / "mine.py").write_text(f"from {package} import cartpole_swingup\n")
    with pytest.raises(purerl.UserError) as error:
        purerl.find("mine.py")
    assert str(error.value).endswith(
        f"No module named '{package}'; write `from purerl.{package} import ...`"
    )
    (tmp_path / package).mkdir()  # theirs
    (tmp_path / package / "__init__.py").touch()
    with pytest.raises(purerl.UserError, match=f"set PYTHONPATH={tmp_path}$"):
        purerl.find("mine.py")


def test_an_extra_is_installed_from_the_clone_where_there_is_one(tmp_path, monkeypatch):
    assert purerl.how_to_install("x") == "python -m pip install -c constraints.txt -e '.[x]'"
    monkeypatch.setattr(purerl, "__file__", str(tmp_path / "site-packages/purerl/__init__.py"))
    assert purerl.how_to_install("x") == "python -m pip install 'purerl[x]'"


def test_no_hint_but_that_one_says_how_to_install():
    files = [path for path in (ROOT / "purerl").rglob("*.py") if "peers" not in path.parts]
    found = {path.name for path in files if "pip install" in path.read_text()}
    assert found == {"__init__.py"}
    assert "pip install" in Path(purerl.__file__).read_text()


def test_python_may_ask_for_a_module_that_is_not_there():
    assert importlib.util.find_spec("purerl.nothing") is None


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
        "cartpole_swingup", "ant_run", "ant_gaps", "ant_gaps_eyes", "ant_two_touch", "rodent_run",
        "rodent_gaps", "rodent_gaps_eyes", "rodent_bowl", "rodent_maze", "rodent_maze_eyes",
        "rodent_two_touch", "rodent_joystick",
        "ant_intention", "humanoid_imitation", "rodent_imitation", "rodent_intention",
        "ant_gaps_reuse", "rodent_gaps_reuse",
        "suite", "suite_gpu", "suite_humanoid", "humanoid_run", "custom_network",
    ]  # fmt: skip
    assert all(len(summary(available()[name])) < 90 for name in names)
