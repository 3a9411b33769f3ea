"""The house: which room may import which, what is pure, and how long the afternoon is."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import purerl
from tests import budget

HOUSE = Path(purerl.__file__).parent
ROOT = HOUSE.parent
# Room -> the rooms that it may import. The arrows point one way.
MAY_IMPORT = {
    "core": set(),
    "exact": set(),
    "ppo": {"core"},
    "physics": {"core", "exact"},
    "devices": {"core", "exact", "ppo"},
    "machine": {"core"},
    "eyes": {"core", "ppo", "physics"},
    "checks": {"core", "exact", "physics", "machine"},
    "experiment": {"core", "ppo", "physics", "devices", "machine", "checks"},
    "runs": {"core", "exact", "ppo", "devices", "machine", "checks", "experiment"},
    "training": {
        "core",
        "exact",
        "ppo",
        "devices",
        "machine",
        "checks",
        "experiment",
        "runs",
    },
    "report": {
        "core",
        "exact",
        "ppo",
        "physics",
        "eyes",
        "machine",
        "experiment",
        "runs",
        "training",
    },
    "adapters": {"core", "ppo", "physics", "report"},
    "clips": {"core", "physics", "machine", "experiment", "report"},
    "tune": {
        "core",
        "ppo",
        "devices",
        "machine",
        "checks",
        "experiment",
        "runs",
        "report",
    },
}
# The folders beside `purerl/`, which are `purerl.envs` and so on for who imports them.
LINKS = {"envs", "experiments", "assets"}
# Files beside the rooms. The command `report` is the room of that name, by its __main__.py.
COMMANDS = {
    "ask", "check", "compare", "evaluate", "export", "new", "pack", "plan", "plot", "record",
    "render", "run", "sweep", "view",
}  # fmt: skip
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in HOUSE.rglob("*.py")
}
# Rooms without effects, but for these: MuJoCo's C code is called on threads of its own, which must
# be a pure function of its arguments; XLA reads its flags from the environment; and a kernel's text
# is given to a compiler, whose result is kept in JAX's cache, and on a CPU called back. And MJX is
# imported without Warp.
PURE = ("core", "exact", "ppo", "physics", "eyes")
HOST_CALLS = {"purerl.physics.engine_c", "purerl.physics.host_calls"}
XLA_FLAGS, IMPORTS = "purerl.exact.xla_flags", "purerl.physics.mjx_alone"
COMPILERS, KERNEL_CALLS = "purerl.exact.kernel.compilers", "purerl.exact.kernel.launch"
FORBIDDEN_CALLS = {"print", "open", "input", "exec", "eval", "__import__"}
FORBIDDEN_MODULES = {"time", "datetime", "os", "sys", "random", "subprocess", "logging", "pathlib"}
CALLBACKS = {"pure_callback", "io_callback", "callback", "debug_callback", "ffi_call"}
MACHINE = re.compile(r"shard|slice|device|platform|backend|engine", re.IGNORECASE)


def room_of(name):
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in MAY_IMPORT else None


def imported(path):
    """Every module that a file's import statements name, wherever they stand."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own(path):
    """The modules of purerl that a file imports."""
    return {name for name in imported(path) if name in MODULES} - {"purerl"}


def test_nothing_but_rooms_and_commands():
    beside = {path.stem for path in HOUSE.glob("*.py")}
    assert beside == COMMANDS | {"__init__", "__main__"}
    folders = {path.name for path in HOUSE.iterdir() if path.is_dir()} - {"__pycache__"}
    assert folders == set(MAY_IMPORT) | LINKS
    assert all((HOUSE / link).resolve() == ROOT / link for link in LINKS)


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_those_below(room):
    for name, path in MODULES.items():
        if room_of(name) == room:
            found = {room_of(other) for other in own(path)} - {room}
            assert found <= MAY_IMPORT[room], f"{name} imports {found - MAY_IMPORT[room]}"
            assert not {n for n in own(path) if n.count(".") == 1 and n.split(".")[1] in COMMANDS}


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_says_what_belongs_there(room):
    said = ast.get_docstring(ast.parse((HOUSE / room / "__init__.py").read_text()))
    (names,) = re.findall(r"May import: ([^.]*)\.", said)
    names = set(re.findall(r"\w+", names)) - {"nothing"}
    assert names == MAY_IMPORT[room], "the docstring and the table must agree"
    assert re.search(r"\bRead:? ", said), "where a reader starts"


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_has_half_a_page_that_names_where_to_start(room):
    text = (HOUSE / room / "README.md").read_text()
    assert text.startswith(f"# `{room}`: ") and len(text.splitlines()) <= 40
    assert all(part in text for part in ("here to start", "refuses"))
    for name in re.findall(r"`([\w/.]+\.(?:py|md))`", text):
        places = [HOUSE / room / name, HOUSE / name, ROOT / name]
        assert name == "experiment.py" or any(map(Path.exists, places)), name  # a run's file


