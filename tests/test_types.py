"""What type checkers know of the front door, in a user's file; and that it hides nothing as Any."""

import ast
import dataclasses
import importlib
import inspect
import re
import shutil
import subprocess
import sys
import textwrap
import typing
import venv
from collections.abc import Callable
from pathlib import Path

import pytest

import purerl
from purerl.experiment.options import RunOptions, TrainOptions

ROOT = Path(__file__).parent.parent
# A comment says what `reveal_type` finds, or that the line is an error.
MINE = '''\
import dataclasses

import jax
import purerl
from purerl import Array, Config, Env, Experiment, Physics, State, networks
from purerl.envs import cartpole_swingup


@dataclasses.dataclass(frozen=True)
class Mine:
    """An environment with a constant, a field and a property."""

    control_timestep: float
    physics: Physics
    action_size = 1

    def reset(self, key: Array) -> State:
        raise NotImplementedError

    def step(self, state: State, action: Array) -> State:
        return state.replace(reward=action[0])


class NoStep:
    control_timestep = 0.1
    action_size = 1

    def reset(self, key: Array) -> State:
        raise NotImplementedError


def build(options: cartpole_swingup.Options, engine: str) -> Mine:
    model: Physics = cartpole_swingup.build(options, engine).physics
    return Mine(0.1, model)


def wrong_build(options: cartpole_swingup.Options, engine: str) -> NoStep:
    return NoStep()


config = Config(num_steps=1000, num_envs=8)
options = cartpole_swingup.Options()
mine = Experiment(build, options, networks.mlp, networks.MlpOptions(), config)
Experiment(wrong_build, options, networks.mlp, networks.MlpOptions(), config)  # wrong
Config(num_stpes=1000)  # wrong
purerl.Phisics  # wrong

run = purerl.train("mine.py", {"ppo.gamma": 0.9}, seed=2, name="a", runs="here", resume=True)
reveal_type(run)  # Run
reveal_type(purerl.train("mine.py", num_seeds=3, seeds_by="map"))  # list[Run]
reveal_type(purerl.load("runs/mine/a"))  # Run
purerl.train("mine.py", nmae="a")  # wrong
purerl.train("mine.py", resume="auto")
purerl.train("mine.py", resume="yes")  # wrong
purerl.train("mine.py", seeds_by="pmap")  # wrong
purerl.train("mine.py", num_seeds=3).update  # wrong

reveal_type(run.experiment)  # Experiment
reveal_type(run.config)  # Config
reveal_type(run.env)  # Env
its_network: purerl.Network = run.network
run.network.aply  # wrong
reveal_type(run.state)  # TrainState
reveal_type(run.policy)  # Policy
reveal_type(run.update)  # int
reveal_type(run.steps)  # int
reveal_type(run.digest)  # str
reveal_type(run.evaluate()["steps"])  # int
reveal_type(run.evaluate()["metrics"]["episode_return"]["mean"])  # float
run.polcy  # wrong
run.evaluate()["metric"]  # wrong
run.update.lower()  # wrong

env: Env = build(options, "c")
key = jax.random.key(0)
observation = env.reset(key).observation
network = networks.mlp(networks.MlpOptions(), observation, env.action_size)
state = purerl.init(config, env, network, key)
reveal_type(state)  # TrainState
reveal_type(purerl.update(config, env, network, state))  # tuple[TrainState, dict[str, Array]]
purerl.init(config, NoStep(), network, key)  # wrong
purerl.update(config, env, state, network)  # wrong
reveal_type(purerl.choose_engine("auto"))  # str
reveal_type(purerl.exact.is_portable())  # bool
purerl.exact.rewrit  # wrong
purerl.adapters.dm_env_environment(network)  # wrong
purerl.adapters.gym_env  # wrong
'''
# What is of a type that only its writer knows, or of many.
OF_ANY_TYPE = {
    "Config.plain",  # the other settings
    "Experiment.build_env", "Experiment.build_network",  # their options, which are the next two
    "Experiment.env", "Experiment.network",
    "Run.metrics",  # numbers, texts and None, as the columns have them
    "train",  # values of settings
}  # fmt: skip


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """An interpreter for which purerl is installed for editing, as by pip, whoever else has it."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, symlinks=True)
    (packages,) = place.glob("lib/python*/site-packages")
    beside = {path for path in sys.path if path.endswith("site-packages")}
    (packages / "purerl.pth").write_text("\n".join([str(ROOT / ".editable"), *sorted(beside)]))
    return place / "bin" / "python"


def expected():
    """Returns line -> type that is revealed, and the lines that are wrong."""
    revealed, wrong = {}, set()
    for number, line in enumerate(MINE.splitlines(), 1):
        if line.startswith("reveal_type"):
            revealed[number] = line.rpartition("  # ")[2]
        elif line.endswith("# wrong"):
            wrong.add(number)
    assert len(revealed) > 15 and len(wrong) > 10
    return revealed, wrong


def check(words, place, note, error):
    """Runs a type checker on a user's file, and holds it against what is expected there."""
    (place / "mine.py").write_text(MINE)
    done = subprocess.run(words, cwd=place, capture_output=True, text=True)
    revealed, wrong = expected()
    found = {
        int(line): re.sub(r"[\w.]+\.(\w+)", r"\1", kind)  # without modules
        for line, kind in re.findall(note, done.stdout)
    }
    assert found == revealed, done.stdout + done.stderr
    assert set(map(int, re.findall(error, done.stdout))) == wrong, done.stdout + done.stderr


