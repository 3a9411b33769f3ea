"""Whatever of the source can change a run's bits is hashed, so that --resume notices an edit."""

import ast
import functools
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import purerl
from purerl import run
from purerl.core.errors import SUCCESS, USAGE, UserError
from purerl.devices import compilation, compile_cache
from purerl.experiment import loading, source_hashes
from purerl.ppo import losses
from purerl.runs.loaded_run import Run
from purerl.runs.manifest import differences
from tests.ppo.probes import Probe
from tests.test_rooms import MODULES, own

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

ROOT = Path(__file__).parent.parent.parent
TOY = Path(__file__).parent.parent / "runs" / "toy_experiment.py"
COMPUTING = ["adapters", "clips", "core", "devices", "exact", "eyes", "physics", "ppo"]  # rooms
AN_EDIT = "\nEDITED = True\n"
# What moves no bit.
COMMENT = '\n# A comment.\n"""A text, where a docstring stands."""\n'
SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "+"), ast.Div: ("/", "*")}


@pytest.fixture
def copy(tmp_path) -> Path:
    """A copy of the package's source."""
    ignored = shutil.ignore_patterns("__pycache__")
    return shutil.copytree(source_hashes.PACKAGE, tmp_path / "copy" / "purerl", ignore=ignored)


def edit(file: Path, text: str = AN_EDIT) -> None:
    assert file.exists()
    file.write_text(file.read_text() + text)


def change_operator(file: Path) -> bool:
    """Changes the sign of a file's first sum or product; False if it has none on one line."""
    lines = file.read_text().splitlines(keepends=True)
    for node in ast.walk(ast.parse("".join(lines))):
        if isinstance(node, ast.BinOp) and type(node.op) in SIGNS:
            begin, end = node.left.end_col_offset, node.right.col_offset
            old, new = SIGNS[type(node.op)]
            between = lines[node.lineno - 1][begin:end]
            if node.lineno == node.end_lineno and between.count(old) == 1:
                line = lines[node.lineno - 1]
                lines[node.lineno - 1] = line[:begin] + between.replace(old, new) + line[end:]
                file.write_text("".join(lines))
                return True
    return False


def changed_by(copy: Path, change) -> list[str]:
    before = source_hashes.source_hashes([], copy)
    change()
    found = differences({"source": before}, {"source": source_hashes.source_hashes([], copy)})
    return [line.split(":")[0].removeprefix("source.") for line in found]


def test_an_operator_of_any_module_that_computes_is_named(copy):
    files = source_hashes.package_files(copy)
    assert {name.split(".")[1] for name in files} == set(COMPUTING)
    edited = []

    def change():
        edited.extend(sorted(name for name, file in files.items() if change_operator(file)))

    assert changed_by(copy, change) == edited
    assert {name.split(".")[1] for name in edited} >= {"core", "devices", "exact", "physics", "ppo"}
    assert {"purerl.ppo.losses", "purerl.core.parts", "purerl.physics.engine_c"} <= set(edited)


def test_the_words_of_kernels_in_c_count(copy):
    file = copy / "exact" / "kernel" / "prelude.h"
    assert changed_by(copy, lambda: file.write_text(file.read_text() + "\n// More.\n")) == [
        "exact/kernel/prelude.h"
    ]


def test_a_comment_and_a_docstring_change_no_hash(copy):
    files = source_hashes.package_files(copy)

    def change():
        for file in files.values():
            edit(file, COMMENT)
            text = re.sub(r'^( *)"""', r'\1"""Once more: ', file.read_text(), flags=re.M, count=1)
            file.write_text(text.replace("\n\n\n", "\n\n\n\n# Again.\n"))

    assert changed_by(copy, change) == []


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("raise ValueError('one')", "raise ValueError(f'two {3}')", True),
        ("assert x, 'one'", "assert x, 'two'", True),
        ("def f():\n  'one'\n  return 1", "def f():\n  'two'\n  return 1", True),
        ("assert x, 'one'", "assert y, 'one'", False),
        ("def f():\n  return 'one'", "def f():\n  return 'two'", False),
        ("if x < 1:\n  raise E()", "if x < 2:\n  raise E()", False),
        ("x = f(1.0)", "x = f(1)", False),
        ("x = a and b", "x = a or b", False),
        ("x = [1, 2]", "x = [2, 1]", False),
        ("x = [[1], 2]", "x = [[1, 2]]", False),
        ("class A(B): pass", "class A: B", False),
        ("x: float = 1", "x: int = 1", False),
    ],
)
def test_what_a_file_does_counts_and_what_it_says_does_not(before, after, same):
    hashes = [source_hashes.hash_code(text.encode()) for text in (before, after)]
    assert (hashes[0] == hashes[1]) == same


