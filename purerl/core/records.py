"""The shape alphabet and the records that several modules share.

Shapes, everywhere in this project, time first (`[T, B, ...]`):

| letter | axis                                   |
|--------|----------------------------------------|
| `T`    | control steps in one rollout           |
| `B`    | parallel environments                  |
| `M`    | samples in one minibatch               |
| `O`    | observation features                   |
| `A`    | action features                        |
| `H`    | features of a recurrent memory         |
| `S`    | seeds                                  |
| `N`    | evaluation episodes                    |
| `V`    | parts of a batch (`core/parts.py`)     |
| `E`    | epochs over one rollout                |
| `K`    | minibatches in one epoch               |

`[]` is a scalar, `[...]` any leading batch axes. A docstring that says `[O]` describes one
environment, unbatched; the caller's `vmap` makes it `[B, O]`.

What a recurrent network keeps from one step to the next is its memory. Names of `TrainState`'s
fields are part of a checkpoint's digest.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

Array = jax.Array
PyTree = Any
Metrics = dict[str, Array]


class Normal(NamedTuple):
    """Parameters of a diagonal Gaussian, before any squashing."""

    loc: Array  # [..., A]
    scale: Array  # [..., A] > 0


class PolicyOutput(NamedTuple):
    """What a network says about one observation."""

    distribution: Normal  # over raw (unsquashed) actions [..., A]
    value: Array  # [...] expected discounted return, in scaled-reward units
    losses: dict[str, Array] = {}  # name -> [...]; `Config.auxiliary` weighs their means


class Network(NamedTuple):
    """A policy and value function as a pair of pure functions.

    `init(key) -> (params, memory)`: from a key [], the parameters, and the memory of one
    environment, unbatched, at the start of an episode. That memory must be all zeros; a
    feed-forward network returns `()`.
    `apply(params, observation, memory) -> (PolicyOutput, memory)`: `observation` has any leading
    batch axes, leaves [..., O], and `memory` has the same ones, leaves [..., H]. `params` has none.
    `draw(key) -> noise`: noise of its own, of one environment in one step. A rollout keeps it, and
    whoever learns from the step reads it: `apply(params, observation, memory, noise)`. Where
    nothing is drawn (a policy that acts by its mean, a value to bootstrap from), `apply` is called
    without it, and answers by the mean too.
    `scale(directions)`: what the rate multiplies, of Adam's directions of `params`.
    `hold(old, new)`: the statistics of observations, of those before an update and after it.

    An `apply` with an attribute `sequences` that is true takes T steps at once too, if it is given
    `is_first` [T, M], where an episode begins. Leaves are [T, M, ...] then, and `memory` is that
    before the first step. All that needs no memory is computed for all steps together. (It is no
    field here: another `apply`, put in this one's place, may not be able to.)
    """

    init: Callable[[Array], tuple[PyTree, PyTree]]
    apply: Callable[..., tuple[PolicyOutput, PyTree]]
    draw: Callable[[Array], PyTree] | None = None
    scale: Callable[[PyTree], PyTree] = lambda directions: directions
    hold: Callable[[PyTree, PyTree], PyTree] = lambda old, new: new


class Counter(struct.PyTreeNode):
    """A 64-bit count, `high * 2**32 + low`: JAX has no 64-bit integers by default."""

    high: Array  # [] uint32
    low: Array  # [] uint32


def zero_count() -> Counter:
    """Returns a counter at 0."""
    return Counter(high=jnp.zeros((), jnp.uint32), low=jnp.zeros((), jnp.uint32))


def add_count(count: Counter, amount: Array) -> Counter:
    """Adds exactly.

    Args:
      count: the counter so far.
      amount: [] integer, at least 0 and below 2**32.
    """
    low = count.low + amount.astype(jnp.uint32)
    # Unsigned addition wraps around: the sum is below what it began with exactly if one is carried.
    return Counter(high=count.high + (low < count.low), low=low)


def count_as_float(count: Counter) -> Array:
    """Returns the count rounded to float32 ([]): exact below 2**24, 6e-8 relative above."""
    return count.high.astype(jnp.float32) * 2.0**32 + count.low.astype(jnp.float32)


def count_as_int(count: Counter) -> int:
    """Returns the exact count as a Python integer; not in a traced function."""
    return (int(count.high) << 32) + int(count.low)


class EpisodeStats(struct.PyTreeNode):
    """Running statistics of each environment's current episode."""

    episode_return: Array  # [B] undiscounted, unscaled sum of rewards
    length: Array  # [B] int32 control steps so far
    limit: Array  # [B] int32 time limit; the first episodes' are staggered
    metrics: dict[str, Array]  # name -> [B] sums of the environment's metrics


class TrainState(struct.PyTreeNode):
    """Everything a run is: `update(state) -> (state, metrics)`, and a checkpoint is this record."""

    # What is learned.
    params: PyTree
    optimizer: PyTree  # Adam's moments of all parameters
    learning_rate: Array  # [] float32; moves only under the adaptive-KL schedule
    normalizer: PyTree  # running_moments.Statistics of the observation
    reward_normalizer: PyTree  # running_moments.Statistics of the discounted return, [] each
    # Where the environments are.
    env_ids: Array  # [B] int32 which its random keys are folded with
    env_state: PyTree  # core.env.State, [B, ...]
    memory: PyTree  # the policy's, [B, H]; () for a feed-forward network
    episode: EpisodeStats  # [B]
    discounted_return: Array  # [B] running return, for reward scaling
    # Bookkeeping.
    key: Array  # [] typed key of the run's seed; never advanced, only folded into
    update: Array  # [] int32 updates done
    steps: Counter  # control steps taken, all environments together
    skipped_in_a_row: Array  # [] int32 non-finite minibatch updates since the last good one


def is_key(x: Any) -> bool:
    """Tells whether an array, or its shape, is of typed random keys."""
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
