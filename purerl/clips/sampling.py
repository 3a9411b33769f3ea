"""Which clip an episode begins in, and where: pure functions of a key and of weights as data.

All that is summed is whole numbers, so no order of a sum can move a bit.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array

MANY = 256  # attempts after which a clip's counts are halved, so that what is long past fades


class Tally(NamedTuple):
    """How often each clip was tried, and failed: data of a state."""

    tried: Array  # [C] int32, less than MANY after each `count`
    failed: Array  # [C] int32


def draw(key: Array, weights: Array, lengths: Array, window: int) -> tuple[Array, Array]:
    """Draws a clip, and a frame of it with a whole window from there on.

    Args:
      key: [] typed.
      weights: [C] in proportion to how often each clip is drawn; 0, below or NaN: never. With
        none above 0, each clip is drawn as often.
      lengths: [C] int32 frames of each clip, none below `window`; see `check_window`.
      window: frames that are needed from the first one on, that one among them.

    Returns:
      The clip [] int32, and its frame [] int32, each frame from 0 to length - window as often.
    """
    clip_key, frame_key = jax.random.split(key)
    # Whole numbers, whose sum is below 2^30 whatever the order in which it is made.
    most = 2**30 // len(weights) - 1
    weights = jnp.where(weights > 0.0, weights, 0.0)
    weights = jnp.where(jnp.any(weights > 0.0), weights, 1.0)
    units = jnp.ceil(weights / jnp.max(weights) * most).astype(jnp.int32)
    ends = jnp.cumsum(units)
    clip = jnp.sum(ends <= jax.random.randint(clip_key, (), 0, ends[-1]), dtype=jnp.int32)
    return clip, jax.random.randint(frame_key, (), 0, lengths[clip] - window + 1)


def even_tally(clips: int) -> Tally:
    """Returns the tally of C clips that nobody has tried."""
    return Tally(*jnp.zeros((2, clips), jnp.int32))


def count(tally: Tally, clip: Array, failed: Array) -> Tally:
    """Returns the tally after further attempts.

    Args:
      tally: the one before.
      clip: [...] int32, the clip of each attempt.
      failed: [...] bool, how it ended.
    """
    tried = tally.tried.at[clip].add(1)
    failures = tally.failed.at[clip].add(failed.astype(jnp.int32))
    old = tried >= MANY
    return Tally(jnp.where(old, tried // 2, tried), jnp.where(old, failures // 2, failures))


def failure_weights(tally: Tally, least: float = 0.1) -> Array:
    """Returns weights [C] float32 that grow with how often each clip fails.

    A weight is (failed + 1) / (tried + 2), which is 1/2 for a clip that was not tried yet, and
    never below `least`: what is mastered is still drawn.
    """
    return jnp.maximum((tally.failed + 1) / (tally.tried + 2), least).astype(jnp.float32)
