"""The environment protocol: what an environment is, and a check that it keeps to it."""

from typing import Protocol

from flax import struct

from purerl.types import Array, PyTree


class State(struct.PyTreeNode):
    """One environment between two control steps.

    A metric is averaged over an episode's steps, unless its name ends in `_count`: then it is
    summed (gaps crossed, falls, contacts).
    """

    physics: PyTree  # all the engine needs to go on, and no more (physics.PhysicsState)
    observation: PyTree  # float32 leaves: an array [O], or {"policy": [O], "privileged": [P]}
    reward: Array  # [] float32
    terminated: Array  # [] bool: the task ended; nothing comes after
    truncated: Array  # [] bool: stopped for a reason outside the task; bootstrap from here
    metrics: dict[str, Array]  # name -> [] float32, the same names on reset and step
    task: PyTree  # what the task remembers: goal, previous action, this episode's model changes


class Env(Protocol):
    """One environment; batching, time limit, auto-reset and action repeat are the caller's."""

    control_timestep: float  # simulated seconds for one step [s]
    action_size: int

    def reset(self, key: Array) -> State:
        """Starts an episode; a pure function of a typed key []."""
        ...

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; pure; `action` [A] in [-1, 1]."""
        ...
