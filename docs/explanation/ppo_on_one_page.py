"""PPO on one page: what `purerl.ppo` computes, without what a first reading can spare.

A body is in state s. Its policy pushes it by a = tanh(u), u drawn from the Gaussian pi(u | s) =
N(mu(s), sigma(s)^2), and the body returns a reward r(s, a). Wanted are the parameters of mu and
sigma that maximise the expected discounted return J = E[ sum_t gamma^t r_t ].

PPO (Schulman et al. 2017, arXiv:1707.06347) acts with the policy as it is, pi_old, for T steps in B
environments. Then it ascends, by passes of Adam over minibatches, and begins again:

    L = E_t[ min(rho_t A_t, clip(rho_t, 1 - c, 1 + c) A_t) - w (V(s_t) - G_t)^2 / 2 ]
    rho_t   = pi(u_t | s_t) / pi_old(u_t | s_t)    how much more likely the action has become
    delta_t = r_t + gamma V(s'_t) - V(s_t)         V(s'_t) is 0 if the task ended there
    A_t     = delta_t + gamma lambda A_{t+1}       the advantage; the sum ends with the episode
    G_t     = A_t + V_old(s_t)                     the target of the value function V

The ratio is clipped so that an update cannot go far on data of the old policy. A test holds this
page equal to `purerl.ppo.algorithm.update`, to the last bit. Left out: memory, colored noise, the
entropy bonus, short episodes, other schedules, lost simulations, batches in parts, metrics.
"""

from collections import namedtuple
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from purerl import Array, Config, Env, Network
from purerl.core.keys import Purpose, derive, per_environment

# Mean and variance of all that was seen. Each is a pair: a sum, and its rounding error (Kahan).
Running = namedtuple("Running", "count mean variance")


class State(NamedTuple):
    """All that a run is: `update` takes one and returns the next."""

    params: Any
    optimizer: Any  # Adam's moments
    observations: Running
    returns: Running  # of the discounted return, by whose deviation rewards are divided
    env_state: Any  # [B, ...]
    length: Array  # [B] int32 steps of the current episodes
    limit: Array  # [B] int32 their time limits
    discounted: Array  # [B] their discounted returns so far
    key: Array  # [] of the seed; never advanced, only folded into
    update: Array  # [] int32


# One step of B environments: arrays [B, ...]; a rollout's are [T, B, ...].
Row = namedtuple(
    "Row", "observation raw log_prob value reward discounted terminated truncated truncation_value"
)


def adam(config: Config) -> optax.GradientTransformation:
    """Returns Adam on clipped gradients, without the learning rate."""
    clip = optax.clip_by_global_norm(config.max_gradient_norm)
    return optax.chain(clip, optax.scale_by_adam(eps=1e-5))


def init(config: Config, env: Env, network: Network, key: Array) -> State:
    """Returns the state before the first update."""
    params, _ = network.init(derive(key, Purpose.PARAMETERS))
    ids = jnp.arange(config.num_envs, dtype=jnp.int32)
    env_state = jax.vmap(env.reset)(per_environment(derive(key, Purpose.FIRST_RESET), ids))
    # The first episodes end at random times, so that environments do not stay in phase.
    keys = per_environment(derive(key, Purpose.FIRST_LIMIT), ids)
    limit = jax.vmap(lambda k: jax.random.randint(k, (), 1, config.episode_length + 1))(keys)
    zeros = jnp.zeros_like(env_state.observation[0]), jnp.zeros(())
    statistics = (Running(jnp.uint32(0), (x, x), (x + 1, x)) for x in zeros)
    rest = env_state, 0 * ids, limit.astype(jnp.int32), 0.0 * ids, key, jnp.int32(0)
    return State(params, adam(config).init(params), *statistics, *rest)


