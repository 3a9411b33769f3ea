"""The environment protocol: what an environment is.

`purerl.check_env` checks that an environment keeps to it.
"""

from typing import TYPE_CHECKING, Protocol

from flax import struct

from purerl.core.records import Array, PyTree

# A state with a component beyond this is as lost as one with NaN: MuJoCo gives up at 1e10, and
# a body at 1e6 m or 1e6 rad/s would poison the observation statistics long before that.
ABSURD = 1e6


class State(struct.PyTreeNode):
    """One environment between two control steps.

    A number beyond `ABSURD` in either direction, or NaN, ends the episode as lost: it teaches
    nothing, and counts as `nonfinite_resets`.

    A metric is averaged over an episode's steps, unless its name ends in `_count`: then it is
    summed (gaps crossed, falls, contacts).
    """

    physics: PyTree  # all the physics needs to go on, and no more (PhysicsState)
    # An array [O], or {"policy": [O], "privileged": [P]}; float32, but pictures are uint8
    observation: PyTree
    reward: Array  # [] float32
    terminated: Array  # [] bool: the task ended; nothing comes after
    truncated: Array  # [] bool: stopped for a reason outside the task; bootstrap from here
    metrics: dict[str, Array]  # name -> [] float32, the same names on reset and step
    task: PyTree  # what the task remembers: goal, previous action, this episode's model changes


class Env(Protocol):
    """One environment; batching, time limit and autoreset are the caller's."""

    if TYPE_CHECKING:  # read-only, so that a constant, a field and a property all fit

        @property
        def control_timestep(self) -> float:
            """Simulated seconds for one step [s]."""

        @property
        def action_size(self) -> int:
            """Features of an action, A."""

    def reset(self, key: Array) -> State:
        """Starts an episode; a pure function of a typed key []."""

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; pure.

        Args:
          state: of one environment, unbatched; its `terminated` and `truncated` are not read.
          action: [A] in [-1, 1].
        """


class EnvError(ValueError):
    """An environment broke a rule of the protocol; the message names the field and the rule."""
