"""Eyes as an environment's options: how many, where they look, and what is wrong with them."""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp

from purerl import Array, eyes


@dataclasses.dataclass(frozen=True)
class Sight:
    """Settings of the eyes."""

    number: Literal[0, 1, 2] = 0
    """How many; 0: the body is told what lies ahead instead."""
    size: int = 32
    """Edge of a picture, in pixels."""
    overlap: float = 57.0
    """Of two eyes' fields of view [degrees]."""
    reach: float = 4.0
    """How far they see [m]."""
    check: float = 0.1
    """Edge of a square of the pattern on the ground [m]."""
    own_body: bool = True
    """Whether they see the body that they are on."""
    closed: Literal["none", "left", "right"] = "none"
    """Which of two eyes is closed: its picture is black."""
    dropout: float = 0.0
    """Share of episodes in which one of two eyes, drawn anew, is closed."""
    blur: float = 0.0
    """Standard deviation of the blur of photoreceptors [pixels]."""
    noise: float = 0.0
    """Standard deviation of each pixel's noise, where white is 1."""

    def __post_init__(self):
        """Refuses numbers that make no sense."""
        if not 0.0 <= self.dropout <= 1.0:
            raise ValueError(f"dropout is {self.dropout}; give a share, 0 to 1.")
        if self.number < 2 and (self.closed != "none" or self.dropout):
            raise ValueError("closed and dropout are of two eyes: set number to 2.")
        if self.blur < 0 or self.noise < 0:
            raise ValueError(f"blur is {self.blur} and noise {self.noise}; both are 0 or more.")


def build(model: Any, eye: eyes.Eye, distance: float, options: Sight, hide: tuple[str, ...]):
    """Returns the `Eyes` of a model, None for no eye.

    Args:
      model: as it should look.
      eye: in the middle.
      distance: between two eyes [m].
      options: of the eyes.
      hide: names of what is not seen.
    """
    if not options.number:
        return None
    both = eyes.pair(eye, distance, options.overlap) if options.number == 2 else (eye,)
    body = () if options.own_body else (eye.body.partition("/")[0] + "/",)
    return eyes.Eyes(
        model, both, (options.size, options.size), options.reach, (*hide, *body), options.check
    )


def draw(key: Array, options: Sight) -> dict[str, Array]:
    """Draws an episode's eyes: `open`, [E] bool, and a key for their noise."""
    drop_key, which_key, noise_key = jax.random.split(key, 3)
    closed = jnp.array([options.closed == s for s in ("left", "right")[: options.number]], bool)
    if options.dropout:
        dropped = jax.random.uniform(drop_key) < options.dropout
        closed |= dropped & (jnp.arange(2) == jax.random.randint(which_key, (), 0, 2))
    return {"open": ~closed} | ({"noise_key": noise_key} if options.noise else {})


def look(
    seer: eyes.Eyes,
    readings: Any,
    drawn: dict[str, Array],
    time: Array,
    options: Sight,
    **scene: Any,
) -> Array:
    """Returns what the eyes bring on now, [E, H, W] uint8: see `spoil`.

    `readings` have `xpos` and `xmat`; `scene` is what of this episode `Eyes.see` takes.
    """
    return spoil(seer.see(readings.xpos, readings.xmat, **scene), drawn, time, options)


def spoil(pictures: Array, drawn: dict[str, Array], time: Array, options: Sight) -> Array:
    """Returns pictures [E, H, W] uint8 as these eyes bring them on: blurred, noisy, or black.

    Args:
      pictures: sharp ones.
      drawn: of `draw`.
      time: [] of the episode [s], by which noise differs from step to step.
      options: of the eyes.
    """
    seen = pictures
    if options.blur or options.noise:
        seen = blurred(pictures.astype(jnp.float32), options.blur)
        if options.noise:
            bits = jax.lax.bitcast_convert_type(time, jnp.uint32)
            noise = jax.random.normal(jax.random.fold_in(drawn["noise_key"], bits), seen.shape)
            seen += 255.0 * options.noise * noise
        seen = jnp.round(jnp.clip(seen, 0.0, 255.0)).astype(jnp.uint8)
    return jnp.where(drawn["open"][:, None, None], seen, jnp.uint8(0))


def blurred(pictures: Array, sigma: float) -> Array:
    """Returns pictures [E, H, W] after a Gaussian of `sigma` [pixels], edges carried on."""
    if not sigma:
        return pictures
    radius = max(1, round(3 * sigma))
    weights = jnp.exp(-0.5 * jnp.square(jnp.arange(-radius, radius + 1) / sigma))
    weights /= weights.sum()
    for axis in (1, 2):
        size = pictures.shape[axis]
        pad = [(radius, radius) if a == axis else (0, 0) for a in range(3)]
        wide = jnp.pad(pictures, pad, mode="edge")
        parts = [jax.lax.slice_in_dim(wide, k, k + size, axis=axis) for k in range(2 * radius + 1)]
        pictures = sum((w * x for w, x in zip(weights, parts, strict=True)), 0.0 * pictures)
    return pictures