def update(config: Config, env: Env, network: Network, state: State) -> State:
    """Makes one rollout, then E passes over it of K gradient steps each."""
    seen = state.observations  # stands still until the end, so that the first ratio is 1
    state, rows, last_value = rollout(config, env, network, state)

    # Advantages, from the last step to the first. The statistics of returns have this rollout.
    returns = merge(state.returns, rows.discounted)
    reward = rows.reward * (config.reward_scale * jax.lax.rsqrt(returns.variance[0] + 1e-8))
    following = jnp.concatenate([rows.value[1:], last_value[None]])
    following = jnp.where(rows.truncated, rows.truncation_value, following)
    delta = reward + config.gamma * jnp.where(rows.terminated, 0.0, following) - rows.value
    decay = jnp.where(rows.terminated | rows.truncated, 0.0, config.gamma * config.gae_lambda)

    def backward(after: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        return (total := step[0] + step[1] * after), total

    _, advantage = jax.lax.scan(backward, 0.0 * last_value, (delta, decay), reverse=True)

    # Samples one after another, [T * B, ...], and minibatches drawn from them.
    acted = normalize(seen, rows.observation), rows.raw, rows.log_prob
    batch = (*acted, advantage, advantage + rows.value)
    batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    rate = config.learning_rate * (1.0 - state.update.astype(jnp.float32) / config.num_updates)

    def epoch(learner: tuple, number: Array) -> tuple[tuple, None]:
        # The last 0 is the id of the first environment; a part of a batch shuffles by its own.
        key = derive(state.key, Purpose.PERMUTATION, state.update, number, 0)
        order = jax.random.permutation(key, len(batch[0]))
        return jax.lax.scan(step, learner, order.reshape(config.num_minibatches, -1))

    def step(learner: tuple, index: Array) -> tuple[tuple, None]:
        params, optimizer = learner
        minibatch = jax.tree.map(lambda x: x[index], batch)
        gradient = jax.grad(loss)(params, config, network, minibatch)
        direction, optimizer = adam(config).update(gradient, optimizer)
        return (jax.tree.map(lambda x, d: x - rate * d, params, direction), optimizer), None

    learner = state.params, state.optimizer
    (params, optimizer), _ = jax.lax.scan(epoch, learner, jnp.arange(config.num_epochs))
    state = state._replace(params=params, optimizer=optimizer, update=state.update + 1)
    return state._replace(observations=merge(seen, rows.observation), returns=returns)


def rollout(config: Config, env: Env, network: Network, state: State) -> tuple[State, Row, Array]:
    """Acts for T steps; returns the state, rows [T, B, ...] and the value of what follows [B]."""
    ids = jnp.arange(config.num_envs, dtype=jnp.int32)
    # What replaces the environments whose episodes end in this rollout.
    keys = per_environment(derive(state.key, Purpose.RESET, state.update), ids)
    fresh = jax.vmap(env.reset)(keys)

    def ask(env_state: Any) -> Any:
        observation = normalize(state.observations, env_state.observation)
        return network.apply(state.params, observation, ())[0]

    def step(now: tuple, t: Array) -> tuple[tuple, Row]:
        env_state, length, limit, discounted = now
        (loc, scale), value, _ = ask(env_state)
        keys = per_environment(derive(state.key, Purpose.ACTION, state.update, t), ids)
        raw = loc + scale * jax.vmap(lambda key: jax.random.normal(key, (env.action_size,)))(keys)
        after, length = jax.vmap(env.step)(env_state, jnp.tanh(raw)), length + 1
        truncated = (after.truncated | (length >= limit)) & ~after.terminated
        discounted = config.gamma * discounted + after.reward
        # V(s'), asked before the reset, and only in steps where an episode was cut off.
        asked, none = lambda: jnp.where(truncated, ask(after).value, 0.0), lambda: 0.0 * value
        truncation_value = jax.lax.cond(truncated.any(), asked, none)
        row = env_state.observation, raw, log_prob(loc, scale, raw), value, after.reward
        row = Row(*row, discounted, after.terminated, truncated, truncation_value)
        moved = after.replace(truncated=truncated), length, limit, discounted
        begun = fresh, 0 * length, jnp.full_like(limit, config.episode_length), 0.0 * discounted
        done = after.terminated | truncated

        def reset(new: Array, old: Array) -> Array:
            return jnp.where(jnp.expand_dims(done, tuple(range(1, old.ndim))), new, old)

        return jax.tree.map(reset, begun, moved), row

    start = state.env_state, state.length, state.limit, state.discounted
    end, rows = jax.lax.scan(step, start, jnp.arange(config.rollout_length))
    state = state._replace(env_state=end[0], length=end[1], limit=end[2], discounted=end[3])
    return state, rows, ask(end[0]).value


def loss(params: Any, config: Config, network: Network, minibatch: tuple) -> Array:
    """Returns -L of a minibatch, []; `old` are the log-probabilities of `raw` when it was drawn."""
    observation, raw, old, advantage, target = minibatch
    ((loc, scale), value, _), _ = network.apply(params, observation, ())
    std = jnp.maximum(jnp.sqrt(advantage.var()) + 1e-8, config.min_advantage_std)
    advantage = (advantage - advantage.mean()) / std
    advantage = jnp.clip(advantage, -config.advantage_clip, config.advantage_clip)
    ratio = jnp.exp(log_prob(loc, scale, raw) - old)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.minimum(ratio * advantage, clipped * advantage).mean()
    return policy_loss + config.value_weight * (0.5 * jnp.square(value - target)).mean()


def log_prob(loc: Array, scale: Array, raw: Array) -> Array:
    """Returns the log-density of tanh(raw), [...]: the Gaussian's, by a change of variables."""
    standardized = (raw - loc) / scale
    normal = -0.5 * (jnp.square(standardized) + np.log(2 * np.pi)) - jnp.log(scale)
    log_derivative = 2.0 * (np.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))  # log(1 - tanh^2)
    return normal.sum(-1) - log_derivative.sum(-1)


def normalize(running: Running, x: Array) -> Array:
    """Returns (x - mean) / std, clipped to +-10."""
    return jnp.clip((x - running.mean[0]) * jax.lax.rsqrt(running.variance[0] + 1e-8), -10.0, 10.0)


def merge(running: Running, x: Array) -> Running:
    """Adds a batch [T, B, ...] to the statistics (Chan, Golub and LeVeque 1979)."""
    size = x.shape[0] * x.shape[1]
    deviation = x - running.mean[0]
    delta = deviation.sum((0, 1)) / size
    spread = jnp.square(deviation - delta).sum((0, 1)) / size
    count = running.count + jnp.uint32(size)
    share = size / count.astype(jnp.float32)
    change = share * (spread - running.variance[0]) + share * (1.0 - share) * jnp.square(delta)

    def add(total: tuple[Array, Array], increment: Array) -> tuple[Array, Array]:
        repaid = increment - total[1]  # the rounding error of the addition before
        value = total[0] + repaid
        return value, (value - total[0]) - repaid

    return Running(count, add(running.mean, share * delta), add(running.variance, change))
