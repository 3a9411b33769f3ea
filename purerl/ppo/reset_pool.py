"""Fresh starts: the pool that each update draws, and which of them an environment takes."""

import math

import jax
import jax.numpy as jnp

from purerl.core.env import Env, State
from purerl.core.keys import per_environment
from purerl.core.records import Array
from purerl.ppo.config import Config


def draw_pool(config: Config, env: Env, update_key: Array, size: int, first: Array | int) -> State:
    """Draws this update's fresh starts, [R, B, ...]: R for each of B environments from `first`.

    Of a pool that environments share, each start stands in several of the B places.
    """
    own, shared = starts_each(config, size)
    keys = per_environment(update_key, size // shared, first)

    def start(number: Array) -> State:
        return jax.vmap(lambda key: env.reset(jax.random.fold_in(key, number)))(keys)

    pool = jax.vmap(start)(jnp.arange(own))
    if shared == 1:
        return pool
    return jax.tree.map(lambda x: jnp.concatenate([x] * shared, axis=1), pool)


def starts_each(config: Config, size: int) -> tuple[int, int]:
    """Returns how many fresh starts an environment has in an update, and how many share them.

    `size` is the number of environments that act together, all or one shard's.
    """
    pool = config.reset_pool or config.num_envs
    if pool >= config.num_envs:
        return pool // config.num_envs, 1
    return 1, size // math.gcd(size, max(1, pool * size // config.num_envs))


def count_replays(config: Config, resets: Array) -> Array:
    """Returns how many of the starts that environments took ([B]) were not fresh, []."""
    own, shared = starts_each(config, resets.shape[0])
    taken = resets.reshape(shared, -1).sum(0)
    return jnp.maximum(taken - own, 0).sum()


def take_from_pool(pool: State, resets: Array) -> State:
    """Returns each environment's next start, [B, ...]; beyond its R starts it begins again."""
    rows = jax.tree.leaves(pool)[0].shape[0]
    if rows == 1:
        return jax.tree.map(lambda x: x[0], pool)
    index = resets % rows
    return jax.tree.map(lambda x: jax.vmap(lambda column, i: column[i], (1, 0))(x, index), pool)
