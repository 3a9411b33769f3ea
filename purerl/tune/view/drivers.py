"""Who chooses the actions: a trained policy, or the planner; pure.

A driver's brain is what it has learned: a run's TrainState, or () of a planner that knows nothing.
It is an argument of the compiled program, so another checkpoint is another brain and no other
program.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax

from purerl.core.env import Env, State
from purerl.core.records import Array, PyTree
from purerl.tune.plan import planner
from purerl.tune.plan.planner import Guide
from purerl.tune.plan.settings import Settings


class Driver(NamedTuple):
    """Chooses actions, with a memory.

    `start(env) -> memory`: at the beginning of an episode.
    `act(env, brain, state, memory, key) -> (action [A], value [], memory)`: the value is the
    discounted return that is to come, as the driver expects it, in the units of the reward.
    """

    start: Callable[[Env], PyTree]
    act: Callable[[Env, PyTree, State, PyTree, Array], tuple[Array, Array, PyTree]]


def policy_driver(guide: Callable[[PyTree], Guide], brain: PyTree) -> Driver:
    """Returns the driver that does what a policy does.

    Args:
      guide: makes one of a brain.
      brain: any, for the shape of a policy's memory.
    """

    def act(env: Env, brain: PyTree, state: State, memory: PyTree, key: Array) -> tuple:
        one = jax.tree.map(lambda x: x[None], (state, memory))
        return jax.tree.map(lambda x: x[0], guide(brain).act(*one))

    return Driver(lambda env: guide(brain).memory, act)


def planner_driver(settings: Settings, guide: Callable[[PyTree], Guide], brain: PyTree) -> Driver:
    """Returns the driver that plans before each action; arguments as of `policy_driver`."""

    def act(env: Env, brain: PyTree, state: State, memory: PyTree, key: Array) -> tuple:
        plan, action = planner.plan(settings, env, guide(brain), memory, state, key)
        return action, plan.value, plan

    return Driver(lambda env: planner.start(settings, env, guide(brain)), act)