def test_a_hash_that_is_kept_is_of_this_text_this_python_and_this_way(tmp_path, monkeypatch):
    monkeypatch.setattr(compile_cache, "in_use", lambda: str(tmp_path))
    texts = [b"x = 1", b"x = 1  # one", b"x = 2"]
    hashes = [source_hashes.hash_code(text) for text in texts]
    assert [source_hashes.known_hash(text) for text in texts * 2] == hashes * 2
    assert len(list((tmp_path / "kept").iterdir())) == 3
    for name, value in ((sys, "version"), (source_hashes, "_BY")):
        with monkeypatch.context() as other:
            other.setattr(name, value, "another")
            source_hashes.known_hash(texts[0])
    assert len(list((tmp_path / "kept").iterdir())) == 5


def test_a_new_room_and_a_new_folder_in_a_room_count_by_themselves(copy):
    places = [copy / "planner" / "search.py", copy / "ppo" / "more" / "deep" / "losses.py"]

    def add():
        for place in places:
            place.parent.mkdir(parents=True)
            place.write_text("")

    assert changed_by(copy, add) == ["purerl.planner.search", "purerl.ppo.more.deep.losses"]


def test_commands_do_not_count(copy):
    for command in ("run", "evaluate", "render", "compare", "__init__"):
        assert changed_by(copy, lambda name=command: edit(copy / f"{name}.py")) == []


def test_what_is_left_out_is_no_part_of_what_is_traced():
    """Programs are traced from modules that compute; the few left out there only raise errors."""
    counted = set(source_hashes.package_files(source_hashes.PACKAGE))
    for name in sorted(set().union(*(own(MODULES[n]) for n in counted)) - counted):
        room = name.split(".")[1]
        assert name.removeprefix("purerl.") in source_hashes.LEFT_OUT, f"{room} is imported"
        tree = ast.parse(MODULES[name].read_text())
        public = [n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name[0] != "_"]
        returned = {ast.unparse(one.returns) for one in public if one.returns}
        assert returned <= {"None", "str"}, f"{name} hands on {returned}"


def test_what_is_left_out_is_there():
    for name in source_hashes.LEFT_OUT | source_hashes.IMPORTED:
        place = source_hashes.PACKAGE / name.replace(".", "/")
        assert place.is_dir() or place.with_suffix(".py").is_file()


def test_the_files_hashed_are_those_that_python_runs(monkeypatch):
    """From the folder that holds the checkout, `import purerl` may find an empty package."""
    monkeypatch.setattr(purerl, "__path__", [str(ROOT.parent)])
    monkeypatch.setattr(purerl, "__file__", None)
    hashed = source_hashes.package_files(source_hashes.PACKAGE)
    for module in (compilation, losses):
        assert hashed[module.__name__] == Path(module.__file__)


def resume(copy: Path, runs: Path) -> subprocess.CompletedProcess:
    words = ["-m", "purerl.run", str(TOY), "--runs", str(runs), "--resume"]
    places = os.environ | {"PYTHONPATH": os.pathsep.join([str(copy.parent), str(ROOT)])}
    return subprocess.run(
        [sys.executable, *words], cwd=copy.parent, env=places, capture_output=True, text=True
    )


@pytest.mark.slow
def test_what_moves_no_bit_keeps_nobody_from_resuming_and_what_does_is_named(copy, tmp_path):
    runs = tmp_path / "runs"
    assert run.main([str(TOY), "--runs", str(runs)]) == SUCCESS
    digest = Run(runs / "toy_experiment" / "seed1").digest
    for room in COMPUTING:  # a docstring, a comment
        for file in (copy / room).glob("*.py"):
            edit(file, COMMENT)
    config = copy / "ppo" / "checks.py"
    message = "it must be {rule}"
    assert message in config.read_text()
    config.write_text(config.read_text().replace(message, "it has to be {rule}"))
    for file in ("checks/check_env.py", "machine/output.py", "runs/resume.py", "compare.py"):
        edit(copy / file)  # a check, what prints, what resumes, a command
    edit(copy / "report" / "run_reader.py")
    done = resume(copy, runs)
    assert (done.returncode, done.stderr) == (SUCCESS, ""), done.stderr
    assert f"Already done: 12 updates. Digest {digest}" in done.stdout
    named = []
    for room in COMPUTING:
        counted = sorted(source_hashes.package_files(copy).items())
        files = [(n, f) for n, f in counted if n.split(".")[1] == room and f.stem != "__init__"]
        named += [f"source.{next(n for n, f in files if change_operator(f))}"]
    done = resume(copy, runs)
    assert done.returncode == USAGE and "begun under other conditions" in done.stderr
    assert "Put back what was edited, train anew" in done.stderr
    said = [line.split(":")[0].strip() for line in done.stderr.splitlines() if "->" in line]
    assert said == named


def test_a_comment_in_an_experiment_keeps_nobody_from_resuming(tmp_path, capsys):
    file, runs = tmp_path / "mine.py", tmp_path / "runs"
    file.write_text(TOY.read_text())
    assert run.main([str(file), "--runs", str(runs)]) == SUCCESS
    edit(file, COMMENT)
    assert run.main([str(file), "--runs", str(runs), "--resume"]) == SUCCESS
    edit(file)
    assert run.main([str(file), "--runs", str(runs), "--resume"]) == USAGE
    assert "experiment.py: " in capsys.readouterr().err


