"""Whatever of the source can change a run's bits is hashed, so that --resume notices an edit."""

import functools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import purerl
from purerl import run
from purerl.core.errors import SUCCESS, USAGE
from purerl.devices import compilation
from purerl.ppo import losses
from purerl.runs import run_folder, source_hashes
from purerl.runs.manifest import differences
from tests.ppo.probes import Probe

ROOT = Path(__file__).parent.parent.parent
TOY = Path(__file__).parent / "toy_experiment.py"
IMPORTED = {"envs", "experiments", "assets"}  # counted where a builder imports them
FOLDERS = {path.parent.name for path in (ROOT / "purerl").glob("*/__init__.py")}
ROOMS = sorted(FOLDERS - IMPORTED)
LOOKING = {"report", "tune"}  # they only start runs, or look at what they wrote
AN_EDIT = "\n# An edit.\n"


@pytest.fixture
def copy(tmp_path) -> Path:
    """A copy of the package's source."""
    ignored = shutil.ignore_patterns("__pycache__")
    return shutil.copytree(source_hashes.PACKAGE, tmp_path / "copy" / "purerl", ignore=ignored)


def edit(file: Path) -> None:
    assert file.exists()
    file.write_text(file.read_text() + AN_EDIT)


def modules(room: Path) -> list[Path]:
    return [file for file in room.rglob("*.py") if file.name != "__init__.py"]


def changed_by(copy: Path, change) -> list[str]:
    before = source_hashes.source_hashes([], copy)
    change()
    found = differences({"source": before}, {"source": source_hashes.source_hashes([], copy)})
    return [line.split(":")[0] for line in found]


@pytest.mark.parametrize("room", ROOMS)
def test_an_edit_of_any_module_of_a_room_is_named_unless_the_room_only_looks(copy, room):
    files = modules(copy / room)
    expected = [] if room in LOOKING else [f"source.purerl.{room}.{file.stem}" for file in files]
    assert files and changed_by(copy, lambda: [*map(edit, files)]) == sorted(expected)


def test_a_new_room_and_a_new_folder_in_a_room_count_by_themselves(copy):
    places = [copy / "planner" / "search.py", copy / "ppo" / "more" / "deep" / "losses.py"]

    def add():
        for place in places:
            place.parent.mkdir(parents=True)
            place.write_text("")

    assert changed_by(copy, add) == [
        "source.purerl.planner.search",
        "source.purerl.ppo.more.deep.losses",
    ]


def test_commands_do_not_count_and_the_front_door_does(copy):
    for command in ("run", "evaluate", "render", "compare"):
        assert changed_by(copy, lambda name=command: edit(copy / f"{name}.py")) == []
    assert changed_by(copy, lambda: edit(copy / "__init__.py")) == ["source.purerl"]


def test_the_files_hashed_are_those_that_python_runs(monkeypatch):
    """From the folder that holds the checkout, `import purerl` may find an empty package."""
    monkeypatch.setattr(purerl, "__path__", [str(ROOT.parent)])
    monkeypatch.setattr(purerl, "__file__", None)
    hashed = source_hashes.package_files(source_hashes.PACKAGE)
    for module in (compilation, losses, run_folder):
        assert hashed[module.__name__] == Path(module.__file__)


def resume(copy: Path, runs: Path) -> subprocess.CompletedProcess:
    words = ["-m", "purerl.run", str(TOY), "--runs", str(runs), "--resume"]
    places = os.environ | {"PYTHONPATH": os.pathsep.join([str(copy.parent), str(ROOT)])}
    return subprocess.run(
        [sys.executable, *words], cwd=copy.parent, env=places, capture_output=True, text=True
    )


def test_an_edited_package_refuses_to_resume_and_names_what_was_edited(copy, tmp_path):
    runs = tmp_path / "runs"
    assert run.main([str(TOY), "--runs", str(runs)]) == SUCCESS
    edit(copy / "report" / "run_reader.py")
    edit(copy / "tune" / "sweep" / "scheduler.py")
    edit(copy / "compare.py")
    done = resume(copy, runs)
    assert (done.returncode, done.stderr) == (SUCCESS, ""), done.stderr
    assert "Already done" in done.stdout
    edited = {room: modules(copy / room)[0] for room in ROOMS if room not in LOOKING}
    for file in edited.values():
        edit(file)
    done = resume(copy, runs)
    assert done.returncode == USAGE and "begun under other conditions" in done.stderr
    assert "Put back what was edited, train anew" in done.stderr
    named = [line.split(":")[0].strip() for line in done.stderr.splitlines() if "->" in line]
    assert named == [f"source.purerl.{room}.{file.stem}" for room, file in edited.items()]


def test_the_manifest_of_a_run_holds_every_room_that_computes(tmp_path):
    assert run.main([str(TOY), "--runs", str(tmp_path)]) == SUCCESS
    file = tmp_path / "toy_experiment" / "seed1" / "manifest.json"
    found = json.loads(file.read_text())["source"]
    counted = {name.split(".")[1] for name in found if name.startswith("purerl.")}
    assert counted == set(ROOMS) - LOOKING
    assert {"tests.ppo.probes", "tests", "purerl"} <= set(found)  # the builders' imports too


# --- what the builders import ---


def test_only_what_the_builders_import_is_followed():
    found = source_hashes.imported_files(["tests.runs.toy_experiment"])
    assert {"tests.runs.toy_experiment", "tests.ppo.probes", "tests"} <= set(found)
    assert not {"tests.runs.test_run", "jax"} & set(found)
    assert not any(name.startswith("purerl") for name in found)  # those count whole


def test_a_builder_is_found_behind_partials():
    assert (
        source_hashes.module_of(functools.partial(functools.partial(Probe))) == "tests.ppo.probes"
    )


def test_an_edit_of_somebodys_own_source_changes_the_hashes(tmp_path, monkeypatch):
    package = tmp_path / "bodies_and_tasks"
    (package / "parts").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "task.py").write_text(
        "import simulator, my_rewards\nfrom bodies_and_tasks.parts.body import LEGS\n"
        "from . import near\n\ndef build(): ...\n"
    )
    (package / "near.py").write_text("from .parts.far import X\n")
    (package / "parts" / "__init__.py").write_text("")
    (package / "parts" / "body.py").write_text("LEGS = 4\n")
    (package / "parts" / "far.py").write_text("from ..near_too import X\n")
    (package / "near_too.py").write_text("X = 1\n")
    (package / "other.py").write_text("LEGS = 4\n")
    (tmp_path / "my_rewards.py").write_text("UPRIGHT = 1\n")  # of no package, and not installed
    installed = tmp_path / "anywhere"
    (installed / "simulator-1.0.dist-info").mkdir(parents=True)
    (installed / "simulator.py").write_text("import my_rewards\n")
    monkeypatch.syspath_prepend(str(installed))
    monkeypatch.syspath_prepend(str(tmp_path))
    import bodies_and_tasks.task as task

    counted = ["__init__", "near", "near_too", "parts/__init__", "parts/body", "parts/far"]
    for file, counts in [
        *((package / f"{name}.py", True) for name in counted),
        (tmp_path / "my_rewards.py", True),
        (package / "other.py", False),
        (installed / "simulator.py", False),
    ]:
        before = source_hashes.source_hashes([task.build])
        edit(file)
        assert (source_hashes.source_hashes([task.build]) != before) == counts, file
