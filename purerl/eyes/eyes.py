"""Eyes: distances and grey pictures, from where a model's bodies are.

The letters: E eyes, N = H * W rays of one.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import purerl.eyes.casting as casting  # by its name: the room imports this module
from purerl.core.records import Array
from purerl.eyes.eye import Eye, rays
from purerl.eyes.scene import shapes_of
from purerl.physics import lookup

LARGEST = 4096  # edge of a picture [pixels]: its rays take a gigabyte while they are made
Boxes = casting.Boxes | None
Heights = Array | None
SHADE = 0.4  # of the light, what a surface turned away from it still has
CONTRAST = 0.4  # of the checks on what stands still, which have 1 +- this of the surface's grey
SKY, ABYSS = 0.9, 0.0  # grey of a ray that meets nothing, upwards and downwards


class Eyes:
    """Eyes of a model's bodies; `see` and `distance` are pure functions of one simulation."""

    def __init__(
        self,
        model: mujoco.MjModel,
        eyes: Sequence[Eye],
        size: tuple[int, int] = (32, 32),
        reach: float = 4.0,
        hide: Sequence[str] = (),
        check: float = 0.1,
    ):
        """Takes what is seen from a model.

        Args:
          model: the body and what stands around it, as it should look: an engine's may be simpler.
          eyes: of one fovy.
          size: (H, W) of a picture, in pixels.
          reach: how far they see [m].
          hide: names of geoms not seen, or of bodies not seen with all that hangs on them.
          check: edge of a square of the pattern on what stands still [m].

        Raises:
          ValueError: an unknown body or geom, a geom of a kind that rays cannot meet, two fovy.
        """
        if len({eye.fovy for eye in eyes}) != 1:
            said = f"The eyes have fovy {[eye.fovy for eye in eyes]}"
            raise ValueError(f"{said}: give at least one eye, and all of them the same.")
        if np.shape(size) != (2,) or not {*size} <= {*range(1, LARGEST + 1)}:
            raise ValueError(f"size is {size}; give (H, W), whole numbers from 1 to {LARGEST}.")
        if not (reach > 0 and check > 0):
            raise ValueError(f"reach is {reach} and check {check}; both are above 0.")
        self.size, self.reach, self.check = size, reach, check
        self.body = np.array([lookup.find(model, "body", eye.body) for eye in eyes])
        self.position = np.array([eye.position for eye in eyes], np.float32)
        self.axes = np.array([eye.axes for eye in eyes], np.float32)
        self.rays = rays(eyes[0].fovy, size)
        self.stretch = np.sqrt(1.0 + np.square(self.rays).sum(0))  # a ray's length, 1 m ahead
        self.shapes = shapes_of(model, hide)

    def see(self, xpos: Array, xmat: Array, boxes: Boxes = None, heights: Heights = None) -> Array:
        """Returns grey pictures, [E, H, W] uint8, upper row first.

        Args:
          xpos: a reading, of the model's bodies [nbody, 3], in metres.
          xmat: a reading, their axes [nbody, 3, 3].
          boxes: what stands around in this episode: centers and half sizes [P, 3], in metres.
          heights: in this episode, of the model's height field, above its geom, rows along y
            [nrow, ncol], in metres; None: the model's own.

        Raises:
          ValueError: there is nothing to see, or no field of such heights.
        """
        return self._each(self._picture, xpos, xmat, boxes, heights)

    def distance(
        self, xpos: Array, xmat: Array, boxes: Boxes = None, heights: Heights = None
    ) -> Array:
        """Returns how far what is seen is along each ray [m], [E, H, W]; inf: nothing there."""
        return self._each(lambda t, *_: t * self.stretch, xpos, xmat, boxes, heights)

    def _each(
        self, answer: Callable[..., Array], xpos: Array, xmat: Array, boxes: Boxes, heights: Heights
    ) -> Array:
        """Returns what `answer` makes of each eye's entries, [E, H, W]."""
        boxes = boxes or (jnp.zeros((0, 3)), jnp.zeros((0, 3)))
        shapes = self.shapes if heights is None else self.shapes._replace(heights=heights)
        if shapes.heights.shape != self.shapes.heights.shape:
            raise ValueError(
                f"heights are {shapes.heights.shape}, those of the model's height field "
                f"{self.shapes.heights.shape}: give [nrow, ncol] of a field that is seen."
            )
        if not len(self.shapes.kind) + len(boxes[0]):
            raise ValueError("There is nothing to see: every geom is hidden, and no box is given.")
        turn = xmat[self.body]

        def one(position: Array, axes: Array) -> Array:
            seen = casting.before_eye(shapes, xpos, xmat, boxes, position, axes)
            visible = casting.in_view(seen, self.rays, self.reach)
            t, which = casting.nearest(seen, visible, self.rays, self.reach)
            t = jnp.where(t * self.stretch <= self.reach, t, jnp.inf)
            return answer(t, which, seen).reshape(self.size)

        position = xpos[self.body] + casting.turned(turn, self.position)
        return jax.vmap(one)(position, casting.product(turn, self.axes))

    def _picture(self, t: Array, which: Array, seen: casting.Seen) -> Array:
        """Returns the grey of each pixel, [N] uint8."""
        there = jnp.isfinite(t)
        t = jnp.where(there, t, 0.0)
        light, facing = casting.lit(t, which, seen, self.rays)
        ray = jnp.stack(casting.along(seen.axes, self.rays))
        # Checks are of a place a little behind the surface. On a floor, z is 0 or 1e-7 below.
        place = seen.eye[:, None] + (t + 0.1 * self.check) * ray
        odd = jnp.floor(place / self.check).sum(0) % 2.0
        # Checks smaller than two pixels fade into their mean, or they would be noise.
        pixel = 2.0 * np.abs(self.rays[1]).max() / self.size[0] * t
        fade = jnp.clip((self.check * facing / pixel - 0.5) / 1.5, 0.0, 1.0)
        checks = jnp.where(seen.checked[which], CONTRAST * fade * (2.0 * odd - 1.0), 0.0)
        grey = seen.grey[which] * (SHADE + (1.0 - SHADE) * light) * (1.0 + checks)
        grey = jnp.where(there, grey, jnp.where(ray[2] > 0.0, SKY, ABYSS))
        return jnp.round(255.0 * jnp.clip(grey, 0.0, 1.0)).astype(jnp.uint8)