def test_contributors_read_the_same_table():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    for room, below in MAY_IMPORT.items():
        (cell,) = re.findall(rf"^\| `{room}` \| .* \| ([^|]*) \|$", text, re.MULTILINE)
        assert set(re.findall(r"`(\w+)`", cell)) == below, room


def test_no_circles():
    done, path = set(), []

    def visit(name):
        assert name not in path, f"a circle: {' -> '.join([*path[path.index(name) :], name])}"
        if name in done:
            return
        path.append(name)
        for other in own(MODULES[name]):
            visit(other)
        done.add(path.pop())

    for name in MODULES:
        visit(name)


def test_the_library_imports_no_environment_and_no_experiment():
    for name, path in MODULES.items():
        found = {other.removeprefix("purerl.").split(".")[0] for other in imported(path)}
        assert not found & (LINKS | {"tests"}), name


@pytest.mark.parametrize("name", [n for n in MODULES if room_of(n) in PURE])
def test_pure_rooms_have_no_effects(name):
    path = MODULES[name]
    found = {module.split(".")[0] for module in imported(path)} & FORBIDDEN_MODULES
    of_compilers = {"pathlib", "subprocess"} if name == COMPILERS else set()
    of_flags = {"os", "sys"}  # whether JAX is there already: to import it would come too early
    allowed = {"os"} if name in HOST_CALLS else of_flags if name == XLA_FLAGS else of_compilers
    allowed |= {"sys"} if name == IMPORTS else set()
    assert found <= allowed
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "os":
            allowed = "environ" if name == XLA_FLAGS else "sched_getaffinity"
            assert node.attr == allowed, f"line {node.lineno}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in FORBIDDEN_CALLS, f"line {node.lineno}"
        if isinstance(node, ast.Attribute) and name not in HOST_CALLS | {KERNEL_CALLS}:
            assert node.attr not in CALLBACKS, f"line {node.lineno}"


# --- the afternoon ---

SOURCES = budget.of_this_folder()
ALGORITHM = budget.algorithm(SOURCES)


def test_the_algorithm_can_be_read_in_an_afternoon():
    """`python -m tests.budget` prints the table, and what changed."""
    size = budget.measure_all(SOURCES)
    assert size["the algorithm"].code <= budget.MOST_OF_THE_ALGORITHM
    assert size["purerl/"].code <= budget.MOST_OF_ALL
    assert size["the algorithm"].longest[0] <= 60
    assert size["ppo"].share >= 0.05, "a comment stands where a reader would go back"
    assert max(len(budget.code_lines(SOURCES[name])) for name in ALGORITHM) <= 170
    assert {room_of(name) for name in ALGORITHM} == {"ppo", "core"}


def test_what_explains_costs_nothing():
    explained = """
'''A docstring

of two lines.'''
# A comment.
X = 1  # a line of code
Y = '''a text, whose lines
# are no comments'''


class Settings:
    '''Another.'''

    size: int
    '''What --help prints counts.'''
"""
    size = budget.measure({"x": explained})
    assert size == budget.Size(code=6, comments=1, lines=15, longest=(0, ""))
    function = 'def f():\n    """Says."""\n\n    return 1\n'
    assert budget.measure({"x": function}).longest == (2, "x.f")


def test_the_budget_is_printed_with_the_change():
    done = subprocess.run(
        [sys.executable, "-m", "tests.budget", "HEAD"], capture_output=True, text=True, cwd=ROOT
    )
    assert re.search(r"^the algorithm +[\d,]+ +[+-]\d+  at most 1,100", done.stdout, re.MULTILINE)


@pytest.mark.parametrize("name", sorted(ALGORITHM))
def test_the_algorithm_knows_nothing_of_the_machine(name):
    found = [line for line in MODULES[name].read_text().splitlines() if MACHINE.search(line)]
    assert not found


def test_only_networks_import_a_network_library():
    for name in ALGORITHM - {"purerl.ppo.networks"}:
        linked = {m for m in imported(MODULES[name]) if m.startswith("flax")}
        assert linked <= {"flax", "flax.struct"}, name


def test_no_file_is_long():
    lines = {name: len(path.read_text().splitlines()) for name, path in MODULES.items()}
    assert not {name: n for name, n in lines.items() if n > 305}


# --- what starts at once ---


@pytest.mark.parametrize(
    "words", ["import purerl", "import purerl.compare", "import purerl.run", "import purerl.exact"]
)
def test_it_starts_without_jax(words):
    code = f"{words}; import sys; print('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout == "False\n", done.stderr
