"""Networks that imitate through a small code, and that use the code again in other tasks.

`imitate`: an encoder makes a code of what is to come, and a decoder moves the body by the code and
by what the body feels (Merel et al. 2019, arXiv:1811.11711). The code costs what it tells: its KL
from N(0, I). Beside it a prior learns to guess the code from what the body feels alone; its loss
stops at the encoder, so it needs no training of its own.

`reuse`: a policy for another task, whose action is the code. It says how far from the prior's mean
the code is to be, in the prior's deviations and within a ball: a code that the decoder has never
met moves the body in no way that it learned. Decoder and prior are parts of the other run, frozen.

Leading axes of all arrays, `...`, are batch axes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl import Array, Network, Normal, PolicyOutput, PyTree, networks

FELT, TOLD = "proprioception", "reference"  # entries of an observation, as `imitation` has them
LEAST_LOG_STD, MOST_LOG_STD = -5.0, 2.0  # of a code


@dataclass(frozen=True)
class CodeOptions:
    """Sizes of what both networks share: equal, or the one cannot take the other's parts."""

    code: int = 16
    """Numbers of the code."""
    decoder: tuple[int, ...] = (512, 256)
    """Widths of the decoder."""
    prior: tuple[int, ...] = (256, 256)
    """Widths of the prior."""
    initial_std: float = 0.3
    """Scale of raw actions before training, above `min_std`."""
    min_std: float = 1e-3
    """Their least scale, to which what is learned is added."""

    def __post_init__(self) -> None:
        """Refuses sizes and scales of which no network can be made."""
        widths = [n for x in vars(self).values() if isinstance(x, tuple) for n in x]
        if min(self.code, *widths) < 1:
            raise ValueError(f"{self} has a width below 1.")
        if not (1e-3 <= self.initial_std <= 100.0 and 1e-6 <= self.min_std <= 100.0):
            said = f"initial_std is {self.initial_std}, min_std {self.min_std}"
            raise ValueError(f"{said}; they must be 0.001 to 100, and 1e-6 to 100.")


@dataclass(frozen=True)
class ImitationOptions(CodeOptions):
    """Sizes of a network that imitates."""

    encoder: tuple[int, ...] = (512, 256)
    """Widths of the encoder."""
    value: tuple[int, ...] = (512, 256)
    """Widths of the value function."""


@dataclass(frozen=True)
class ReuseOptions(CodeOptions):
    """How a policy uses a code again."""

    task: networks.PolicyOptions = networks.MlpOptions()
    """Of the network that `reuse` is given, whose action is the code; its scale counts nowhere."""
    radius: float = 5.0
    """Farthest that a code may be from the prior's mean, in the prior's deviations. Of codes of 16
    numbers that are drawn from the prior, 95% are nearer than 5.1."""
    from_prior: bool = True
    """False: the code itself is what the task's policy says, wherever that is. The loss `anchor`
    draws it to the prior nevertheless, so give that a weight of 0."""

    def __post_init__(self) -> None:
        """Refuses a ball without an inside."""
        super().__post_init__()
        if not self.radius > 0.0:
            raise ValueError(f"radius is {self.radius}; it must be above 0.")


class Tower(nn.Module):
    """Dense layers, each followed by a LayerNorm and swish; [..., O] to [..., last width]."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns [..., last width]."""
        for width in self.widths:
            x = nn.swish(nn.LayerNorm()(nn.Dense(width)(x)))
        return x


class Coder(nn.Module):
    """What it reads [..., O] to a Gaussian over codes [..., code]: an encoder, or a prior."""

    widths: tuple[int, ...]
    code: int

    @nn.compact
    def __call__(self, x: Array) -> Normal:
        """Returns the Gaussian, [..., code]."""
        small = nn.initializers.variance_scaling(1e-2, "fan_in", "truncated_normal")
        both = nn.Dense(2 * self.code, kernel_init=small)(Tower(self.widths)(x))
        mean, log_std = jnp.split(both, 2, axis=-1)
        return Normal(mean, jnp.exp(jnp.clip(log_std, LEAST_LOG_STD, MOST_LOG_STD)))


class Decoder(nn.Module):
    """What a body feels [..., P] and a code [..., code] to the means of raw actions [..., A]."""

    widths: tuple[int, ...]
    action_size: int

    @nn.compact
    def __call__(self, felt: Array, code: Array) -> Array:
        """Returns [..., A]."""
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        hidden = Tower(self.widths)(jnp.concatenate([felt, code], axis=-1))
        return nn.Dense(self.action_size, kernel_init=small)(hidden)


class Imitator(nn.Module):
    """Encoder, code and decoder; beside them a prior, and a value function."""

    options: ImitationOptions
    action_size: int

    @nn.compact
    def __call__(self, observation: PyTree, noise: Array | None = None) -> PolicyOutput:
        """Acts through a code that is drawn, and says what the code costs.

        Args:
          observation: with `reference` [..., R] and `proprioception` [..., P].
          noise: [..., code] standard normal; without it the code is its mean.
        """
        o, felt = self.options, observation[FELT]
        both = jnp.concatenate([observation[TOLD], felt], axis=-1)
        coded = Coder(o.encoder, o.code, name="encoder")(both)
        code = coded.loc if noise is None else coded.loc + coded.scale * noise
        prior = Coder(o.prior, o.code, name="prior")(felt)
        guessed = jax.tree.map(jax.lax.stop_gradient, coded)  # the code is not to be easy to guess
        losses = {
            "code_kl": divergence(coded, Normal(jnp.zeros(()), jnp.ones(()))),
            "prior_kl": divergence(guessed, prior),
        }
        loc = Decoder(o.decoder, self.action_size, name="decoder")(felt, code)
        value = nn.Dense(1, name="value_out")(Tower(o.value, name="value")(both))[..., 0]
        return PolicyOutput(Normal(loc, action_scale(self, o, loc)), value, losses)


