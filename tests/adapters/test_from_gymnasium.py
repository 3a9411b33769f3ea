"""Environments of Gymnasium, which keep state of their own, behind our protocol."""

import json

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import purerl
from purerl import adapters, check_env

gymnasium = pytest.importorskip("gymnasium")

from purerl.adapters import gymnasium_envs  # noqa: E402
from purerl.checks import examine_env  # noqa: E402

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")


class Counter(gymnasium.Env):
    """Adds what it is given to where it began; ends beyond 3, and is cut off after five steps."""

    observation_space = gymnasium.spaces.Dict(
        {name: gymnasium.spaces.Box(-np.inf, np.inf, (1,)) for name in ("sum", "late")}
    )
    action_space = gymnasium.spaces.Box(0.0, 4.0, (1,))
    made = 0

    def __init__(self):
        Counter.made += 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.sum, self.steps = self.np_random.uniform(), 0
        return self.seen(), {}

    def step(self, action):
        assert self.sum < 3, "stepped after its end"
        self.sum, self.steps = self.sum + float(action[0]), self.steps + 1
        return self.seen(), self.sum, self.sum >= 3, self.steps >= 5, {}

    def seen(self):
        return {"sum": np.array([self.sum]), "late": np.array([self.steps])}


def counter(maker=Counter):
    return adapters.from_maker(maker)


def walk(env, state, actions):
    states = [state]
    for action in actions:
        states.append(env.step(states[-1], jnp.array([action])))
    return states


def test_it_keeps_our_protocol():
    check_env(counter())


def test_steps_are_theirs_with_actions_in_their_limits():
    env = counter()
    start, *after = walk(env, env.reset(jax.random.key(3)), [-1.0, -0.5, 0.0])
    begun = float(start.observation[1])  # Gymnasium sorts by name: late, sum
    assert 0 <= begun < 1 and float(start.observation[0]) == 0
    sums = [float(s.observation[1]) for s in after]
    np.testing.assert_allclose(sums, [begun, begun + 1, begun + 3], rtol=1e-6)
    assert [bool(s.terminated) for s in after] == [False, False, True]
    np.testing.assert_allclose(float(after[-1].reward), sums[-1])
    # What is over stays as it is: an evaluation goes on stepping it.
    assert float(env.step(after[-1], jnp.ones(1)).observation[1]) == float(after[-1].observation[1])


class Older(Counter):
    """Draws as environments of before Gymnasium's `np_random` do."""

    def reset(self, *, seed=None, options=None):
        self.sum, self.steps = np.random.RandomState(seed).uniform(), 0
        return self.seen(), {}


def test_an_environment_may_draw_with_numpys_older_generator():
    env = counter(Older)
    starts = [env.reset(jax.random.key(k)).observation for k in range(20)]
    assert len({np.asarray(start).tobytes() for start in starts}) == 20


def test_being_cut_off_is_no_end_of_the_task():
    env = counter()
    states = walk(env, env.reset(jax.random.key(0)), [-1.0] * 5)
    assert [bool(s.truncated) for s in states] == [False] * 5 + [True]
    assert not states[-1].terminated


def test_episodes_do_not_disturb_each_other():
    env = counter()
    keys = jax.random.split(jax.random.key(0), 3)
    together = jax.vmap(env.reset)(keys)
    alone = [env.reset(key) for key in keys]
    for action in (-0.9, -0.8):
        together = jax.jit(jax.vmap(env.step))(together, jnp.full((3, 1), action))
        alone = [env.step(state, jnp.array([action])) for state in alone]
    np.testing.assert_array_equal(
        together.observation, jnp.stack([state.observation for state in alone])
    )


def test_what_this_process_has_not_stepped_is_lost():
    first = counter()
    *_, state = walk(first, first.reset(jax.random.key(0)), [-1.0, -1.0])
    assert np.isnan(counter().step(state, jnp.zeros(1)).reward)  # as after a resume
    *_, past, _ = walk(first, state, [-1.0, -1.0])
    assert np.isnan(first.step(past, jnp.zeros(1)).reward)  # it has gone another way since


def test_as_many_are_kept_as_run():
    env = counter()
    step = jax.jit(jax.vmap(env.step))
    before = Counter.made
    for i in range(10):  # episodes that the trainer leaves, by a time limit of one step
        step(jax.vmap(env.reset)(jax.random.split(jax.random.key(i), 4)), jnp.zeros((4, 1)))
    assert len(env.pool.episodes) <= 8
    assert Counter.made - before <= 40


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (gymnasium.spaces.Discrete(3), "Discrete(3); here they are a vector"),
        (gymnasium.spaces.Box(-np.inf, np.inf, (2,)), "limits: they are finite"),
    ],
)
def test_actions_that_we_do_not_have_are_one_line(space, said):
    class Other(Counter):
        action_space = space

    with pytest.raises(ValueError, match="Its actions are") as error:
        counter(Other)
    assert said in str(error.value)


