"""Networks that see: a convolutional encoder before the networks of `purerl.networks`."""

from dataclasses import dataclass, field

import flax.linen as nn
import jax
import jax.numpy as jnp

from purerl.core.records import Array, Network, PolicyOutput, PyTree
from purerl.ppo import networks

PICTURES = "eyes"  # the observation's entry, [E, H, W]


@dataclass(frozen=True)
class Encoder:
    """Sizes of the encoder."""

    channels: tuple[int, ...] = (16, 32, 32)
    """Of each convolution."""
    kernels: tuple[int, ...] = (4, 2, 2)
    """Of each convolution: the edge of what it looks at [pixels]."""
    strides: tuple[int, ...] = (4, 2, 2)
    """Of each convolution: how many pixels it moves on; least work where it is the kernel."""
    features: int = 64
    """What it says of each eye's picture."""
    shared: bool = True
    """Whether all eyes have one encoder, or each its own."""

    def __post_init__(self) -> None:
        """Refuses layers without a stride, and strides without a layer."""
        layers = self.channels, self.kernels, self.strides
        if len({*map(len, layers)}) != 1:
            said = "channels {}, kernels {} and strides {}".format(*layers)
            raise ValueError(f"{said} are of different lengths: give one of each for a layer.")
        if min(sum(layers, (self.features,))) < 1:
            raise ValueError(f"{self} has a number below 1.")


@dataclass(frozen=True)
class MlpOptions(networks.MlpOptions):
    """Sizes of the feed-forward network that sees."""

    eyes: Encoder = field(default_factory=Encoder)


@dataclass(frozen=True)
class RecurrentOptions(networks.RecurrentOptions):
    """Sizes of the recurrent network that sees."""

    eyes: Encoder = field(default_factory=Encoder)


def windows(x: Array, kernel: int, stride: int) -> Array:
    """Returns what a convolution looks at, [N, H', W', kernel * kernel * C], of x [N, H, W, C].

    A dense layer over it is the convolution, in matrix products alone: their bits are fixed on a
    GPU, where those of convolutions are not, and on a CPU they are faster.
    """
    number, height, width, channels = x.shape
    if kernel == stride:
        rows, columns = height // kernel, width // kernel
        x = x[:, : rows * kernel, : columns * kernel]
        x = x.reshape(number, rows, kernel, columns, kernel, channels)
        return x.swapaxes(2, 3).reshape(number, rows, columns, -1)
    starts = [(i, j) for i in range(kernel) for j in range(kernel)]
    ends = height - kernel + 1, width - kernel + 1
    parts = [x[:, i : i + ends[0] : stride, j : j + ends[1] : stride] for i, j in starts]
    return jnp.concatenate(parts, axis=-1)


class Convolutions(nn.Module):
    """Pictures [..., H, W] in -1 to 1 to features [..., F]."""

    options: Encoder

    @nn.compact
    def __call__(self, pictures: Array) -> Array:
        """Returns [..., F]."""
        o, batch = self.options, pictures.shape[:-2]
        x = pictures.reshape(-1, *pictures.shape[-2:], 1)
        for width, kernel, stride in zip(o.channels, o.kernels, o.strides, strict=True):
            if kernel > min(x.shape[1:3]):
                raise ValueError(
                    f"A kernel of {kernel} looks at a picture of {x.shape[1]} x {x.shape[2]} pixels"
                    ": leave that layer out, or give smaller strides before it."
                )
            x = nn.relu(nn.Dense(width)(windows(x, kernel, stride)))
        x = nn.LayerNorm()(nn.Dense(o.features)(x.reshape(x.shape[0], -1)))
        return nn.relu(x).reshape(*batch, o.features)


class Seeing(nn.Module):
    """A network of which the policy's features are joined by what the encoder says."""

    options: Encoder
    network: nn.Module

    @nn.compact
    def __call__(
        self, observation: PyTree, *memory: PyTree, is_first: Array | None = None
    ) -> PolicyOutput | tuple:
        """Applies both to observations with pictures [..., E, H, W]; see `networks.remember`."""
        pictures = observation[PICTURES]
        number = pictures.shape[-3]
        encoders = [Convolutions(self.options) for _ in range(1 if self.options.shared else number)]
        seen = [encoders[i % len(encoders)](pictures[..., i, :, :]) for i in range(number)]
        rest = {name: x for name, x in observation.items() if name != PICTURES}
        joined = jnp.concatenate([rest["policy"], *seen], axis=-1)
        more = {} if is_first is None else {"is_first": is_first}
        return self.network(rest | {"policy": joined}, *memory, **more)


def mlp(options: MlpOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the feed-forward network that sees.

    Args:
      options: its sizes.
      observation: an example of one observation: a flat dict of arrays [O], and `eyes` [E, H, W].
      action_size: A.
    """
    _check(observation)
    inner = networks.MlpActorCritic(options, action_size, parent=None)
    return networks.from_linen(Seeing(options.eyes, inner), observation)


def recurrent(options: RecurrentOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the GRU or LSTM network that sees; arguments as of `mlp`."""
    _check(observation)
    inner = networks.RecurrentActorCritic(options, action_size, parent=None)
    memory = networks.no_memory(options)
    return networks.from_linen(Seeing(options.eyes, inner), observation, memory)


def _check(observation: PyTree) -> None:
    """Raises ValueError for an observation without pictures, or with other parts than [O]."""
    pictures = observation.get(PICTURES) if isinstance(observation, dict) else None
    if getattr(pictures, "ndim", None) != 3:
        found = jax.tree.map(lambda x: (*x.shape,), observation)
        raise ValueError(
            f"The observation is {found}; this network needs a dict with pictures [E, H, W] as its "
            f"entry {PICTURES}. Without pictures, take networks.mlp or networks.recurrent."
        )
    networks.check_observation({k: x for k, x in observation.items() if k != PICTURES})
