"""Environments of other libraries behind our protocol."""

import dataclasses
import importlib
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

import purerl
from purerl import adapters, check_env
from purerl.adapters import foreign
from purerl.ppo.episodes import is_lost

pytestmark = pytest.mark.slow

MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint type='slide' axis='1 0 0'/><geom size='.1'/></body>"
    "</worldbody></mujoco>"
)


class Theirs(struct.PyTreeNode):
    """A state as brax and Playground have it."""

    data: dict
    obs: dict
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class Slide:
    """Pushes a point; with all that makes their states awkward for us."""

    action_size = 1

    def reset(self, rng):
        rng, start = jax.random.split(rng)
        q = jax.random.uniform(start, (1,))
        return self.state(q, jnp.zeros(1), rng, 0.0, 0.0)

    def step(self, state, action):
        rng, noise = jax.random.split(state.info["rng"])
        speed = state.data["qd"] + action + jax.random.normal(noise, (1,))
        late = (state.info["count"] >= 3) * 1.0
        done = jnp.maximum(late, (action[0] > 0.9) * 1.0)
        new = self.state(state.data["q"] + speed, speed, rng, done, late)
        return new.replace(info=new.info | {"count": state.info["count"] + 1})

    def state(self, q, qd, rng, done, late):
        data = {"q": q, "qd": qd, "efc": jnp.array([1e15, jnp.inf, -0.0])}
        info = {"rng": rng, "count": 0, "time_out": late}
        obs = {"state": q, "privileged_state": qd}
        return Theirs(data, obs, q.sum(), jnp.asarray(done, float), {"far": 1.0}, info)


def slide():
    return foreign.adapt(Slide(), MODEL, lambda state: SimpleNamespace(**state.data), 0.1)


def equal(tree, other):
    numbers = [jax.random.key_data(x) if foreign.is_key(x) else x for x in jax.tree.leaves(tree)]
    others = [jax.random.key_data(x) if foreign.is_key(x) else x for x in jax.tree.leaves(other)]
    for mine, theirs in zip(numbers, others, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def same_steps(env, number, rtol=0.0):
    """Steps an adapted environment beside the bare one; returns both last states."""
    keys = jax.random.key(7), jax.random.key(7)
    state, theirs = jax.jit(env.reset)(keys[0]), jax.jit(env.env.reset)(keys[1])
    step, bare = jax.jit(env.step), jax.jit(env.env.step)
    for i in range(number):
        action = jnp.full(env.action_size, 0.3) * (-1) ** i
        state, theirs = step(state, action), bare(theirs, action)
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol),
            jax.tree.leaves(state.observation),
            [theirs.obs[k] for k in ("state", "privileged_state")]
            if isinstance(theirs.obs, dict)
            else [theirs.obs],
        )
        np.testing.assert_allclose(state.reward, theirs.reward, rtol=rtol)
    assert np.abs(jax.tree.leaves(state.observation)[0]).max() > 0
    return state, theirs


def test_it_keeps_our_protocol():
    check_env(slide())


def test_a_step_is_theirs_and_their_state_is_kept_to_the_bit():
    env = slide()
    state, theirs = same_steps(env, 3)
    kept = foreign.unpack(state.task, env.template)
    assert jax.tree.structure(kept) == jax.tree.structure(theirs)
    equal(kept, theirs)
    assert state.observation.keys() == {"policy", "privileged_state"}
    assert not is_lost(state)  # whatever large numbers their simulation has
    gone = theirs.replace(data=theirs.data | {"q": jnp.array([jnp.nan])})
    assert is_lost(env._convert(gone))


def test_their_time_limit_is_no_end_of_the_task():
    env = slide()
    state = env.reset(jax.random.key(0))
    ends = []
    for _ in range(4):
        state = env.step(state, jnp.zeros(1))
        ends.append((bool(state.terminated), bool(state.truncated)))
    assert ends == [(False, False)] * 3 + [(False, True)]
    state = env.step(env.reset(jax.random.key(0)), jnp.ones(1))
    assert (bool(state.terminated), bool(state.truncated)) == (True, False)


