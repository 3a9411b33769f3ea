"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

An update, in the order in which you would explain it: `collect` acts and estimates advantages
(`rollout.py`, `batches.py`); `improve` learns (`learner.py`), then updates the statistics of
observations and returns (`running_moments.py`). `init` and `update` are pure. Jit each as a whole,
once: their bits depend on it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.parts import WHOLE, Parts, add_in_order, as_one_part
from purerl.core.records import Array, Metrics, Network, PyTree, TrainState, add_count, zero_count
from purerl.ppo import running_moments
from purerl.ppo.batches import Batch, make_batch
from purerl.ppo.config import Config
from purerl.ppo.learner import learn
from purerl.ppo.optimizer import optimizer
from purerl.ppo.rollout import Transition, rollout, start_episodes, time_limits
from purerl.ppo.running_moments import Moments


class Experience(NamedTuple):
    """What an update learns from; the axis of V parts is always there."""

    batch: Batch  # [V, T, B, ...]
    memory: PyTree  # [V, B, H] the policy's at the start of the rollout
    number: Array  # [V, B] the environments' numbers
    observations: Moments  # [V, ...]
    returns: Moments  # [V] of the discounted return
    sums: Metrics  # name -> [V]


def init(config: Config, env: Env, network: Network, key: Array) -> TrainState:
    """Returns the state before the first update, all of it drawn from `key` [].

    The first episodes' time limits are uniform in 1 to the environment's own, so that environments
    do not stay in phase: B environments all at the same moment of an episode are one sample.

    >>> env = purerl.envs.cartpole_swingup.build()
    >>> config = purerl.Config(num_steps=8192, num_envs=8, rollout_length=32, num_minibatches=4)
    >>> observation = env.reset(jax.random.key(0)).observation
    >>> options = purerl.networks.MlpOptions()
    >>> network = purerl.networks.mlp(options, observation, env.action_size)
    >>> begin = jax.jit(functools.partial(purerl.init, config, env, network))
    >>> state = begin(jax.random.key(1))
    >>> int(state.update), state.discounted_return.shape
    (0, (8,))
    """
    params, carry = network.init(derive(key, Purpose.PARAMETERS))
    size, number = config.num_envs, jnp.arange(config.num_envs, dtype=jnp.int32)
    env_state = jax.vmap(env.reset)(per_environment(derive(key, Purpose.FIRST_RESET), number))
    limit_keys = per_environment(derive(key, Purpose.FIRST_LIMIT), number)
    limit = jax.vmap(lambda k, longest: jax.random.randint(k, (), 1, longest + 1))(
        limit_keys, time_limits(config, number)
    )
    return TrainState(
        params=params,
        optimizer=optimizer(config).init(params),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        normalizer=running_moments.init(jax.tree.map(lambda x: x[0], env_state.observation)),
        reward_normalizer=running_moments.init(jnp.zeros(())),
        number=number,
        env=env_state,
        carry=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), carry),
        episode=start_episodes(env_state, limit.astype(jnp.int32)),
        discounted_return=jnp.zeros(size),
        key=key,
        update=jnp.zeros((), jnp.int32),
        steps=zero_count(),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
    )


def update(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Metrics]:
    """Makes one rollout of T steps in B environments, then E epochs of K minibatches.

    Returns:
      The next state, and metrics, name -> [] float32. Observation and return statistics stay as
      they are until the end, so that the first policy ratio is exactly 1.

    >>> step = jax.jit(functools.partial(purerl.update, config, env, network))  # those of `init`
    >>> state, metrics = step(state)
    >>> int(state.update), metrics["reward"].shape
    (1, ())
    """
    state, experience = collect(config, env, network, state)
    return improve(config, network, state, experience)


def collect(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Experience]:
    """Acts for T steps in the environments of `state`, all of them or those of one part.

    Returns:
      `state` with its environments moved on, and what was seen, as one part [1, ...].
    """
    memory, opening = state.carry, state.episode.length == 0
    state, transitions, sums, last_value = rollout(config, env, network, state)
    valid, seen = transitions.valid, transitions.observation
    experience = Experience(
        batch=make_batch(config, state, transitions, last_value, opening),
        memory=memory,
        number=state.number,
        observations=running_moments.deviations(state.normalizer, seen, valid),
        returns=running_moments.deviations(
            state.reward_normalizer, transitions.discounted_return, valid
        ),
        sums=rollout_sums(transitions, sums),
    )
    return state, as_one_part(experience)


def improve(
    config: Config,
    network: Network,
    state: TrainState,
    experience: Experience,
    parts: Parts = WHOLE,
) -> tuple[TrainState, Metrics]:
    """Learns from what all parts have collected; does not read the environments in `state`."""
    batch, memory, number, *rest = experience
    state, learning = learn(config, network, state, batch, memory, number[:, 0], parts)
    observations, returns, sums = parts.gather(rest)
    pool, merge = running_moments.pool, running_moments.merge
    state = state.replace(
        normalizer=merge(state.normalizer, pool(observations)),
        reward_normalizer=merge(state.reward_normalizer, pool(returns)),
        update=state.update + 1,
        steps=add_count(state.steps, jnp.asarray(config.steps_per_update, jnp.uint32)),
    )
    return state, learning | rollout_metrics(jax.tree.map(add_in_order, sums))


def rollout_sums(transitions: Transition, sums: Metrics) -> Metrics:
    """Returns sums over steps and environments, name -> []; from `sums` of each environment [B]."""
    valid, resets = transitions.valid.astype(jnp.float32), sums.pop("resets")
    replayed = jnp.maximum(resets - 1, 0).astype(jnp.float32)  # an update has one fresh start each
    sums |= {"valid": valid, "reward": valid * transitions.reward, "replayed_resets": replayed}
    return {name: x.sum() for name, x in sums.items()}


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