def test_the_manifest_of_a_run_holds_every_room_that_computes(tmp_path):
    assert run.main([str(TOY), "--runs", str(tmp_path)]) == SUCCESS
    file = tmp_path / "toy_experiment" / "seed1" / "manifest.json"
    found = json.loads(file.read_text())["source"]
    counted = {name.split(".")[1] for name in found if name.startswith("purerl.")}
    assert counted == set(COMPUTING)
    assert {"tests.ppo.probes", "tests"} <= set(found)  # the builders' imports too


# --- what the builders import ---


def test_only_what_the_builders_import_is_followed():
    found = source_hashes.imported_files(["tests.runs.toy_experiment"])
    assert {"tests.runs.toy_experiment", "tests.ppo.probes", "tests"} <= set(found)
    assert not {"tests.training.test_run", "jax"} & set(found)
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
        source_hashes._seen.clear()  # as in a new process
        assert (source_hashes.source_hashes([task.build]) != before) == counts, file


# --- one process, such as a notebook's: what ran is what is hashed ---

EXPERIMENT = """
from tests.runs.toy_experiment import experiment as toy
import dataclasses
import task_of_mine

def build_env(options, engine):
    return task_of_mine.SCALE

experiment = dataclasses.replace(toy, build_env=build_env)
"""


class Notebook:
    """Somebody's own files, and what comes of them in this process."""

    def __init__(self, place: Path) -> None:
        self.place = place
        (place / "mine.py").write_text(EXPERIMENT)
        self.write("task_of_mine", "from reward_of_mine import SCALE")

    def write(self, name: str, text: str) -> None:
        (self.place / f"{name}.py").write_text(text + "\n")

    def run(self) -> tuple[float, str]:
        """Returns what was built, and the hash of the module behind it."""
        build = loading.load_file(self.place / "mine.py").experiment.build_env
        return build(None, "c"), source_hashes.source_hashes([build])["reward_of_mine"]


@pytest.fixture
def notebook(tmp_path, monkeypatch) -> Notebook:
    monkeypatch.syspath_prepend(str(tmp_path))
    ours = {k: module for k, module in sys.modules.items() if k.partition(".")[0] == "tests"}
    yield Notebook(tmp_path)
    sys.modules.update(ours)  # its task imports some of them, so an edit drops them all
    for name in ("task_of_mine", "reward_of_mine"):
        sys.modules.pop(name, None)


def test_an_edited_module_beside_the_experiment_is_imported_anew(notebook):
    found = {}
    for scale in (1.0, 2.0, 1.0):  # in the same second, of the same size: as compiled code is kept
        notebook.write("reward_of_mine", f"SCALE = {scale}")
        built, code = notebook.run()
        assert (built, code) == (scale, found.setdefault(scale, code))
    assert len(set(found.values())) == 2


def test_what_was_imported_and_edited_before_the_first_training_is_imported_anew(notebook):
    notebook.write("reward_of_mine", "SCALE = 1.0")
    importlib.import_module("task_of_mine")
    notebook.write("reward_of_mine", "SCALE = 2.0")
    assert notebook.run()[0] == 2.0


def test_a_module_that_was_reloaded_by_hand_brings_those_that_hold_parts_of_it(notebook):
    notebook.write("reward_of_mine", "SCALE = 1.0")
    notebook.run()
    notebook.write("reward_of_mine", "SCALE = 20.0")
    importlib.reload(sys.modules["reward_of_mine"])
    assert notebook.run()[0] == 20.0


def test_the_hash_is_of_what_was_imported_also_when_it_is_edited_thereafter(notebook):
    notebook.write("reward_of_mine", "SCALE = 1.0")
    build = loading.load_file(notebook.place / "mine.py").experiment.build_env
    before = source_hashes.source_hashes([build])
    notebook.write("reward_of_mine", "SCALE = 2.0")
    assert source_hashes.source_hashes([build]) == before and build(None, "c") == 1.0


def test_a_comment_imports_nothing_anew(notebook):
    notebook.write("reward_of_mine", "SCALE = 1.0")
    notebook.run()
    module = sys.modules["reward_of_mine"]
    notebook.write("reward_of_mine", "SCALE = 1.0  # a comment")
    notebook.run()
    assert sys.modules["reward_of_mine"] is module


def test_an_edit_of_this_package_needs_a_new_process(notebook, monkeypatch):
    notebook.write("reward_of_mine", "SCALE = 1.0")
    monkeypatch.setitem(source_hashes._seen, Path(losses.__file__), (losses.__spec__, b"x = 1"))
    with pytest.raises(UserError, match="purerl.ppo.losses has been edited .* a new process"):
        notebook.run()
