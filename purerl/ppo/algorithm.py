"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

An update, in the order in which you would explain it: `collect` acts (`rollout.py`); `improve`
updates the statistics of returns (`running_moments.py`), estimates advantages (`batches.py`),
learns (`learner.py`), and updates the statistics of observations. `init` and `update` are pure. Jit
each as a whole, once: their bits depend on it.

A batch is computed in V parts, and the record `Parts` says how (`core/parts.py`). `WHOLE` is the
simplest: one part, V = 1, called as it is. Read with it in mind; who has several parts calls
`collect` for each and `improve` for all.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.env import Env
from purerl.core.keys import Purpose, derive, per_environment
from purerl.core.parts import WHOLE, Parts, add_in_order, as_one_part
from purerl.core.records import Array, Metrics, Network, PyTree, TrainState, add_count, zero_count
from purerl.ppo import batches, episodes, optimizer, running_moments
from purerl.ppo.config import Config
from purerl.ppo.learner import learn
from purerl.ppo.rollout import Transition, rollout
from purerl.ppo.running_moments import Moments, deviations, merge, pool


class Experience(NamedTuple):
    """What an update learns from; the axis of V parts is always there."""

    transitions: Transition  # [V, T, B, ...]
    memory: PyTree  # [V, B, H] the policy's at the start of the rollout
    env_ids: Array  # [V, B] int32
    observations: Moments  # [V, O] each
    returns: Moments  # [V] each, of the discounted return
    sums: Metrics  # name -> [V] over steps and environments


