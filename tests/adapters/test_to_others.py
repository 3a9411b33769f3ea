"""Our environments as Gymnasium's and dm_env's."""

import copy
import dataclasses
import os
import re
import subprocess
import sys
import unittest
import warnings
from pathlib import Path

import dm_env
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_env import test_utils

import purerl
from purerl import adapters
from purerl.envs import cartpole_swingup, run
from tests.golden import privileged
from tests.test_readme import PAGES, blocks

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("file_is_compiled_quickly")]

ROOT = Path(__file__).parent.parent.parent


def cartpole():
    return cartpole_swingup.build(cartpole_swingup.Options(), "c")


def ant():
    return run.build(run.Options(body="ant"), "c")


def two_parts():
    return privileged.build_env(cartpole_swingup.Options(), "c")


ENVS = {"cartpole": cartpole, "ant": ant, "dict": two_parts}


@dataclasses.dataclass(frozen=True)
class Toy:
    """Counts steps; ends at 3, or is lost at 2 after an action below -0.5."""

    action_size = 1
    control_timestep = 0.1

    def reset(self, key):
        return self.state(jax.random.uniform(key, (1,)), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        count = state.physics + 1
        bad = (action[0] < -0.5) & (count == 2)
        seen = jnp.where(bad, jnp.nan, state.observation + 1)
        return self.state(seen, count, jnp.where(bad, jnp.nan, action[0]))

    def state(self, seen, count, reward):
        return purerl.State(
            physics=count,
            observation=seen,
            reward=reward,
            terminated=count >= 3,
            truncated=jnp.zeros((), bool),
            metrics={"count": count},
            task=(),
        )


@pytest.mark.parametrize("name", ENVS)
def test_gymnasium_checks_it(name):
    checker = pytest.importorskip("gymnasium.utils.env_checker")
    env = adapters.gymnasium_env(ENVS[name](), episode_length=20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An observation of positions and speeds has no bounds, which it would rather have.
        warnings.filterwarnings("ignore", message=".*Box observation space m..imum value is")
        warnings.filterwarnings("ignore", message=".*spec is None|.*not having a spec")
        checker.check_env(env, skip_render_check=True)


def test_gymnasium_gets_what_the_environment_does():
    pytest.importorskip("gymnasium")
    ours, env = cartpole(), adapters.gymnasium_env(cartpole(), episode_length=3)
    first, _ = env.reset(seed=4)
    again, _ = env.reset(seed=4)
    other, _ = env.reset()
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4
    state, step = env.state, jax.jit(ours.step)
    for number in (1, 2, 3):
        seen, reward, terminated, truncated, info = env.step(np.array([0.3], np.float32))
        state = step(state, jnp.array([0.3]))
        np.testing.assert_allclose(seen, state.observation, rtol=1e-6)
        assert reward == pytest.approx(float(state.reward)) and not terminated
        assert truncated == (number == 3)
        assert info["upright"] == pytest.approx(float(state.metrics["upright"]))
        seen[:] = 0  # the caller's own


def test_the_end_of_a_task_is_no_time_limit_and_a_lost_simulation_is_no_nan():
    pytest.importorskip("gymnasium")
    env = adapters.gymnasium_env(Toy(), episode_length=3)
    env.reset(seed=0)
    ends = [env.step([0.5])[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (True, False)]
    env.reset(seed=0)
    before = env.step([0.5])[0]
    seen, reward, terminated, truncated, info = env.step([-1.0])
    assert (reward, terminated, truncated, info["lost"]) == (0.0, False, True, True)
    np.testing.assert_array_equal(seen, before)


def test_a_vector_begins_anew_in_the_step_after_the_end():
    gymnasium = pytest.importorskip("gymnasium")
    env = adapters.gymnasium_vector_env(Toy(), 3, episode_length=5)
    assert env.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.NEXT_STEP
    first, _ = env.reset(seed=1)
    assert len(np.unique(first)) == 3
    actions = np.array([[0.5], [-1.0], [0.25]], np.float32)
    rows = [env.step(actions) for _ in range(5)]
    assert np.array([row[2] for row in rows]).T.tolist() == [
        [False, False, True, False, False],
        [False, False, False, False, False],
        [False, False, True, False, False],
    ]
    assert np.array([row[3] for row in rows])[:, 1].tolist() == [False, True, False, False, True]
    assert np.array([row[4]["lost"] for row in rows])[:, 1].tolist() == [
        False, True, False, False, True,
    ]  # fmt: skip
    rewards = np.array([row[1] for row in rows])
    np.testing.assert_allclose(rewards[:, 0], [0.5, 0.5, 0.5, 0.0, 0.5])
    np.testing.assert_allclose(rewards[:, 1], [-1.0, 0.0, 0.0, -1.0, 0.0])
    seen = np.array([row[0] for row in rows])
    assert np.isfinite(seen).all() and (seen[3, [0, 2]] < 1).all() and (seen[2, [0, 2]] > 3).all()
    assert env.observation_space.contains(seen[0])


def test_what_was_not_reset_says_so():
    gymnasium = pytest.importorskip("gymnasium")
    for env in (adapters.gymnasium_env(Toy()), adapters.gymnasium_vector_env(Toy(), 2)):
        with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
            env.step(np.zeros((2, 1), np.float32))
        with pytest.raises(gymnasium.error.ResetNeeded, match="Call reset"):
            adapters.gymnasium_vector_env(Toy(), 2).reset(
                options={"reset_mask": np.array([True, False])}
            )


def test_a_vector_takes_a_seed_for_each():
    pytest.importorskip("gymnasium")
    many, one = adapters.gymnasium_vector_env(Toy(), 3), adapters.gymnasium_env(Toy())
    seen, _ = many.reset(seed=[4, None, 7])
    for place, seed in ((0, 4), (2, 7)):
        np.testing.assert_array_equal(seen[place], one.reset(seed=seed)[0])
    again, _ = many.reset(seed=[4, None, 7])
    assert (again == seen).tolist() == [[True], [False], [True]]
    with pytest.raises(purerl.UserError, match="seed has 2 entries for 3"):
        many.reset(seed=[1, 2])


def test_a_vector_begins_those_of_a_mask_anew():
    pytest.importorskip("gymnasium")
    env = adapters.gymnasium_vector_env(Toy(), 2, episode_length=2)
    before, _ = env.reset(seed=1)
    env.step(np.full((2, 1), 0.5, np.float32))
    seen, _ = env.reset(seed=[5, None], options={"reset_mask": np.array([True, False])})
    assert 0 <= seen[0, 0] < 1 and seen[1] == before[1] + 1
    *_, truncated, _ = env.step(np.full((2, 1), 0.5, np.float32))
    assert truncated.tolist() == [False, True]  # the time of the other one goes on
    with pytest.raises(purerl.UserError, match="reset_mask has 1 entries for 2"):
        env.reset(options={"reset_mask": np.array([True])})


def test_an_environment_is_copied_with_its_episode():
    pytest.importorskip("gymnasium")
    env = adapters.gymnasium_env(cartpole(), episode_length=3)
    env.reset(seed=4)
    twin = copy.deepcopy(env)
    env.step([1.0])
    seen = [one.step([0.3])[0] for one in (twin, twin, env)]
    np.testing.assert_array_equal(twin.env.physics.model.qpos0, env.env.physics.model.qpos0)
    assert twin.steps == 2 == env.steps and np.abs(seen[1] - seen[2]).max() > 1e-3


def test_a_vector_has_the_time_limit_of_each():
    pytest.importorskip("gymnasium")
    env = adapters.gymnasium_vector_env(cartpole(), 2, episode_length=2)
    env.reset(seed=1)
    actions = np.zeros((2, 1), np.float32)
    assert [env.step(actions)[3].all() for _ in range(6)] == [False, True, False] * 2


class TestDmEnv(test_utils.EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own tests."""

    def make_object_under_test(self):
        return adapters.dm_env_environment(cartpole(), episode_length=4)

    def make_action_sequence(self):
        for _ in range(10):
            yield np.array([0.1], np.float32)


def test_dm_env_tells_the_end_from_the_time_limit():
    env = adapters.dm_env_environment(Toy(), episode_length=10, seed=3)
    first = env.step([0.5])
    assert first.first()
    steps = [env.step([0.5]) for _ in range(3)]
    assert [s.step_type for s in steps] == [dm_env.StepType.MID] * 2 + [dm_env.StepType.LAST]
    assert [s.discount for s in steps] == [1.0, 1.0, 0.0]
    assert env.step([0.5]).first()
    short = adapters.dm_env_environment(Toy(), episode_length=2, seed=3)
    np.testing.assert_array_equal(short.reset().observation, first.observation)
    last = [short.step([0.5]) for _ in range(2)][-1]
    assert last.last() and last.discount == 1.0


def test_mistakes_are_one_line():
    with pytest.raises(purerl.UserError, match="episode_length is 0"):
        adapters.dm_env_environment(Toy(), episode_length=0)
    with pytest.raises(AttributeError, match="no name 'dm': the names .* Brax.*, dm_env_env"):
        adapters.dm  # noqa: B018
    with pytest.raises(AttributeError, match="write `from purerl.adapters import gymnasium_env`"):
        adapters.gymnasiumenv  # noqa: B018
    pytest.importorskip("gymnasium")
    with pytest.raises(purerl.UserError, match="Toy cannot be drawn"):
        adapters.gymnasium_env(Toy(), render_mode="rgb_array")


DRAW = """
from purerl.envs import cartpole_swingup
from purerl import adapters
env = adapters.gymnasium_env(cartpole_swingup.build(), render_mode="rgb_array")
pictures = []
for seed in (0, 0, 1):
    env.reset(seed=seed)
    for _ in range(20 * seed):
        env.step([1.0])
    pictures.append(env.render().astype(int))
env.close()
first, again, other = pictures
print(first.shape, first.std() > 10, abs(first - again).max(), abs(first - other).max() > 50)
"""


@pytest.mark.usefixtures("opengl")
def test_it_is_drawn():
    pytest.importorskip("gymnasium")
    words = [sys.executable, "-c", DRAW]
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT, env=env)
    assert done.stdout == "(480, 640, 3) True 0 True\n", done.stderr


DRAW_GAPS = """
import jax
import numpy as np
from purerl.envs import run
from purerl import adapters
from purerl.physics.drawing import default_camera
env = run.build(run.Options(arena="gaps"), "c")
drawn = adapters.gymnasium_env(env, render_mode="rgb_array")
boxes = list(env.parts.boxes.boxes)
for seed in (0, 1):
    drawn.renderer.stage.followed_height = 5.0  # of the episode before
    drawn.reset(seed=seed)
    print(drawn.renderer.stage.followed_height is None)
    drawn.step(np.zeros(env.action_size))
    drawn.render()
    true = env.model_changes(drawn.state)
    data, model = drawn.renderer.stage.data, drawn.renderer.stage.model
    # Where they are drawn, not where a model would put them.
    print(abs(data.geom_xpos[boxes] - true["geom_pos"][np.array(boxes)]).max() < 1e-6)
    print(abs(model.geom_size[boxes] - true["geom_size"][np.array(boxes)]).max() < 1e-6)
    print(abs(true["geom_pos"] - env.physics.model.geom_pos).max() > 1)
    scene, course = drawn.renderer.scene, env.scenery(drawn.state)[0]
    far = [scene.geoms[scene.ngeom - len(course) + i].pos for i in range(len(course))]
    print(abs(np.array(far) - course).max() < 1e-5)
    eyes = np.mean([eye.pos for eye in scene.camera], axis=0)
    print(abs(eyes - data.cam_xpos[default_camera(model)]).max() < 1e-5)
print(default_camera(model) != 0)
print(env.physics.model.geom_sameframe.any())  # it is a copy that is drawn
"""


@pytest.mark.usefixtures("opengl")
def test_the_gaps_are_drawn_where_physics_has_them():
    pytest.importorskip("gymnasium")
    done = subprocess.run(
        [sys.executable, "-c", DRAW_GAPS], capture_output=True, text=True, cwd=ROOT
    )
    assert done.stdout.split() == ["True"] * 14, done.stderr


# --- the page ---

ADAPTERS = "docs/howto/adapters.md"
PYTHON = blocks(PAGES[ADAPTERS].read_text(), "python")


@pytest.mark.parametrize("library", ["gymnasium_env", "dm_env_environment"])
def test_the_page_runs(library):
    pytest.importorskip(library.partition("_env")[0].replace("dm", "dm_env"))
    (block,) = [block for block in PYTHON if library in block and "baselines" not in block]
    exec(block, {})


@pytest.mark.parametrize("module", ["brax", "mujoco_playground", "gymnasium"])
def test_the_experiments_of_the_page_are_experiments(module):
    pytest.importorskip(module)
    (block,) = [block for block in PYTHON if "from_brax" in block]
    library = module.removeprefix("mujoco_")
    rows = re.findall(r"^\| \w+ \| `(.*)` \| `(.*)` \|$", PAGES[ADAPTERS].read_text(), re.MULTILINE)
    theirs = {build.partition("_")[2]: (build, env) for build, env in rows}
    for brax, other in zip(theirs["brax"], theirs[library], strict=True):
        assert brax in block
        block = block.replace(brax, other)
    names: dict = {}
    exec(block, names)
    assert isinstance(names["experiment"], purerl.Experiment)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_stable_baselines3_learns_the_cart_pole():
    """Only where PyTorch is installed."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.evaluation import evaluate_policy

    (block,) = [block for block in PYTHON if "baselines" in block]
    names: dict = {}
    exec(block.replace("80_000", "20_000"), names)
    value, _ = evaluate_policy(names["model"], names["env"], 3, warn=False)
    assert value > 150  # at first below 1
