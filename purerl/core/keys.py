"""Random keys, derived by use: `fold_in` from (seed, purpose, indices), never split in sequence.

A key depends only on what it is for. So no result depends on how often something else was drawn,
on where a checkpoint was taken, or on which environments are computed together.
"""

import enum

import jax

from purerl.core.records import Array


class Purpose(enum.IntEnum):
    """What a key is for. Numbers are part of a run's identity: never reuse or renumber one."""

    PARAMETERS = 0
    FIRST_RESET = 1
    FIRST_LIMIT = 2
    RESET = 3
    ACTION = 4
    PERMUTATION = 5
    EVALUATION = 6
    VIDEO = 7
    NETWORK = 8


def derive(key: Array, purpose: Purpose, *indices: Array | int) -> Array:
    """Returns the key of one use, [].

    Args:
      key: [] typed key of the run's seed, which is never used itself.
      purpose: what the key is for.
      indices: [] each, integers: which of the purpose's uses, such as the update.
    """
    # The purpose comes first, so that no index of one purpose can meet the key of another.
    for index in (int(purpose), *indices):
        key = jax.random.fold_in(key, index)
    return key


def per_environment(key: Array, env_ids: Array) -> Array:
    """Returns one key for each environment, [B].

    Args:
      key: [] typed, unbatched.
      env_ids: [B] int32. An environment's key depends on its own id alone, so it is the same
        whichever other environments are computed beside it.
    """
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, env_ids)
