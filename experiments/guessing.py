"""A network that guesses from what it sees what another run was told, and moves as that one does.

What it has to learn is supervised: its guess of `privileged`, from pictures, from what the body
feels and from its memory. The policy, which reads the guess in place of the truth, is a part of the
run that was told; it may stay as it is, or learn on. Teachers that are told more than students see:
Chen et al. 2019, "Learning by Cheating" (arXiv:1912.12294); to learn on states of one's own making:
Ross et al. 2011, "DAgger" (arXiv:1011.0686).

Leading axes of all arrays, `...`, are batch axes.
"""

from dataclasses import dataclass, field

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl import Array, Network, PolicyOutput, PyTree, eyes as seeing, networks

FELT, TOLD, PICTURES = "policy", "privileged", "eyes"  # entries of an observation
KINK = 0.3  # beyond it an error costs in proportion: a gap that is taken for the next is no outlier


@dataclass(frozen=True)
class Options:
    """Sizes of the network."""

    eyes: seeing.Encoder = field(default_factory=seeing.Encoder)
    features: int = 256
    """What it makes of pictures and feelings, before its memory."""
    hidden: int = 128
    """Features of its memory, a GRU."""
    policy: networks.MlpOptions = networks.MlpOptions()
    """Of the run that was told."""

    def __post_init__(self) -> None:
        """Refuses sizes of which no network can be made."""
        if min(self.features, self.hidden) < 1:
            said = f"features is {self.features}, hidden {self.hidden}"
            raise ValueError(f"{said}; a layer has at least 1 unit.")


class Guesser(nn.Module):
    """Guesses what is privileged; acts by what it feels and by its guess."""

    options: Options
    action_size: int

    @nn.compact
    def __call__(
        self, observation: PyTree, memory: Array, *, is_first: Array | None = None
    ) -> tuple[PolicyOutput, Array]:
        """Moves the memory [..., H] on, and answers from it; `is_first` as of `networks.remember`.

        Its losses are `guess`, and `guess_error`, which is to be logged: the mean distance of the
        guess from what it guesses, in that one's deviations.
        """
        o, felt, told = self.options, observation[FELT], observation[TOLD]
        pictures, encoder = observation[PICTURES], seeing.Convolutions(o.eyes)
        seen = [encoder(pictures[..., i, :, :]) for i in range(pictures.shape[-3])]
        now = nn.swish(nn.Dense(o.features)(jnp.concatenate([felt, *seen], -1)))
        cell = nn.GRUCell(o.hidden, name="cell")
        memory, remembered = networks.remember(cell, memory, now, is_first)
        both = nn.swish(nn.Dense(o.hidden)(jnp.concatenate([remembered, now], -1)))
        guess = nn.Dense(told.shape[-1], name="guess")(both)
        # The policy's gradient stops here: what it would like to be told is not what is there.
        read = jnp.concatenate([felt, jax.lax.stop_gradient(guess)], -1)
        acts = networks.Stack(o.policy.policy_hidden, o.policy.activation, name="policy")(read)
        normal = networks.GaussianHead(o.policy, self.action_size, name="head")(acts)
        truth = jnp.concatenate([felt, told], -1)
        value = networks.Stack(o.policy.value_hidden, o.policy.activation, name="value")(truth)
        away = jnp.abs(guess - told)
        losses = {"guess": huber(away).mean(-1), "guess_error": away.mean(-1)}
        return PolicyOutput(normal, nn.Dense(1, name="value_out")(value)[..., 0], losses), memory


def huber(away: Array) -> Array:
    """Returns an error's cost: its square, and from `KINK` on its size (Huber 1964)."""
    return jnp.where(away < KINK, jnp.square(away) / (2.0 * KINK), away - 0.5 * KINK)


def guess(options: Options, observation: PyTree, action_size: int) -> Network:
    """Builds a network that guesses what is privileged; its loss is `guess`.

    Args:
      options: its sizes.
      observation: an example of one, unbatched: `policy` [O], `privileged` [P], `eyes` [E, H, W].
      action_size: A.
    """
    there = sorted(observation) if isinstance(observation, dict) else ["one array"]
    if there != sorted((FELT, TOLD, PICTURES)):
        raise ValueError(
            f"The observation has {', '.join(there)}; this network needs {FELT}, {TOLD} and "
            f"{PICTURES}: an environment that tells the value function more, with eyes "
            "(--env.eyes.number 2, say)."
        )
    memory = jnp.zeros(options.hidden)
    return networks.from_linen(Guesser(options, action_size), observation, memory)
