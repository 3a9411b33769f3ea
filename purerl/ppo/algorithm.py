"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

One update, in the order you would explain it: `collect` (`rollout.py`, `targets.py`), then
`improve` (`learner.py`, then the statistics). `init` and `update` are pure; jit each as a whole,
once.

`update` is one device's. Several devices call `collect` for each shard of the environments, and
`improve` together (`shards.py`, `spread.py`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.records import (
    Array,
    Counter,
    Metrics,
    Network,
    PyTree,
    TrainState,
    add_count,
    zero_count,
)
from purerl.devices.shards import WHOLE, Shards, gather, total
from purerl.ppo import running_moments
from purerl.ppo.batches import Batch, make_batch
from purerl.ppo.config import Config, check_divides
from purerl.ppo.learner import is_recurrent, learn, optimizer
from purerl.ppo.reset_pool import count_replays
from purerl.ppo.rollout import Finished, Transition, rollout, start_episodes


class Experience(NamedTuple):
    """What an update learns from; one shard's, or a device's shards, stacked [v, ...]."""

    batch: Batch  # [T, B]
    memory: PyTree  # [B, H] the policy's at the start of the rollout
    observations: running_moments.Moments
    returns: running_moments.Moments  # of the discounted return
    sums: Metrics  # name -> []


def check_sizes(config: Config, carry: PyTree, number: int = 1) -> None:
    """Raises ValueError unless the minibatches divide the rollout of each of `number` shards."""
    size, name = config.num_envs // number, "num_envs / num_shards" if number > 1 else "num_envs"
    if config.segment_length and is_recurrent(carry):
        raise ValueError(
            f"segment_length is {config.segment_length}, and the network is recurrent, so that its "
            "minibatches hold whole rollouts; segment_length must be 0."
        )
    because = ""
    if is_recurrent(carry):
        because = " The minibatches of a recurrent network hold whole rollouts."
    else:
        size, name = size * config.rollout_length, f"{name} * rollout_length"
    if config.segment_length:
        size, name = size // config.segment_length, f"{name} / segment_length"
    check_divides(name, size, "num_minibatches", config.num_minibatches, because)


def init(config: Config, env: Env, network: Network, key: Array) -> TrainState:
    """Returns the state before the first update, all of it drawn from `key` [].

    Time limits of the first episodes are uniform in [1, episode_length], so that environments do
    not stay in phase: B environments all at the same moment of an episode are one sample.
    """
    params, carry = network.init(derive(key, Purpose.PARAMETERS))
    check_parameters(params)
    check_sizes(config, carry)
    size = config.num_envs
    env_state = jax.vmap(env.reset)(per_environment(derive(key, Purpose.FIRST_RESET), size))
    limit_keys = per_environment(derive(key, Purpose.FIRST_LIMIT), size)
    limit = jax.vmap(lambda k: jax.random.randint(k, (), 1, config.episode_length + 1))(limit_keys)
    return TrainState(
        params=params,
        optimizer=optimizer(config).init(params),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        normalizer=running_moments.init(jax.tree.map(lambda x: x[0], env_state.observation)),
        reward_normalizer=running_moments.init(jnp.zeros(())),
        env=env_state,
        carry=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), carry),
        episode=start_episodes(env_state, limit.astype(jnp.int32)),
        discounted_return=jnp.zeros(size),
        key=key,
        update=jnp.zeros((), jnp.int32),
        steps=zero_count(),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
    )


def check_parameters(params: PyTree) -> None:
    """Raises ValueError for a parameter that no gradient can change."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The network's parameter {jax.tree_util.keystr(path)} is {leaf.dtype}: parameters "
                "are trained, so they are floating-point numbers. Keep constants in the closure of "
                "`apply`."
            )


def update(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Metrics]:
    """One rollout of T steps in B environments, then E epochs of K minibatches.

    Returns the next state and metrics, name -> [] float32. Observation and return statistics
    stay as they are until the end, so that the first policy ratio is exactly 1.
    """
    state, experience = collect(config, env, network, state)
    return improve(config, network, state, experience)


def collect(
    config: Config, env: Env, network: Network, state: TrainState, first: Array | int = 0
) -> tuple[TrainState, Experience]:
    """Acts for T steps in the environments of `state`, all or one shard's.

    Args:
      config: the hyperparameters.
      env: the environment.
      network: the network.
      state: with as many environments as are to act; they are moved on.
      first: number of the first of them among all.
    """
    memory, opening = state.carry, state.episode.length == 0
    state, transitions, finished, last_value = rollout(config, env, network, state, first)
    experience = Experience(
        batch=make_batch(config, state, transitions, last_value, opening),
        memory=memory,
        observations=running_moments.moments(
            state.normalizer, transitions.observation, transitions.valid
        ),
        returns=running_moments.moments(
            state.reward_normalizer, transitions.discounted_return, transitions.valid
        ),
        sums=rollout_sums(config, transitions, finished),
    )
    return state, experience


def improve(
    config: Config,
    network: Network,
    state: TrainState,
    experience: Experience,
    shards: Shards = WHOLE,
) -> tuple[TrainState, Metrics]:
    """Learns from what all shards have collected; reads nothing of the environments in `state`."""
    batch, memory, observations, returns, sums = experience
    state, learning = learn(config, network, state, batch, memory, shards)
    if shards.number > 1:
        observations, returns = map(running_moments.pool, gather(shards, (observations, returns)))
    state = state.replace(
        normalizer=running_moments.merge(state.normalizer, observations),
        reward_normalizer=running_moments.merge(state.reward_normalizer, returns),
        update=state.update + 1,
        steps=count_steps(config, state.steps),
    )
    return state, learning | rollout_metrics(total(shards, lambda x: x, sums))


def count_steps(config: Config, steps: Counter) -> Counter:
    """Adds one update's control steps."""
    return add_count(steps, jnp.asarray(config.steps_per_update, jnp.uint32))


def rollout_sums(config: Config, transitions: Transition, finished: Finished) -> Metrics:
    """Adds up what `rollout_metrics` needs over a rollout's steps and environments."""
    valid = transitions.valid.astype(jnp.float32)
    return {
        "reward": (valid * transitions.reward).sum(),
        "valid": valid.sum(),
        "episodes": finished.episodes.sum(),
        "episode_return": finished.episode_return.sum(),
        "episode_length": finished.length.sum(),
        "nonfinite_resets": finished.nonfinite_resets.sum().astype(jnp.float32),
        "replayed_resets": count_replays(config, finished.resets).astype(jnp.float32),
        **{f"episode/{name}": x.sum() for name, x in finished.metrics.items()},
    }


def rollout_metrics(sums: Metrics) -> Metrics:
    """Summarises a rollout: sums of counts, means over the episodes that ended in it.

    The reward is the mean over sound steps: NaN if there was none.
    """
    sums = dict(sums)
    reward = sums.pop("reward") / sums.pop("valid")
    episodes = jnp.maximum(sums["episodes"], 1.0)
    means = {
        k: x / episodes for k, x in sums.items() if k.startswith("episode") and k != "episodes"
    }
    return {"reward": reward} | sums | means
