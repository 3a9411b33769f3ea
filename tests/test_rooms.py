"""The library's arrows: who may import whom, and where effects may stand."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = {path.stem: path for path in (ROOT / "purerl").glob("*.py")}
# Effects live in these; whatever is not named here is pure, and imports nothing of these.
EFFECTS = {
    "building",
    "checkpoint",
    "cli",
    "compare",
    "compilation",
    "console",
    "disk",
    "distributed",
    "errors",
    "evaluate",
    "experiment",
    "groups",
    "history",
    "kernels",
    "launch",
    "loggers",
    "manifest",
    "recorder",
    "render",
    "run",
    "run_video",
    "rundir",
    "scene",
    "seeds",
    "spread",
    "train",
    "twins",
    "video",
}
PURE = sorted(set(FILES) - EFFECTS - {"__init__"})
# The one host call above the line: MuJoCo's C code, a pure function of its arguments, on as many
# threads as this process has cores; and how programs reach it.
HOST_CALL = {"engine_c", "host_calls"}
FORBIDDEN_CALLS = {"print", "open", "input", "exec", "eval", "__import__"}
FORBIDDEN_MODULES = {"time", "datetime", "os", "sys", "random", "subprocess", "logging", "pathlib"}
CALLBACKS = {"pure_callback", "io_callback", "callback", "debug_callback", "ffi_call"}


def imports(path):
    """Every module imported anywhere in a file, dotted names in full."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        if isinstance(node, ast.ImportFrom):
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_imports(path):
    """Names of the `purerl` modules that a file imports."""
    parts = [name.split(".") for name in imports(path)]
    return {p[1] for p in parts if p[0] == "purerl" and len(p) > 1 and p[1] in FILES}


def test_every_module_is_on_one_side():
    assert {"ppo", "rollout", "physics", "env"} <= set(PURE)
    assert not EFFECTS - set(FILES), "a listed module is gone"


@pytest.mark.parametrize("name", sorted(FILES))
def test_library_imports_no_environment_and_no_experiment(name):
    assert not {m.split(".")[0] for m in imports(FILES[name])} & {"envs", "experiments", "tests"}


@pytest.mark.parametrize("name", PURE)
def test_pure_modules_import_no_effects(name):
    assert not own_imports(FILES[name]) & EFFECTS


@pytest.mark.parametrize("name", PURE)
def test_pure_modules_have_no_effects(name):
    path = FILES[name]
    found = set(imports(path)) - ({"os"} if name in HOST_CALL else set())
    assert not {m.split(".")[0] for m in found} & FORBIDDEN_MODULES
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "os":
            assert node.attr == "sched_getaffinity", f"line {node.lineno}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in FORBIDDEN_CALLS, f"line {node.lineno}"
        if isinstance(node, ast.Attribute) and name not in HOST_CALL:
            assert node.attr not in CALLBACKS, f"line {node.lineno}"


@pytest.mark.parametrize("folder", ["envs", "experiments"])
def test_environments_import_only_the_pure_side_and_experiments(folder):
    allowed = set(PURE) | ({"experiment"} if folder == "experiments" else set())
    for path in (ROOT / folder).rglob("*.py"):
        # A script beside the experiments is a command of its own, and may import commands.
        if "def main(" not in path.read_text():
            assert own_imports(path) <= allowed, path


def test_ppo_imports_no_network_library():
    for name in ("ppo", "rollout", "evaluation", "losses", "gae"):
        linked = {m for m in imports(FILES[name]) if m.startswith("flax")}
        assert linked <= {"flax", "flax.struct"}, name
