"""A trial at a single gap: whether the body lands behind it, falls, or stops."""

import jax.numpy as jnp

from purerl import Array

LANDED = 0.2  # how long a body has to stand behind the gap [s]


def steps_beyond(before: Array, ends: Array, course: Array) -> Array:
    """Returns for how many control steps in a row a body has stood behind the first gap, [] int32.

    Args:
      before: [] of the step before.
      ends: [4, 3] where the limbs end: all of them behind its far edge, and above the ground [m].
      course: [P, 2] [m].
    """
    there = (ends[:, 0] > course[1, 0]) & (ends[:, 2] > 0.0)
    return jnp.where(there.all(), before + 1, 0)


def outcome(first: Array, fell: Array, landed: Array) -> dict[str, Array]:
    """Returns how a trial ended as metrics, of whose sums over an episode one is 1, the others 0.

    No step knows that it is the time limit's, so `stopped` counts from the first one on.

    Args:
      first: [] bool: whether this is an episode's first step.
      fell: [] bool: it ends here, unhealthy.
      landed: [] bool: it ends here, behind the gap.
    """
    counts = {"fell_count": fell, "landed_count": landed}
    counts = {name: there.astype(jnp.float32) for name, there in counts.items()}
    return counts | {"stopped_count": first - sum(counts.values())}