class FromCode(nn.Module):
    """Prior and decoder, which another run has learned; the scale of the actions is new."""

    options: ReuseOptions
    action_size: int

    @nn.compact
    def __call__(self, felt: Array, wish: Array) -> tuple[Normal, dict[str, Array]]:
        """Acts by a code.

        Args:
          felt: [..., P] the observation's `proprioception`.
          wish: [..., code] what the task's policy says.

        Returns:
          Gaussian over raw actions [..., A]. Losses [...]: `anchor`, the mean square of the code's
          deviation from the prior's mean; `code_distance`, its length, to be logged. Both are in
          the prior's deviations.
        """
        o = self.options
        prior = Coder(o.prior, o.code, name="prior")(felt)
        away = in_ball(wish, o.radius)
        if not o.from_prior:
            away = (wish - prior.loc) / prior.scale
        code = prior.loc + prior.scale * away
        loc = Decoder(o.decoder, self.action_size, name="decoder")(felt, code)
        apart = jnp.square(away)
        losses = {"anchor": apart.mean(-1), "code_distance": jnp.sqrt(apart.sum(-1) + 1e-12)}
        return Normal(loc, action_scale(self, o, loc)), losses


def action_scale(module: nn.Module, options: CodeOptions, loc: Array) -> Array:
    """Returns the scale of actions, one learned vector for all of `loc` [..., A]."""
    raw = module.param("scale", nn.initializers.zeros, loc.shape[-1:])
    start = math.log(math.expm1(options.initial_std))
    return jnp.broadcast_to(jax.nn.softplus(raw + start) + options.min_std, loc.shape)


def divergence(p: Normal, q: Normal) -> Array:
    """Returns KL(p || q) of Gaussians [..., code], the mean over a code's numbers, [...] [nats]."""
    squares = jnp.square(p.scale / q.scale) + jnp.square((p.loc - q.loc) / q.scale)
    return (0.5 * (squares - 1.0) + jnp.log(q.scale / p.scale)).mean(-1)


def in_ball(x: Array, radius: float) -> Array:
    """Returns `x` [..., code] drawn into a ball: in its middle nearly itself, never outside."""
    return x / jnp.sqrt(1.0 + jnp.square(x).sum(-1, keepdims=True) / radius**2)


def imitate(options: ImitationOptions, observation: PyTree, action_size: int) -> Network:
    """Builds a network that imitates through a code; its losses are `code_kl` and `prior_kl`.

    Args:
      options: its sizes.
      observation: an example of one, unbatched: `reference` [R] and `proprioception` [P].
      action_size: A.
    """
    check_entries(observation, FELT, TOLD)
    network = networks.from_linen(Imitator(options, action_size), observation)
    return network._replace(draw=lambda key: jax.random.normal(key, (options.code,)))


def reuse(build: Callable[[Any, PyTree, int], Network]) -> Callable[..., Network]:
    """Returns a builder of networks that act by a code: what `build` makes is the task's policy.

    That reads its observation as it always does, and may have eyes and a memory. Of the Gaussian
    that it returns only the means count: exploration is of actions. Decoder and prior read
    `proprioception` alone.
    """

    def built(options: ReuseOptions, observation: PyTree, action_size: int) -> Network:
        check_entries(observation, FELT)
        task = build(options.task, observation, options.code)
        moves = FromCode(options, action_size)

        def init(key: Array) -> tuple[PyTree, PyTree]:
            task_key, own_key = jax.random.split(key)
            params, memory = task.init(task_key)
            own = moves.init(own_key, observation[FELT], jnp.zeros(options.code))
            return {"params": {"task": params, **own["params"]}}, memory

        def apply(params: PyTree, observation: PyTree, *given: PyTree, **more: Any) -> tuple:
            own = dict(params["params"])
            output, memory = task.apply(own.pop("task"), observation, *given, **more)
            wish = output.distribution.loc
            answer: Any = moves.apply({"params": own}, observation[FELT], wish)
            policy, losses = answer
            return PolicyOutput(policy, output.value, losses | output.losses), memory

        vars(apply)["sequences"] = getattr(task.apply, "sequences", False)
        return task._replace(init=init, apply=apply)

    return built


def check_entries(observation: PyTree, *names: str) -> None:
    """Raises ValueError unless an observation is a dict that has these entries."""
    there = sorted(observation) if isinstance(observation, dict) else ["one array"]
    if missing := [name for name in names if name not in there]:
        raise ValueError(
            f"The observation has no {missing[0]!r} ({', '.join(there)}): take envs.imitation, or "
            "--env.proprioception of envs.run."
        )