@dataclasses.dataclass(frozen=True)
class Nothing:
    pass


EXPERIMENT = """
from purerl import Config, Evaluation, Experiment, networks
from tests.adapters.test_from_others import Nothing, slide

experiment = Experiment(
    build_env=lambda options, engine: slide(),
    env=Nothing(),
    build_network=networks.mlp,
    network=networks.MlpOptions(policy_hidden=(4,), value_hidden=(4,)),
    ppo=Config(
        num_steps=64, num_envs=4, rollout_length=4, num_minibatches=2, episode_length=3,
        schedule="constant",  # a rate that falls depends on how far the whole run goes
    ),
    evaluation=Evaluation(number=0),
)
"""


def test_it_is_trained_stopped_and_resumed_as_any_other(tmp_path):
    """Its keys and bits go through checkpoints."""
    file = tmp_path / "theirs.py"
    file.write_text(EXPERIMENT)
    whole = purerl.train(file, name="whole", runs=tmp_path)
    halves = {"resume": True, "allow_changes": True}
    purerl.train(file, {"ppo.num_steps": 32}, name="halves", runs=tmp_path)
    parted = purerl.train(file, {"ppo.num_steps": 64}, name="halves", runs=tmp_path, **halves)
    assert whole.update == parted.update == 4
    assert whole.digest == parted.digest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["inverted_pendulum"])
@pytest.mark.usefixtures("compiled_quickly")
def test_brax_is_stepped_as_by_itself(name):
    pytest.importorskip("brax")
    env = adapters.from_brax(adapters.BraxOptions(name))
    state, theirs = same_steps(env, 5, rtol=1e-5)
    assert env.physics.model.nq == len(state.physics.qpos)
    np.testing.assert_allclose(state.physics.qpos, theirs.pipeline_state.q, rtol=1e-5)
    check_env(env)
    with pytest.raises(ValueError, match="'pendulum'.*inverted_pendulum"):
        adapters.from_brax(adapters.BraxOptions("pendulum"))


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_playground_is_stepped_as_by_itself():
    pytest.importorskip("mujoco_playground")
    with jax.debug_key_reuse(False):  # Playground keeps a key that it has split
        env = adapters.from_playground(adapters.PlaygroundOptions("CartpoleSwingup"))
        state, theirs = same_steps(env, 5, rtol=1e-5)
        np.testing.assert_allclose(state.physics.qpos, theirs.data.qpos, rtol=1e-5)
        check_env(env)
    with pytest.raises(ValueError, match="CartpoleSwingup"):
        adapters.from_playground(adapters.PlaygroundOptions("Cartpole"))


def test_playground_without_a_network_is_one_line(monkeypatch):
    """Its robots' models are cloned when one is first built."""

    def load(*_, **__):
        raise subprocess.CalledProcessError(128, ["git", "clone"])

    registry = SimpleNamespace(ALL_ENVS=["Go1"], get_default_config=lambda _: {}, load=load)
    monkeypatch.setitem(sys.modules, "mujoco_playground", SimpleNamespace(registry=registry))
    monkeypatch.delitem(sys.modules, "purerl.adapters.playground_envs", raising=False)
    home = importlib.import_module("purerl.adapters.playground_envs")
    monkeypatch.delitem(sys.modules, "purerl.adapters.playground_envs")
    with pytest.raises(ValueError, match="need a network, once: Command .*clone.* 128"):
        home.from_playground(home.PlaygroundOptions("Go1"))


@pytest.mark.parametrize("name", ["from_brax", "from_playground", "gymnasium_env"])
def test_a_library_that_is_not_there_is_one_line(name, monkeypatch):
    home = adapters.HOMES[name]

    def missing(module):
        assert module == home
        library = {"from_brax": "brax", "from_playground": "mujoco_playground"}
        package = library.get(name, "gymnasium.vector")
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)

    monkeypatch.setattr(importlib, "import_module", missing)
    extra = {"from_brax": "brax", "from_playground": "playground"}.get(name, "gymnasium")
    with pytest.raises(ImportError, match=rf"adapters.{name} needs .*'.\[{extra}\]'"):
        getattr(adapters, name)