@pytest.mark.slow
def test_mypy_knows_the_front_door(tmp_path, python):
    words = ["mypy", "--python-executable", str(python), "--cache-dir", str(tmp_path / "cache")]
    note = r'mine\.py:(\d+): note: Revealed type is "(.+)"'
    check([sys.executable, "-m", *words, "mine.py"], tmp_path, note, r"mine\.py:(\d+): error")


def pyright():
    """Returns pyright's command if it is installed and starts: it needs node."""
    command = shutil.which("pyright") or shutil.which("pyright", path=str(Path(sys.prefix, "bin")))
    if command and not subprocess.run([command, "--version"], capture_output=True).returncode:
        return command
    return None


@pytest.mark.slow
def test_pyright_knows_the_front_door(tmp_path, python):
    if not (command := pyright()):
        pytest.skip("pyright is not installed, or finds no node")
    note = r'mine\.py:(\d+):\d+ - information: Type of ".+" is "(.+)"'
    error = r"mine\.py:(\d+):\d+ - (?:error|warning)"
    check([command, "--pythonpath", str(python), "mine.py"], tmp_path, note, error)


def test_the_options_of_train_are_those_of_the_command():
    kinds = typing.get_type_hints(RunOptions) | {"runs": str | Path}
    fields = {field.name: kinds[field.name] for field in dataclasses.fields(RunOptions)}
    del fields["video"], fields["num_seeds"]  # the command's alone; an argument of its own
    of_experiment = typing.get_type_hints(purerl.Experiment)
    fields |= {name: of_experiment[name] for name in ("seed", "engine")}
    fields["on_metrics"] = Callable[[dict[str, typing.Any]], typing.Any]  # of Python alone
    assert typing.get_type_hints(TrainOptions) == fields


def public(tree, prefix):
    """Yields a name and the annotations of everything public that a piece of code defines."""
    for node in tree.body:
        name = getattr(node, "name", "") or getattr(getattr(node, "target", None), "id", "")
        if name.startswith("_") and name not in ("__init__", "__call__"):
            continue
        whole = f"{prefix}.{name}".strip(".")
        if isinstance(node, ast.ClassDef):
            yield from public(node, whole)
        elif isinstance(node, ast.FunctionDef):
            given = [*node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
            yield whole, [arg.annotation for arg in given if arg] + [node.returns]
        elif isinstance(node, ast.AnnAssign):
            yield whole, [node.annotation]


def test_nothing_public_is_any_where_a_type_is_known():
    found, seen = set(), 0
    for name in purerl.__all__:
        thing = getattr(purerl, name)
        if name in ("Array", "PyTree", "adapters", "exact"):
            continue
        tree = ast.parse(textwrap.dedent(inspect.getsource(thing)))
        for whole, annotations in public(tree, name if inspect.ismodule(thing) else ""):
            seen += 1
            names = {n.id for a in annotations if a for n in ast.walk(a) if isinstance(n, ast.Name)}
            found |= {whole} if "Any" in names else set()
    assert seen > 100
    assert found == OF_ANY_TYPE


def test_the_overloads_of_train_are_found():
    assert len(typing.get_overloads(importlib.import_module(purerl.HOMES["train"]).train)) == 2
