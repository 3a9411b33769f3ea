"""An experiment of somebody's own: what stands beside its file, edits since, mistakes in it."""

import shutil
from pathlib import Path

import pytest

from purerl import evaluate, run
from purerl.core import errors
from purerl.runs import restored_run

pytestmark = pytest.mark.usefixtures("compiled_quickly")

ROOT = Path(__file__).parent.parent.parent
MINE = """
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import mujoco

from purerl.envs import cartpole_swingup
from purerl.experiments.cartpole_swingup import experiment
from my_habits import HABIT
from purerl.ppo.config import Config
from purerl.ppo.networks import MlpOptions
from purerl.physics.interface import Physics
from purerl.core.records import Network, Normal, PolicyOutput


class Env(cartpole_swingup.CartpoleSwingup):
    def _state(self, physics, action):
        state = super()._state(physics, action)
        return state.replace(reward=state.reward * HABIT)


def build(options, engine):
    model = mujoco.MjModel.from_xml_path(str(Path(__file__).parent / "cart.xml"))
    return Env(options, Physics(model, substeps=2, engine=engine), 0, 1)


experiment = dataclasses.replace(
    experiment,
    build_env=build,
    ppo=Config(num_steps=400, num_envs=4, rollout_length=25, num_minibatches=1, episode_length=20),
    network=MlpOptions(policy_hidden=(8,), value_hidden=(8,)),
)
"""


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A folder with an experiment, a module and a body of its own."""
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "my_habits.py").write_text("HABIT = 1.0\n")
    (tmp_path / "cart.xml").write_text((ROOT / "assets" / "cartpole.xml").read_text())
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(run.sys.modules, "my_habits", raising=False)
    return tmp_path


def train(place: Path, *words: str) -> int:
    return run.main([str(place / "mine.py"), "--runs", str(place / "runs"), *words])


def judge(place: Path) -> int:
    return evaluate.main([str(place / "runs" / "mine" / "seed1"), "--episodes", "2"])


@pytest.mark.slow
def test_what_stands_beside_the_file_is_found_from_the_run(place, capsys):
    assert train(place) == errors.SUCCESS
    capsys.readouterr()
    assert judge(place) == errors.SUCCESS
    assert "any more" not in capsys.readouterr().out
    (place / "mine.py").write_text("raise ValueError  # the run's own copy is what counts")
    assert judge(place) == errors.SUCCESS
    assert "any more" not in capsys.readouterr().out


def test_an_edited_body_is_told_and_not_resumed(place, capsys):
    assert train(place) == errors.SUCCESS
    body = place / "cart.xml"
    assert (edited := body.read_text().replace('gear="', 'gear="1')) != body.read_text()
    body.write_text(edited)
    capsys.readouterr()
    assert judge(place) == errors.SUCCESS
    assert "MuJoCo's model is not that of the run any more." in capsys.readouterr().out
    assert train(place, "--resume") == errors.USAGE
    said = capsys.readouterr().err
    assert "model: " in said and "source" not in said
    assert "Put back what was edited of the MuJoCo model" in said


def test_edited_code_beside_the_file_is_named(place, capsys, monkeypatch):
    assert train(place) == errors.SUCCESS
    (place / "my_habits.py").write_text("HABIT = 2.0\n")
    monkeypatch.delitem(run.sys.modules, "my_habits")
    capsys.readouterr()
    assert judge(place) == errors.SUCCESS
    assert "The code of my_habits is not that of the run any more." in capsys.readouterr().out
    assert train(place, "--resume") == errors.USAGE
    assert "source.my_habits: " in capsys.readouterr().err


def test_a_run_without_the_module_beside_says_where_that_stood(place, capsys, monkeypatch):
    assert train(place) == errors.SUCCESS
    monkeypatch.setattr(run.sys, "path", [p for p in run.sys.path if p != str(place)])
    monkeypatch.delitem(run.sys.modules, "my_habits")
    capsys.readouterr()
    assert judge(place) == errors.USAGE
    assert f"set PYTHONPATH={place}" in capsys.readouterr().err


STEP = """class Mine(Env):
    action_size = {size}

    def step(self, state, action):
        state = super().step(state, action[:1])
        return state.replace({change})


