"""Rays against shapes: which one each ray of an eye enters first, and how light falls there.

What an eye cannot have in view is left out first, by its bounding sphere; of the rest, one shape
after another is held against all rays, and the nearest entry stays.

The letters: S shapes, N rays.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.records import Array
from purerl.eyes.scene import Shapes
from purerl.eyes.shapes import FIELD, KINDS

LIGHT = np.array([0.3, 0.2, 0.93], np.float32)  # where light comes from, a unit vector
BOX_GREY = 0.5  # of an episode's boxes
FIELD_KIND = list(KINDS).index(FIELD)
Boxes = tuple[Array, Array]  # centers and half sizes, [P, 3] each [m]


class Seen(NamedTuple):
    """Shapes as one eye has them before it."""

    kind: np.ndarray  # [S] index in KINDS, ascending
    eye: Array  # [3] where it is [m]
    axes: Array  # [3, 3] its axes
    turn: Array  # [S, 3, 3] from the eye's frame into the shape's own, scaled
    origin: Array  # [S, 3] of the eye, there
    light: Array  # [S, 3] where light comes from, in the shape's own frame, not scaled
    center: Array  # [S, 3] of the shape, in the eye's frame [m]
    scale: Array  # [S, 3] [m]
    length: Array  # [S]
    radius: Array  # [S] [m]
    grey: Array  # [S]
    checked: Array  # [S] bool: stands still, so it has checks
    heights: Array  # [R, C] of the height field, scaled


def before_eye(
    shapes: Shapes, xpos: Array, xmat: Array, boxes: Boxes, position: Array, axes: Array
) -> Seen:
    """Returns shapes, and an episode's boxes after them, as an eye has them before it.

    Args:
      shapes: S of them.
      xpos: of bodies [nbody, 3] [m].
      xmat: of bodies [nbody, 3, 3].
      boxes: P of them.
      position: of the eye [3] [m].
      axes: its own, [3, 3].
    """

    def both(one: Array | np.ndarray, other: Array | float) -> Array:
        shape = (len(boxes[0]), *one.shape[1:])
        return jnp.concatenate([one, jnp.broadcast_to(jnp.asarray(other, one.dtype), shape)])

    turn = xmat[shapes.body]
    place = both(xpos[shapes.body] + turned(turn, shapes.position), boxes[0])
    own = jnp.swapaxes(both(product(turn, shapes.axes), jnp.eye(3)), 1, 2)
    scale = both(shapes.scale, boxes[1])
    box = list(KINDS).index(mujoco.mjtGeom.mjGEOM_BOX)
    return Seen(
        kind=np.append(shapes.kind, np.full(len(boxes[0]), box)),
        eye=position,
        axes=axes,
        turn=product(own, axes) / scale[:, :, None],
        origin=turned(own, position - place) / scale,
        light=turned(own, LIGHT),
        center=turned(axes.T, place - position),
        scale=scale,
        length=both(shapes.length, 0.0),
        radius=both(shapes.radius, jnp.sqrt(jnp.square(boxes[1]).sum(1))),
        grey=both(shapes.grey, BOX_GREY),
        checked=both(shapes.body == 0, True),
        heights=jnp.asarray(shapes.heights) / shapes.scale[shapes.kind == FIELD_KIND, 2:],
    )


def in_view(seen: Seen, rays: np.ndarray, reach: float) -> Array:
    """Tells which shapes' bounding spheres are in the pyramid of an eye's rays, [S] bool.

    A box of no size, as of a wall that an episode does not have, is not.
    """
    ahead, radius = -seen.center[:, 2], seen.radius
    visible = (radius > 0.0) & (ahead > -radius) & (ahead - radius < reach)
    for k, half in enumerate(np.abs(rays).max(axis=1)):
        outside = jnp.abs(seen.center[:, k]) - half * ahead
        visible &= outside <= 1.0001 * radius * np.sqrt(1.0 + half * half)
    return visible


def nearest(seen: Seen, visible: Array, rays: np.ndarray, reach: float) -> tuple[Array, Array]:
    """Returns where each ray enters its first shape, [N] in lengths of the ray, and which that is.

    Args:
      seen: S shapes.
      visible: [S] bool: which to try.
      rays: [2, N].
      reach: how far anything is looked for [m]; where nothing is, more than that is returned.
    """
    found = jnp.full_like(rays[0], 2.0 * reach), jnp.zeros_like(rays[0], jnp.int32)
    for k, kind in enumerate(KINDS):
        if k in seen.kind:
            found = _nearest_of(kind, visible & (seen.kind == k), seen, rays, found)
    return found


def _nearest_of(
    kind: mujoco.mjtGeom, todo: Array, seen: Seen, rays: np.ndarray, found: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Tries the shapes of one kind that are to do, [S] bool, one after another, by number."""

    def try_one(carry: tuple) -> tuple:
        todo, t, which = carry
        i = jnp.argmax(todo).astype(jnp.int32)
        form = (seen.heights, t) if kind == FIELD else seen.length[i]
        entry = KINDS[kind].enter([*seen.origin[i]], along(seen.turn[i], rays), form)
        nearer = entry < t
        left = todo & (jnp.arange(todo.shape[0]) != i)
        return left, jnp.where(nearer, entry, t), jnp.where(nearer, i, which)

    return jax.lax.while_loop(lambda carry: carry[0].any(), try_one, (todo, *found))[1:]


def lit(t: Array, which: Array, seen: Seen, rays: np.ndarray) -> tuple[Array, Array]:
    """Returns how directly light falls where each ray enters, and the ray itself, [N] 0 to 1 each.

    Args:
      t: [N] of the entries.
      which: [N] the shapes.
      seen: S shapes.
      rays: [2, N].
    """
    scale, length, kind = seen.scale[which], seen.length[which], jnp.asarray(seen.kind)[which]
    ray = jnp.stack(along(seen.turn[which], rays), axis=1)
    normal = point = seen.origin[which] + t[:, None] * ray
    for k, one in enumerate(KINDS):
        if k in seen.kind:
            form = seen.heights if one == FIELD else length
            normal = jnp.where((kind == k)[:, None], KINDS[one].normal(point, form), normal)
    normal, ray = _unit(normal / scale), _unit(ray * scale)  # no longer scaled
    light = jnp.maximum((normal * seen.light[which]).sum(-1), 0.0)
    return light, jnp.abs((normal * ray).sum(-1))


# --- vectors: as sums, since a GPU may round what goes into a matrix product ---


def product(x: Array, y: Array | np.ndarray) -> Array:
    """Returns matrices [..., 3, 3] times [..., 3, K]."""
    first, second, third = (x[..., :, k, None] * y[..., None, k, :] for k in range(3))
    return first + second + third


def turned(turn: Array, x: Array | np.ndarray) -> Array:
    """Returns matrices [..., 3, 3] times vectors [..., 3]."""
    return product(turn, x[..., None])[..., 0]


def along(turn: Array, rays: np.ndarray) -> list[Array]:
    """Returns rays (right, up, 1 m ahead) turned by [..., 3, 3]: x, y and z, [N] each."""
    return [
        turn[..., k, 0] * rays[0] + turn[..., k, 1] * rays[1] - turn[..., k, 2] for k in range(3)
    ]


def _unit(x: Array) -> Array:
    """Returns vectors [..., 3] of length 1."""
    return x * jax.lax.rsqrt(jnp.square(x).sum(-1, keepdims=True) + 1e-20)
