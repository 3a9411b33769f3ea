"""`check_env`: one broken environment for each rule, and the field it must name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.env import EnvError, State
from purerl.runs.check_env import check_env


@dataclasses.dataclass(frozen=True)
class Toy:
    """A point that actions push, as right as an environment can be."""

    control_timestep = 0.1
    action_size = 2

    def reset(self, key):
        return toy_state(jax.random.normal(key, (2,)))

    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action)


def toy_state(position, **fields):
    values = dict(
        physics=position,
        observation={"policy": position},
        reward=jnp.sum(position),
        terminated=jnp.abs(position[0]) > 50.0,
        truncated=jnp.zeros((), bool),
        metrics={"distance": jnp.abs(position[0])},
        task=(),
    )
    return State(**(values | fields))


class NoStep:
    control_timestep, action_size = 0.1, 2

    def reset(self, key):
        return toy_state(jnp.zeros(2))


class ZeroTimestep(Toy):
    control_timestep = 0.0


class FloatActionSize(Toy):
    action_size = 2.0


class WrongActionSize(Toy):
    action_size = 3


class NotAState(Toy):
    def reset(self, key):
        return jnp.zeros(2)


class VectorReward(Toy):
    def reset(self, key):
        return super().reset(key).replace(reward=jnp.zeros(1))


class IntegerReward(Toy):
    def reset(self, key):
        return super().reset(key).replace(reward=jnp.int32(0))


class FloatTerminated(Toy):
    def reset(self, key):
        return super().reset(key).replace(terminated=jnp.zeros(()))


class FloatTruncated(Toy):
    def reset(self, key):
        return super().reset(key).replace(truncated=jnp.zeros(()))


class IntegerMetric(Toy):
    def reset(self, key):
        return super().reset(key).replace(metrics={"distance": jnp.int32(0)})


class ListMetrics(Toy):
    def reset(self, key):
        return super().reset(key).replace(metrics=[jnp.zeros(())])


class IntegerObservation(Toy):
    def reset(self, key):
        return super().reset(key).replace(observation={"policy": jnp.zeros(2, jnp.int32)})


class NoObservation(Toy):
    def reset(self, key):
        return super().reset(key).replace(observation=())


class WeakReward(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(reward=1.0)


class OtherMetric(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(metrics={"speed": jnp.zeros(())})


class GrowingTask(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(task={"last_action": action})


class OtherShape(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(observation={"policy": jnp.zeros(3)})


class NaNAtFullAction(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(reward=jnp.log(1.0 - action[0]))


class NaNAfterEnd(Toy):
    def step(self, state, action):
        state_after = super().step(state, action)
        reward = jnp.where(state.terminated, jnp.nan, state_after.reward)
        return state_after.replace(reward=reward, terminated=jnp.zeros((), bool))


class OneStart(Toy):
    def reset(self, key):
        return toy_state(jnp.zeros(2))


class HiddenMemory(Toy):
    def reset(self, key):
        return toy_state(jax.random.normal(key, (2,)) + host_counter())

    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action)


def host_counter():
    counts = iter(range(10**6))
    shape = jax.ShapeDtypeStruct((), jnp.float32)
    return jax.pure_callback(lambda: np.float32(next(counts)), shape, vmap_method="broadcast_all")


class HiddenMemoryInStep(Toy):
    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action + host_counter())


class HugeReward(Toy):
    def step(self, state, action):
        return super().step(state, action).replace(reward=jnp.float32(2e6))


class TracedBranch(Toy):
    def step(self, state, action):
        if action[0] > 0:
            return state
        return super().step(state, action)


BROKEN = {
    NoStep: "env.step",
    ZeroTimestep: "env.control_timestep",
    FloatActionSize: "env.action_size",
    WrongActionSize: "env.action_size = 3",
    NotAState: "reset returned",
    VectorReward: "reward",
    IntegerReward: "reward",
    FloatTerminated: "terminated",
    FloatTruncated: "truncated",
    IntegerMetric: r"metrics\['distance'\]",
    ListMetrics: "metrics",
    IntegerObservation: r"observation\['policy'\]",
    NoObservation: "observation",
    WeakReward: "reward is weakly typed in one of the two",
    OtherMetric: r"metrics\['distance'\] is in the state of reset only",
    GrowingTask: r"task\['last_action'\] is in the state of step only",
    OtherShape: r"observation\['policy'\] is float32 \[2\] from reset and float32 \[3\] from step",
    NaNAtFullAction: "reward is not finite after step",
    NaNAfterEnd: "reward is not finite after a step after termination",
    HugeReward: r"reward is 2e\+06 after step.*at most 1e\+06",
    OneStart: "same for different keys",
    HiddenMemory: "differs between two calls with equal keys",
    HiddenMemoryInStep: "differs between two calls with equal states and actions",
    TracedBranch: "step cannot be traced",
}


class WeakClock(Toy):
    """A clock that a person began with a Python number: weakly typed, from reset and from step."""

    def reset(self, key):
        return super().reset(key).replace(task={"time": jnp.add(0.0, 0.0)})

    def step(self, state, action):
        task = {"time": state.task["time"] + 0.1}
        return super().step(state, action).replace(task=task)


def test_what_is_weakly_typed_everywhere_passes_as_it_trains():
    assert jnp.add(0.0, 0.0).weak_type
    check_env(WeakClock())


def test_a_right_environment_passes():
    check_env(Toy())


@pytest.mark.parametrize("broken", BROKEN, ids=lambda c: c.__name__)
def test_a_broken_environment_is_named(broken):
    with pytest.raises(EnvError, match=BROKEN[broken]):
        check_env(broken())
