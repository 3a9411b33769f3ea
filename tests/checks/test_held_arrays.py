"""Whatever an environment or a network holds is hashed, wherever it is from, on every engine."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import Physics, networks
from purerl.checks.held_arrays import hash_held
from purerl.envs import cartpole_swingup
from tests.ppo.probes import Probe

MOTION = np.arange(12.0, dtype=np.float32).reshape(3, 4)


@dataclasses.dataclass(frozen=True, eq=False)
class Tracker(Probe):
    """A probe that follows a motion that it has read."""

    name: str = "both"
    motion: np.ndarray = dataclasses.field(default_factory=lambda: MOTION)
    weight: float = 0.5

    def step(self, state, action):
        state, motion = super().step(state, action), jnp.asarray(self.motion)
        target = jax.jit(lambda i: motion[i])(state.observation.astype(jnp.int32)[0])
        return state.replace(reward=state.reward - self.weight * target.sum())


def network_of(env):
    zeros = jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(env.reset, jax.random.key(0))
    )
    options = networks.MlpOptions(policy_hidden=(4,), value_hidden=(4,))
    return networks.mlp(options, zeros.observation, env.action_size)


@pytest.fixture(scope="module")
def network():
    return network_of(Tracker())


def changed(network, *envs) -> list[str]:
    first, second = (hash_held(env, network) for env in envs)
    return sorted(name for name in {*first, *second} if first.get(name) != second.get(name))


def test_the_same_arrays_have_the_same_hash(network):
    assert changed(network, Tracker(), Tracker(motion=MOTION.copy())) == []


def test_another_array_is_named_by_its_shape(network):
    assert changed(network, Tracker(), Tracker(motion=MOTION * 2)) == ["float32[3, 4]"]
    shorter = changed(network, Tracker(), Tracker(motion=MOTION[:2]))
    assert {"float32[2, 4]", "float32[3, 4]"} < {*shorter}  # and bounds


def test_a_number_that_a_file_was_read_for_counts_too(network):
    assert changed(network, Tracker(), Tracker(weight=0.25)) == ["float32[]"]


def test_two_arrays_of_one_shape_do_not_change_places(network):
    @dataclasses.dataclass(frozen=True, eq=False)
    class Two(Tracker):
        other: np.ndarray = dataclasses.field(default_factory=lambda: MOTION)

        def step(self, state, action):
            state = super().step(state, action)
            other = jnp.asarray(self.other) * state.reward
            return state.replace(reward=other.sum())

    more = MOTION * 2
    assert changed(network, Two(motion=MOTION, other=more), Two(motion=more)) == ["float32[3, 4]"]


def test_a_network_that_another_run_trained_counts(network):
    def holding(weights):
        def apply(params, observation, memory):
            output, memory = network.apply(params, observation, memory)
            return output._replace(value=output.value + weights.sum()), memory

        return network._replace(apply=apply)

    hashes = [hash_held(Tracker(), holding(jnp.full(7, x))) for x in (1.0, 2.0)]
    assert hashes[0]["float32[7]"] != hashes[1]["float32[7]"]


def test_no_engine_is_traced_so_that_all_have_the_same_hashes():
    one, other = (cartpole_swingup.build(engine="c") for _ in range(2))
    network = network_of(one)
    other.physics._engine = engine = types.SimpleNamespace(record=one.physics._engine.record)
    assert changed(network, one, other) == []
    assert other.physics._engine is engine  # what was traced is a copy


def test_arrays_that_change_the_model_count(network):
    env = cartpole_swingup.build(engine="c")

    class Damped:
        control_timestep, action_size = env.control_timestep, env.action_size
        reset = staticmethod(env.reset)

        def __init__(self, damping):
            self.physics, self.damping = env.physics, damping

        def step(self, state, action):
            changes = {"dof_damping": self.damping}
            physics, _ = self.physics.step(state.physics, jnp.zeros(1), changes)
            return state.replace(physics=physics)

    damping = np.ones(env.physics.model.nv, np.float32)
    assert isinstance(env.physics, Physics)
    assert changed(network_of(env), Damped(damping), Damped(damping * 2)) == ["float32[2]"]
