"""Planning by sampling: predictive sampling, MPPI and the cross-entropy method, with one action.

Before each action, N plans are drawn around the last one, and each is played H steps ahead in the
simulation. What they returned makes the next plan, of which the first action is taken (a receding
horizon). All three planners are a mean of the samples, theta' = sum_i w_i theta_i, and
differ in the weights w alone:

- predictive sampling (Howell et al. 2022, arXiv:2212.00541): 1 for the best sample. The last plan
  is one of them, so a plan is never replaced by a worse one.
- MPPI (Williams et al. 2017, "Information theoretic MPC for model-based reinforcement learning"):
  w_i = exp((R_i - max R) / lambda) / sum_j exp((R_j - max R) / lambda).
- CEM (Rubinstein 1999, "The cross-entropy method for combinatorial and continuous optimization"):
  1 / M for the M best samples, the elites; their standard deviation is that of the next iteration.

A plan theta is the knots of a spline (splines.py). Shapes: N samples, H steps, K knots, A actions.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.env import Env, State
from purerl.core.records import Array, Network, PyTree, TrainState
from purerl.ppo import batches, distributions, episodes
from purerl.ppo.config import Config
from purerl.tune.plan import splines
from purerl.tune.plan.settings import Settings

# The noise of the first sample and of the last, of the settings' noise. In its first 200 steps a
# cheetah earned 83 with it, and 66 with the same noise for all (one episode each).
SPREAD = (0.25, 4.0)
# CEM: what is left of the noise where the elites agree, so that a plan can still change.
LEAST_NOISE = 0.05
# MPPI: returns as close as this are equal.
EQUAL = 1e-6


class Guide(NamedTuple):
    """A trained policy: plans are corrections of its actions, and it values what comes after them.

    `act(state, memory) -> (action, value, memory)`, of environments [B]: actions [B, A], and the
    discounted return to come [B] in the units of the reward.
    """

    act: Callable[[State, PyTree], tuple[Array, Array, PyTree]]
    memory: PyTree  # of one environment, at the start of an episode
    discount: float  # gamma, of one control step: the value's


class Plan(NamedTuple):
    """What a planner keeps from one action to the next, of one environment."""

    knots: Array  # [K, A]
    memory: PyTree  # the guide's, before the next action
    value: Array  # [] the return that the plan was expected to have


def guide(config: Config, network: Network, state: TrainState) -> Guide:
    """Returns the deterministic policy of a run as a guide.

    Args:
      config: for the scale of the rewards that the value was learned from.
      network: the run's.
      state: for `params`, `normalizer`, `reward_normalizer` and the shape of the memory.
    """
    factor = batches.reward_factor(config, state)

    def act(env: State, memory: PyTree) -> tuple[Array, Array, PyTree]:
        output, memory = episodes.act(network, state, env, memory)
        return distributions.to_action(output.distribution.loc), output.value / factor, memory

    memory = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), state.memory)
    return Guide(act, memory, config.gamma)


def unguided(action_size: int) -> Guide:
    """Returns the guide of whoever has learned nothing: actions 0, values 0, no discount."""

    def act(env: State, memory: PyTree) -> tuple[Array, Array, PyTree]:
        number = env.reward.shape
        return jnp.zeros((*number, action_size)), jnp.zeros(number), memory

    return Guide(act, (), 1.0)


def guide_of(config: Config, env: Env, network: Network, learned: TrainState | None) -> Guide:
    """Returns the guide of what was learned; of nothing, None, `unguided`."""
    return unguided(env.action_size) if learned is None else guide(config, network, learned)


def start(settings: Settings, env: Env, guide: Guide) -> Plan:
    """Returns the plan at the start of an episode: to do nothing, or what the guide does."""
    knots = jnp.zeros((settings.knots, env.action_size))
    return Plan(knots, guide.memory, jnp.zeros(()))


def plan(
    settings: Settings, env: Env, guide: Guide, last: Plan, state: State, key: Array
) -> tuple[Plan, Array]:
    """Chooses the next action of one environment; pure.

    Args:
      settings: of the planner.
      env: the environment in which plans are played.
      guide: `guide` of a run, or `unguided`.
      last: the plan of the step before, or `start`.
      state: of the environment.
      key: [] typed, of this step.

    Returns:
      The new plan, and the action [A] in [-1, 1].
    """
    count = settings.samples
    begin = (state, last.memory)
    states, memories = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), begin)

    def improve(center: tuple[Array, Array], turn: Array) -> tuple[tuple[Array, Array], Array]:
        knots = draw(settings, *center, jax.random.fold_in(key, turn))
        returns = play(settings, env, guide, states, memories, knots)
        share = sample_weights(settings, returns)
        value = jnp.sum(jnp.where(share > 0.0, share * returns, 0.0))
        return summarize(settings, knots, share), value

    mean = shift(settings, last.knots)
    around = (mean, jnp.full(mean.shape, settings.noise))
    (knots, _), values = jax.lax.scan(improve, around, jnp.arange(settings.iterations))

    one = jax.tree.map(lambda x: x[None], begin)
    base, _, memory = guide.act(*one)
    action = jnp.clip(base[0] + spline(settings, knots[None])[0, 0], -1.0, 1.0)
    return Plan(knots, jax.tree.map(lambda x: x[0], memory), values[-1]), action


def spline(settings: Settings, knots: Array) -> Array:
    """Returns the values of splines at the H steps of a plan: [N, K, A] -> [H, N, A]."""
    return jnp.einsum("hk,nka->hna", _matrix(settings, 0), knots)


def shift(settings: Settings, knots: Array) -> Array:
    """Returns the knots [K, A] of the same plan one step later; its last action is repeated."""
    return jnp.asarray(_matrix(settings, 1)) @ knots


def _matrix(settings: Settings, later: int) -> np.ndarray:
    """Returns the weights of knots at a plan's steps [H, K], or at its own knots one step later."""
    places = splines.knot_times(settings.spline, settings.horizon, settings.knots)
    times = places + 1.0 if later else np.arange(settings.horizon)
    return splines.weights(settings.spline, times, places)


