"""Policy and value networks: the default MLP, recurrent ones, and an adapter for any Flax module.

The algorithm knows only `Network(init, apply)`. This module alone imports a network library.
"""

import inspect
import math
from dataclasses import dataclass
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl.core.records import Array, Network, Normal, PolicyOutput, PyTree
from purerl.ppo.checks import check_observation
from purerl.ppo.episodes import restarted


@dataclass(frozen=True)
class PolicyOptions:
    """What both networks below can choose."""

    activation: Literal["elu", "relu", "swish", "tanh"] = "swish"
    """Nonlinearity of the feed-forward layers."""
    std: Literal["learned", "state"] = "learned"
    """Policy scale: one learned vector, or a function of the observation."""
    initial_std: float = 1.0
    """Policy scale before training, above `min_std`, in raw-action units."""
    # A standing cart-pole's was 0.04. Steps became leaps, and it fell.
    min_std: float = 0.2
    """Least policy scale, to which what is learned is added."""

    def __post_init__(self) -> None:
        """Raises ValueError for a scale or a width that is none."""
        if not 1e-6 <= self.min_std <= 100.0:  # a policy of scale 0 has an infinite density
            raise ValueError(f"min_std is {self.min_std}; it must be 1e-6 to 100.")
        if not 1e-3 <= self.initial_std <= 100.0:
            raise ValueError(f"initial_std is {self.initial_std}; it must be 0.001 to 100.")
        for name in {"policy_hidden", "value_hidden", "hidden", "encoder"} & vars(self).keys():
            if min(jax.tree.leaves(x := vars(self)[name]), default=1) < 1:
                raise ValueError(f"{name} is {x}; a layer has at least 1 unit.")


@dataclass(frozen=True)
class MlpOptions(PolicyOptions):
    """Sizes of the default feed-forward network."""

    policy_hidden: tuple[int, ...] = (128, 128)
    """Widths of the policy's hidden layers."""
    value_hidden: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers."""


@dataclass(frozen=True)
class RecurrentOptions(MlpOptions):
    """Sizes of the recurrent network: those of the default one, which reads a memory too."""

    cell: Literal["gru", "lstm"] = "gru"
    """Kind of recurrent cell."""
    hidden: int = 128
    """Features of the cell's memory."""
    encoder: tuple[int, ...] = (128,)
    """Widths of the layers before the cell."""


def policy_features(observation: PyTree) -> Array:
    """Returns what the policy may read, [..., O]: the array, or the entry "policy" of a dict."""
    return observation["policy"] if isinstance(observation, dict) else observation


def value_features(observation: PyTree) -> Array:
    """Returns what the value function may read, [..., O]: every entry of a dict, in name order."""
    if not isinstance(observation, dict):
        return observation
    return jnp.concatenate([observation[name] for name in sorted(observation)], axis=-1)


