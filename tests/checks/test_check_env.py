"""`check_env`: one broken environment for each rule, and the field it must name."""

import dataclasses
import itertools
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.checks import check_traces
from purerl.checks.check_env import check_env
from purerl.core.env import EnvError, State

pytestmark = pytest.mark.usefixtures("compiled_quickly")


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


class NestedObservation(Toy):
    def reset(self, key):
        state = super().reset(key)
        return state.replace(observation={"policy": {"arm": state.observation["policy"]}})


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


class NumpyRandomInReset(Toy):
    def reset(self, key):
        return toy_state(jax.random.normal(key, (2,)) + np.random.randn(2))


class NumpyRandomInStep(Toy):
    def step(self, state, action):
        return toy_state(state.physics + 0.1 * action + 0.1 * np.random.randn())


@jax.jit
def jittered(x):
    """JAX keeps its trace, which is not traced again with what calls it."""
    return x + np.random.randn()


class NumpyRandomUnderJit(Toy):
    def step(self, state, action):
        return toy_state(jittered(state.physics + 0.1 * action))


class NumpyRandomInLoop(Toy):
    def step(self, state, action):
        new = jax.lax.fori_loop(0, 3, lambda _, x: x + random.random(), state.physics)
        return toy_state(new + 0.1 * action)


TRACED = itertools.count()


class CountedTraces(Toy):
    def step(self, state, action):
        noise = jax.random.normal(jax.random.key(next(TRACED)), (2,))
        return toy_state(state.physics + 0.1 * action + 0.1 * noise)


class OtherOperations(Toy):
    def step(self, state, action):
        turn = jnp.sin if next(TRACED) % 2 else jnp.cos
        return toy_state(turn(state.physics) + 0.1 * action)


class OtherOrder(Toy):
    def step(self, state, action):
        both = (state.physics, action) if next(TRACED) % 2 else (action, state.physics)
        return toy_state(both[0] - both[1])


class OtherMethod(Toy):
    """A parameter of an operation that changes, and no number of its own."""

    def step(self, state, action):
        return toy_state((state.physics + 0.1 * action) ** (2 + next(TRACED) % 2))


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
    NestedObservation: r"observation\['policy'\]\['arm'\] is inside another dict",
    NoObservation: "observation",
    WeakReward: "reward is weakly typed in one of the two",
    OtherMetric: r"metrics\['distance'\] is in reset's state only",
    GrowingTask: r"task\['last_action'\] is in step's state only",
    OtherShape: r"observation\['policy'\] is float32 \[2\] from reset and float32 \[3\] from step",
    NaNAtFullAction: "reward is not finite after step",
    NaNAfterEnd: "reward is not finite after a step after termination",
    HugeReward: r"reward is 2e\+06 after step.*at most 1e\+06",
    OneStart: "same for different keys",
    HiddenMemory: "differs between two calls with equal keys",
    HiddenMemoryInStep: "differs between two calls with equal states and actions",
    TracedBranch: "step cannot be traced",
    NumpyRandomInReset: r"reset is another program .* it has other numbers where it had an array "
    r"\[2\] \(.*test_check_env.py, line \d+\).*; draw by jax.random from its key",
    NumpyRandomInStep: r"step is another program .* it has \S+ where it had \S+ "
    r"\(.*test_check_env.py, line.*np.random, random, time and counters run once.*in State.task",
    NumpyRandomUnderJit: "step is another program",
    NumpyRandomInLoop: "step is another program",
    CountedTraces: r"step is another program .* it has \d+ where it had \d+ ",
    OtherOperations: "step is another program .* it has other operations",
    OtherOrder: "step is another program .* it has other operations",
    OtherMethod: "step is another program .* it has other operations",
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


class TwoStarts(Toy):
    """Drawn from the key, but only one of two."""

    def reset(self, key):
        side = jax.random.bernoulli(jax.random.fold_in(key, 3))
        return toy_state(jnp.full(2, side.astype(jnp.float32)))


class Held(Toy):
    """Its callback is another object in each trace, and so are the arrays that it reads."""

    def step(self, state, action):
        one = jax.pure_callback(
            lambda: np.float32(1),
            jax.ShapeDtypeStruct((), jnp.float32),
            vmap_method="broadcast_all",
        )
        return toy_state(state.physics + one * action + jnp.asarray(np.linspace(0, 1, 2)))


def test_a_right_environment_passes():
    check_env(Toy())
    check_env(Held())


def test_starts_may_be_the_same_by_chance():
    starts = jax.vmap(TwoStarts().reset)(jax.random.split(jax.random.key(0), 16)).physics
    assert (starts[:4] == starts[0]).all() and (starts != starts[0]).any()
    check_env(TwoStarts())


def test_a_call_that_its_library_counts_is_the_same():
    """MJX-Warp counts its calls so; a call of that name does not even exist."""

    def counted(x):
        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return jax.ffi.ffi_call("none", shape)(x, launch_id=np.int32(next(TRACED)))

    first, second = (check_traces.trace_anew(counted, jnp.ones(2)) for _ in range(2))
    assert str(first) != str(second) and check_traces.difference(first, second) is None


def test_what_a_branch_calls_is_compared_too():
    def traced(number):
        def branch(x):
            return jax.lax.cond(x[0] > 0, lambda y: y * number, lambda y: y, x)

        return check_traces.trace_anew(branch, jnp.ones(2))

    assert check_traces.difference(traced(2.0), traced(2.0)) is None
    assert "it has 3.0 where it had 2.0" in check_traces.difference(traced(2.0), traced(3.0))


@pytest.mark.parametrize("broken", BROKEN, ids=lambda c: c.__name__)
def test_a_broken_environment_is_named(broken):
    with pytest.raises(EnvError, match=BROKEN[broken]):
        check_env(broken())