EXPERIMENT = """
from dataclasses import dataclass
from purerl import Config, Evaluation, Experiment, adapters, networks
from tests.adapters.test_from_gymnasium import Counter


@dataclass(frozen=True)
class Nothing:
    pass


experiment = Experiment(
    build_env=lambda options, engine: adapters.from_maker(Counter),
    env=Nothing(),
    build_network=networks.mlp,
    network=networks.MlpOptions(policy_hidden=(4,), value_hidden=(4,)),
    ppo=Config(num_steps=64, num_envs=4, rollout_length=4, num_minibatches=2, episode_length=4),
    evaluation=Evaluation(num_episodes=4, number=2),
)
"""


@pytest.mark.slow
def test_a_run_says_that_it_is_not_exact_and_is_resumed(tmp_path, capsys):
    file = tmp_path / "theirs.py"
    file.write_text(EXPERIMENT)
    purerl.train(file, {"ppo.num_steps": 32}, name="run", runs=tmp_path)
    assert "bit-exact    no: the environment keeps state of its own" in capsys.readouterr().out
    manifest = json.loads((tmp_path / "theirs/run/manifest.json").read_text())
    assert not manifest["bit_exact"]
    again = {"resume": True, "allow_changes": True}
    run = purerl.train(file, {"ppo.num_steps": 64}, name="run", runs=tmp_path, **again)
    lines = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    lost = [line["train/nonfinite_resets"] for line in lines]
    assert lost[0] == lost[1] == lost[3] == 0 < lost[2]  # only what ran when the run was stopped


@pytest.mark.slow
def test_a_mujoco_environment_is_stepped_as_by_itself_and_drawn():
    env = adapters.from_gymnasium(adapters.GymnasiumOptions("HalfCheetah-v5"))
    theirs = gymnasium.make("HalfCheetah-v5")
    state = env.reset(jax.random.key(1))
    seed = [int(x) for x in state.task[0]]
    seen, _ = theirs.reset(seed=int(np.random.SeedSequence(seed).generate_state(1)[0]))
    np.testing.assert_allclose(state.observation, seen, rtol=1e-6)
    for i in range(4):
        action = np.full(6, 0.5 * (-1) ** i, np.float32)  # exact between the limits
        state = env.step(state, jnp.asarray(action))
        seen, reward, *_ = theirs.step(action)
        np.testing.assert_allclose(state.observation, seen, rtol=1e-5)
        np.testing.assert_allclose(state.reward, reward, rtol=1e-5)
    np.testing.assert_allclose(state.physics.qpos, theirs.unwrapped.data.qpos, rtol=1e-6)
    assert env.physics.model.nq == 9 and env.control_timestep == pytest.approx(0.05)


def test_a_name_that_gymnasium_has_not_is_one_line():
    with pytest.raises(ValueError, match="Gymnasium 'HalfCheeta-v5': .*HalfCheetah"):
        adapters.from_gymnasium(adapters.GymnasiumOptions("HalfCheeta-v5"))
    with pytest.raises(ValueError, match="ALE"):
        adapters.from_gymnasium(adapters.GymnasiumOptions("ALE/Pong-v5"))


def test_actions_of_whole_numbers_are_rounded():
    class Whole(Counter):
        action_space = gymnasium.spaces.Box(-2, 2, (1,), np.int32)

        def step(self, action):
            assert action.dtype == np.int32
            return self.seen(), float(action[0]), False, False, {}

    env = counter(Whole)
    start = env.reset(jax.random.key(0))
    taken = [float(env.step(start, jnp.array([x])).reward) for x in np.linspace(-1, 1, 9)]
    assert taken == [-2, -2, -1, 0, 0, 0, 1, 2, 2]  # a half goes to the even one


class Failing(Counter):
    def step(self, action):
        raise KeyError("no such thing in a simulator")


def test_an_error_in_a_step_is_one_line_of_check(capfd):
    (said,) = [str(x) for x in examine_env.examine(counter(Failing), 2) if x.level == "error"]
    assert "raised KeyError: 'no such thing in a simulator' (" in said
    assert f"{__file__}, line" in said and "Traceback" not in said + capfd.readouterr().err


def test_a_warning_of_mujoco_is_told_once(capsys, tmp_path, monkeypatch):
    """Each environment of a batch compiles its XML, and would warn each time, and log it."""
    monkeypatch.chdir(tmp_path)
    xml = '<mujoco><compiler settotalmass="14"/><worldbody/></mujoco>'
    make = gymnasium_envs.warned_once(lambda: mujoco.MjModel.from_xml_string(xml))
    make(), make()
    assert capsys.readouterr().err.count("settotalmass") == 1
    assert not list(tmp_path.iterdir())