def build("""
BROKEN = [
    ("terminated=jnp.zeros(())", 1, "terminated is bool [] from reset and float32 [] from step"),
    ("observation=jnp.zeros(6)", 1, "observation is float32 [5] from reset and float32 [6]"),
    ("metrics={'upright': jnp.zeros(2)}", 1, "metrics['centered'] is in reset's state only"),
    ("reward=state.reward", 0, "env.action_size is 0: it must be a positive int"),
]


@pytest.mark.parametrize(("change", "size", "message"), BROKEN)
def test_an_environment_that_breaks_a_rule_is_one_line(place, capsys, change, size, message):
    text = MINE.replace("def build(", STEP.format(change=change, size=size))
    (place / "mine.py").write_text(text.replace("return Env(", "return Mine("))
    assert train(place) == errors.USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and message in said, said


def test_a_mistake_in_a_step_is_told_with_its_line(place, capsys):
    step = STEP.format(change="reward=state.rewrad", size=1)
    text = MINE.replace("def build(", step).replace("return Env(", "return Mine(")
    (place / "mine.py").write_text(text)
    line = text[: text.index("rewrad")].count("\n") + 1
    assert train(place) == errors.USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1, said
    assert "no attribute 'rewrad'" in said and f"mine.py, line {line})" in said


NETWORK = """
def build_network(options, observation, action_size):
    def apply(params, observation, carry):
        loc = jnp.zeros((*observation.shape[:-1], {actions})) + params
        return PolicyOutput(Normal(loc, jnp.ones_like(loc)), {value}), {carry}

    return Network(lambda key: (jnp.zeros(()), {start}), apply)


experiment = dataclasses.replace(experiment, build_network=build_network)
"""
SOUND = {"actions": "1", "value": "observation[..., 0] * params", "carry": "carry", "start": "()"}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"actions": "3"}, "network's loc is [2, 3] for 2 observations and 1 actions"),
        ({"value": "observation * params"}, "network's value is [2, 5]"),
        ({"value": "params"}, "network's value is []"),
        ({"start": "jnp.zeros(4)", "carry": "carry[..., :3]"}, "network's memory goes in as"),
        ({"start": "jnp.ones(4)"}, "network's memory starts as other numbers than 0"),
    ],
)
def test_a_network_whose_answers_have_other_shapes_is_one_line(place, capsys, wrong, message):
    (place / "mine.py").write_text(MINE + NETWORK.format(**SOUND | wrong))
    assert train(place) == errors.USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and message in said, said


def test_a_network_that_returns_no_policy_output_is_one_line(place, capsys):
    text = NETWORK.format(**SOUND)
    start, end = text.index("PolicyOutput("), text.index(", carry\n")
    (place / "mine.py").write_text(MINE + text[:start] + "loc" + text[end:])
    assert train(place) == errors.USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and "must be a purerl.PolicyOutput" in said, said


def test_an_observation_of_integers_is_one_line(place, capsys):
    whole = """class Mine(Env):
    action_size = 1

    def reset(self, key):
        return super().reset(key).replace(observation=jnp.zeros(5, int))


def build("""
    text = MINE.replace("def build(", whole).replace("return Env(", "return Mine(")
    (place / "mine.py").write_text(text)
    assert train(place) == errors.USAGE
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1 and "observation is int32 [5]" in said, said


@pytest.mark.slow
def test_a_sound_network_of_pure_functions_trains(place):
    (place / "mine.py").write_text(MINE + NETWORK.format(**SOUND))
    assert train(place) == errors.SUCCESS


def test_rewards_that_are_no_numbers_end_the_run(place, capsys):
    (place / "my_habits.py").write_text("HABIT = float('nan')\n")
    assert train(place) == errors.FAILURE
    said = capsys.readouterr().err
    assert "No step of an update was sound" in said and "check_env" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_lost_episodes_are_told(place, capsys):
    half = "jnp.where(state.observation[0] > 0.0, jnp.nan, state.reward)"
    (place / "mine.py").write_text(MINE.replace("state.reward * HABIT", half))
    assert train(place, "--evaluation.num-episodes", "64") == errors.SUCCESS
    said = capsys.readouterr().out
    assert " episodes lost (NaN, or absurd)" in said and "% lost" in said


@pytest.mark.slow
def test_a_run_whose_checkpoints_are_gone_does_not_begin_anew(place, capsys):
    assert train(place) == errors.SUCCESS
    shutil.rmtree(place / "runs" / "mine" / "seed1" / "checkpoints")
    capsys.readouterr()
    assert train(place, "--resume") == errors.USAGE
    assert "there is nothing to go on from" in capsys.readouterr().err


def test_a_folder_of_runs_lists_them(place, capsys):
    assert train(place) == errors.SUCCESS
    place_of_run = place / "runs" / "mine" / "seed1"
    assert restored_run.restore(str(place_of_run), "latest", print).saved.meta["update"] == 4
    for folder, message in [
        (place_of_run.parent, f"Runs found: {place_of_run}."),
        (place_of_run.parent / "sed1", "sed1 is no folder"),
    ]:
        assert evaluate.main([str(folder)]) == errors.USAGE
        assert message in capsys.readouterr().err