class Stack(nn.Module):
    """Dense layers with an activation after each; [..., O] to [..., last width]."""

    widths: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Returns [..., last width]."""
        for width in self.widths:
            x = getattr(nn, self.activation)(nn.Dense(width)(x))
        return x


class GaussianHead(nn.Module):
    """Features [..., H] to a Gaussian over raw actions [..., A]; starts near mean 0."""

    options: PolicyOptions
    action_size: int

    @nn.compact
    def __call__(self, x: Array) -> Normal:
        """Returns the Gaussian of features [..., H]."""
        # Nearly zero weights: the first policy is the same everywhere, so it explores everywhere.
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        loc = nn.Dense(self.action_size, kernel_init=small, name="loc")(x)
        if self.options.std == "state":
            raw = nn.Dense(self.action_size, kernel_init=small, name="scale")(x)
        else:
            raw = self.param("scale", nn.initializers.zeros, (self.action_size,))
        # The parameter starts at 0, and the scale at `initial_std` above its least.
        inverse_softplus = math.log(math.expm1(self.options.initial_std))
        scale = jax.nn.softplus(raw + inverse_softplus) + self.options.min_std
        return Normal(loc=loc, scale=jnp.broadcast_to(scale, loc.shape))


class MlpActorCritic(nn.Module):
    """Separate policy and value towers: they share no weights."""

    options: MlpOptions
    action_size: int

    @nn.compact
    def __call__(self, observation: PyTree) -> PolicyOutput:
        """Applies both towers to observations, leaves [..., O]."""
        o = self.options
        policy = Stack(o.policy_hidden, o.activation, name="policy")(policy_features(observation))
        normal = GaussianHead(o, self.action_size, name="head")(policy)
        value = Stack(o.value_hidden, o.activation, name="value")(value_features(observation))
        # A value that kept its axis, [B, 1], would broadcast against rewards [B] to [B, B].
        return PolicyOutput(normal, nn.Dense(1, name="value_out")(value)[..., 0])


def remember(cell: nn.RNNCellBase, memory: PyTree, seen: Array, is_first: Array | None) -> tuple:
    """Moves a memory on by what is seen in one step, or in T of them, of M environments.

    Args:
      cell: of Flax, a submodule of the network.
      memory: leaves [M, H], before the first step.
      seen: [M, F]; with `is_first`, [T, M, F].
      is_first: None, or [T, M] bool, where an episode begins: the memory is cleared before.

    Returns:
      The memory after the last step, and what it says in each: [M, H] or [T, M, H].
    """
    if is_first is None:
        return cell(memory, seen)

    def step(cell: Any, memory: PyTree, row: tuple[Array, Array]) -> tuple:
        return cell(restarted(memory, row[1]), row[0])

    steps = nn.scan(step, variable_broadcast="params", split_rngs={"params": False})
    return steps(cell, memory, (seen, is_first))


class RecurrentActorCritic(nn.Module):
    """The default network, which reads beside an observation what a cell remembers of the past.

    What it sees now need not pass through the cell: a blind cart-pole had 918 after as many steps
    as gave 433 to a policy behind its cell.
    """

    options: RecurrentOptions
    action_size: int

    @nn.compact
    def __call__(self, observation: PyTree, memory: PyTree, *, is_first: PyTree = None) -> tuple:
        """Moves the memory on by one observation, or by T of them, and answers from both.

        Args:
          observation: leaves [..., O].
          memory: leaves [..., H]; an LSTM has two.
          is_first: see `remember`.

        Returns:
          The `PolicyOutput`, and the memory that follows.
        """
        o = self.options
        # Only what the policy may read: the memory is read by the policy.
        told = policy_features(observation)
        encoded = Stack(o.encoder, o.activation, name="encoder")(told)
        cell = {"gru": nn.GRUCell, "lstm": nn.OptimizedLSTMCell}[o.cell](o.hidden, name="cell")
        memory, remembered = remember(cell, memory, encoded, is_first)
        known = {"policy": jnp.concatenate([told, remembered], axis=-1)}
        rest = observation if isinstance(observation, dict) else {}
        return MlpActorCritic(o, self.action_size, name="mlp")(rest | known), memory


def from_linen(module: nn.Module, observation: PyTree, memory: PyTree = ()) -> Network:
    """Adapts a Flax module to `Network`.

    Its collection `params` is trained. All others, such as `batch_stats`, are data: they stay as
    `init` makes them, and a module that would change one is refused by Flax.

    Args:
      module: `module(observation) -> PolicyOutput`, or, with a memory,
        `module(observation, memory) -> (PolicyOutput, memory)`. Leading axes are batch axes.
      observation: an example of one observation, leaves [O], unbatched (shapes only matter).
      memory: one environment's memory at the start of an episode, leaves [H], all zeros.

    A network that draws noise of its own is made so: `from_linen(...)._replace(draw=draw)`. Its
    module takes the noise as one more argument, or none where the policy acts by its mean.

    A module with a memory whose call takes `is_first` (see `remember`) learns from all steps of a
    rollout at once; of another, the steps are taken one after another.
    """
    # A module without a memory takes one argument and returns one thing, which is what most have.
    recurrent = len(jax.tree.leaves(memory)) > 0
    sequences = recurrent and "is_first" in inspect.signature(type(module).__call__).parameters
    if any(jnp.any(x != 0) for x in jax.tree.leaves(memory)):
        raise ValueError("A memory starts an episode at zero; this one has other numbers in it.")
    arguments = (observation, memory) if recurrent else (observation,)

    def init(key: Array) -> tuple[PyTree, PyTree]:
        return module.init(key, *arguments), memory

    def apply(params: PyTree, observation: PyTree, memory: PyTree, *noise: Any, **at: Any) -> tuple:
        stay = {k: jax.lax.stop_gradient(x) for k, x in params.items() if k != "params"}
        more = (memory, *noise) if recurrent else noise
        output: Any = module.apply(params | stay, observation, *more, **at)
        return output if recurrent else (output, memory)

    vars(apply)["sequences"] = sequences
    return Network(init=init, apply=apply)


def mlp(options: MlpOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the default network.

    Args:
      options: its sizes.
      observation: an example of one observation, unbatched: [O], or a flat dict of such.
      action_size: A.
    """
    check_observation(observation)
    return from_linen(MlpActorCritic(options, action_size), observation)


def recurrent(options: RecurrentOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the GRU or LSTM network.

    Args:
      options: its sizes.
      observation: an example of one observation, unbatched: [O], or a flat dict of such.
      action_size: A.
    """
    check_observation(observation)
    module = RecurrentActorCritic(options, action_size)
    return from_linen(module, observation, no_memory(options))


def no_memory(options: RecurrentOptions) -> PyTree:
    """Returns the memory with which an episode starts, leaves [H]."""
    zeros = jnp.zeros(options.hidden)
    return zeros if options.cell == "gru" else (zeros, zeros)