def init(config: Config, env: Env, network: Network, key: Array) -> TrainState:
    """Returns the state before the first update.

    Args:
      config: the hyperparameters.
      env: the environment, unbatched.
      network: the policy and value function.
      key: [] typed, of the run's seed; all of the state is drawn from it.

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
    params, memory = network.init(derive(key, Purpose.PARAMETERS))
    size, env_ids = config.num_envs, jnp.arange(config.num_envs, dtype=jnp.int32)
    env_state = jax.vmap(env.reset)(per_environment(derive(key, Purpose.FIRST_RESET), env_ids))
    # The first time limits are uniform in 1 to the environment's own, so that environments do not
    # stay in phase: B environments all at the same moment of an episode are one sample.
    limit_keys = per_environment(derive(key, Purpose.FIRST_LIMIT), env_ids)
    longest = episodes.time_limits(config, env_ids)
    limit = jax.vmap(lambda k, most: jax.random.randint(k, (), 1, most + 1))(limit_keys, longest)
    return TrainState(
        params=params,
        optimizer=optimizer.optimizer(config).init(params),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
        normalizer=running_moments.init(jax.tree.map(lambda x: x[0], env_state.observation)),
        reward_normalizer=running_moments.init(jnp.zeros(())),
        env_ids=env_ids,
        env_state=env_state,
        # Zeros, as `Network.init` promises: nobody remembers anything at the start of an episode.
        memory=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), memory),
        episode=episodes.start_episodes(env_state, limit.astype(jnp.int32)),
        discounted_return=jnp.zeros(size),
        key=key,
        update=jnp.zeros((), jnp.int32),
        steps=zero_count(),
        skipped_in_a_row=jnp.zeros((), jnp.int32),
    )


def start_stage(state: TrainState) -> TrainState:
    """Returns a state whose reward is about to be another: statistics of returns begin anew.

    Weighted by their counts, they would stay the old reward's for as long as it was trained.
    """
    nothing = running_moments.init(jnp.zeros(()))
    return state.replace(reward_normalizer=nothing, discounted_return=0 * state.discounted_return)


def update(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Metrics]:
    """Makes one rollout of T steps in B environments, then E epochs of K minibatches.

    Args:
      config: the hyperparameters.
      env: the environment, unbatched.
      network: the policy and value function.
      state: from `init` or the update before.

    Returns:
      The next state, and metrics, name -> [] float32.

    >>> step = jax.jit(functools.partial(purerl.update, config, env, network))  # those of `init`
    >>> state, metrics = step(state)
    >>> int(state.update), metrics["reward"].shape
    (1, ())
    """
    # Two functions, because parts are collected one by one and learned from together.
    state, experience = collect(config, env, network, state)
    return improve(config, network, state, experience)


def collect(
    config: Config, env: Env, network: Network, state: TrainState
) -> tuple[TrainState, Experience]:
    """Acts for T steps in the environments of `state`, all of them or those of one part.

    Args:
      config: the hyperparameters.
      env: the environment, unbatched.
      network: the policy and value function.
      state: of B environments.

    Returns:
      `state` with its environments moved on, and what was seen, as one part [1, ...].
    """
    # Kept from before the rollout: the learner unrolls the network from there.
    memory = state.memory
    state, transitions, sums = rollout(config, env, network, state)
    valid, seen = transitions.valid, transitions.observation
    experience = Experience(
        transitions=transitions,
        memory=memory,
        env_ids=state.env_ids,
        observations=deviations(state.normalizer, seen, valid),
        returns=deviations(state.reward_normalizer, transitions.discounted_return, valid),
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
    """Learns from what all parts have collected.

    Args:
      config: the hyperparameters.
      network: the policy and value function.
      state: for what is learned; its environments are not read.
      experience: [V, ...] of all parts.
      parts: how the V parts are computed.

    Returns:
      `state` with what was learned, and metrics, name -> [] float32.
    """
    seen = experience.observations, experience.returns, experience.sums
    observations, returns, sums = parts.gather(seen)
    # The statistics of returns have this rollout before its rewards are divided. Else they would be
    # of nothing in the first update, and targets as large as rewards come spoil a value function
    # for long. A point with a bonus of 1 for being alive (tests/ppo/test_probes.py) had lost 100
    # after ten updates, on four seeds, where it gains 43 of 50 now.
    state = state.replace(reward_normalizer=merge(state.reward_normalizer, pool(returns)))
    batch = parts.map(functools.partial(batches.make_batch, config, state), experience.transitions)
    part_ids = experience.env_ids[:, 0]  # no environment is in two parts, so its id names the part
    state, learning = learn(config, network, state, batch, experience.memory, part_ids, parts)
    # Those of observations move last. While they stood still, the learner normalized as the policy
    # that acted did, so that its first ratio was exactly 1.
    state = state.replace(
        normalizer=network.hold(state.normalizer, merge(state.normalizer, pool(observations))),
        update=state.update + 1,
        steps=add_count(state.steps, jnp.asarray(config.steps_per_update, jnp.uint32)),
    )
    return state, learning | rollout_metrics(jax.tree.map(add_in_order, sums))


def rollout_sums(transitions: Transition, sums: Metrics) -> Metrics:
    """Returns sums over steps and environments, name -> [].

    Args:
      transitions: [T, B, ...].
      sums: over the episodes that ended in each environment, name -> [B].
    """
    sound = transitions.valid.astype(jnp.float32)
    replayed = jnp.maximum(sums["resets"] - 1, 0).astype(jnp.float32)  # one start is fresh
    more = {"sound_steps": sound, "reward": sound * transitions.reward, "replayed_resets": replayed}
    return {name: x.sum() for name, x in (sums | more).items() if name != "resets"}


def rollout_metrics(sums: Metrics) -> Metrics:
    """Summarises a rollout: sums of counts, means over the episodes that ended in it.

    The reward is the mean over sound steps: NaN if there was none.
    """
    reward = sums["reward"] / sums["sound_steps"]
    # If no episode ended, its means are 0, and the count of episodes says so.
    ended = jnp.maximum(sums["episodes"], 1.0)
    means = {k: x / ended for k, x in sums.items() if k.startswith(("episode_", "episode/"))}
    counts = {k: x for k, x in sums.items() if k not in ("reward", "sound_steps")}
    return {"reward": reward} | counts | means