def draw(settings: Settings, mean: Array, scale: Array, key: Array) -> Array:
    """Draws samples [N, K, A] around a plan [K, A] with standard deviations [K, A].

    The first one is the plan itself, the second is 0: what the guide does by itself. From sample to
    sample the noise grows, from the first of `SPREAD` times `scale` to the last: fine corrections
    and new beginnings in one batch.
    """
    spread = jnp.geomspace(*SPREAD, settings.samples)[:, None, None]
    noise = jax.random.normal(key, (settings.samples, *mean.shape)).at[0].set(0.0)
    samples = jnp.clip(mean + spread * scale * noise, -1.0, 1.0)
    return samples.at[1].set(0.0)


def play(
    settings: Settings, env: Env, guide: Guide, state: State, memory: PyTree, knots: Array
) -> Array:
    """Plays plans in the simulation; returns what each is worth, [N].

      R = sum_{h<H} gamma^h r_h + gamma^H V(s_H)

    What comes after a termination counts zero; a truncation is worth the value of its state. The
    value at the horizon is as in POLO (Lowrey et al. 2019, arXiv:1811.01848). A simulation that is
    lost, its state no longer finite, is worth -inf.

    Args:
      settings: for H.
      env: the environment.
      guide: adds its actions, and values the end; for gamma.
      state: where the plans begin, [N, ...].
      memory: the guide's, [N, ...].
      knots: of the plans, [N, K, A].
    """

    def step(carry: tuple, offset: Array) -> tuple[tuple, None]:
        state, memory, total, weight, due = carry
        action, value, memory = guide.act(state, memory)
        total += jnp.where(due > 0.0, due * value, 0.0)
        state = jax.vmap(env.step)(state, jnp.clip(action + offset, -1.0, 1.0))
        total += jnp.where(weight > 0.0, weight * state.reward, 0.0)
        weight *= guide.discount
        due = jnp.where(state.truncated & ~state.terminated, weight, 0.0)
        weight = jnp.where(state.terminated | state.truncated, 0.0, weight)
        return (state, memory, total, weight, due), None

    zeros = jnp.zeros(knots.shape[0])
    begin = (state, memory, zeros, zeros + 1.0, zeros)
    end, _ = jax.lax.scan(step, begin, spline(settings, knots))
    state, memory, total, weight, due = end
    _, value, _ = guide.act(state, memory)
    due += weight
    total += jnp.where(due > 0.0, due * value, 0.0)
    lost = (weight > 0.0) & jax.vmap(episodes.is_lost)(state)
    return jnp.where(lost | ~jnp.isfinite(total), -jnp.inf, total)


def sample_weights(settings: Settings, returns: Array) -> Array:
    """Returns the share of each sample in the next plan, [N] of sum 1.

    Lost samples (-inf) have no share; if all are, the last plan stays. If all samples are worth
    exactly the same, a random one is taken: where the reward says nothing, the body moves about and
    comes to where it says something, instead of lying still.
    """
    sound = jnp.isfinite(returns)
    first, last = jax.nn.one_hot(jnp.array([0, len(returns) - 1]), len(returns))
    nothing_known = jnp.all(returns == returns[0]) & sound.all()
    share = jnp.where(nothing_known, last, _shares(settings, returns, sound))
    return jnp.where(sound.any(), share, first)


def _shares(settings: Settings, returns: Array, sound: Array) -> Array:
    """Returns the shares by the equations of the module.

    MPPI's temperature lambda is a multiple of the standard deviation of the returns, so that it
    means the same for rewards of any scale.
    """
    if settings.planner == "predictive_sampling":
        return jax.nn.one_hot(jnp.argmax(returns), len(returns))
    if settings.planner == "mppi":
        count = jnp.maximum(sound.sum(), 1)
        mean = jnp.sum(jnp.where(sound, returns, 0.0)) / count
        spread = jnp.sqrt(jnp.sum(jnp.where(sound, (returns - mean) ** 2, 0.0)) / count)
        below = (returns - returns.max()) / (settings.temperature * spread + EQUAL)
        share = jnp.where(sound, jnp.exp(below), 0.0)
    else:
        _, places = jax.lax.top_k(returns, settings.elites)
        share = jax.nn.one_hot(places, len(returns)).sum(axis=0) * sound
    return share / jnp.maximum(share.sum(), EQUAL)


def summarize(settings: Settings, knots: Array, share: Array) -> tuple[Array, Array]:
    """Returns mean and standard deviation [K, A] of the next samples, of these [N, K, A]."""
    mean = jnp.einsum("n,nka->ka", share, knots)
    if settings.planner != "cem":
        return mean, jnp.full(mean.shape, settings.noise)
    variance = jnp.einsum("n,nka->ka", share, (knots - mean) ** 2)
    return mean, jnp.maximum(jnp.sqrt(variance), LEAST_NOISE)
