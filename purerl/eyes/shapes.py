"""Where a ray enters a shape, and how the surface lies there.

Every shape is scaled to a unit one in its own frame, so that few numbers describe it. A ray is
`origin + t * direction`; `t` is infinite where it misses, or begins inside. Only entries count, as
in MuJoCo's renderer, which draws no surface from behind: an eye inside a skull looks through it.

The letters: o [3] the origin, d three arrays [...] the directions, in the scaled frame.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.records import Array

_GEOM = mujoco.mjtGeom
FIELD = _GEOM.mjGEOM_HFIELD
Vector = Sequence[Array]  # x, y and z
UP = np.array([0.0, 0.0, 1.0], np.float32)
ENDLESS = 1e10  # half of what a plane of size 0 has [m]


class Kind(NamedTuple):
    """A kind of shape."""

    scale: Callable[[np.ndarray], np.ndarray]  # geom_size [3] -> [3] to divide by [m]
    enter: Callable[[Vector, Vector, Any], Array]  # o, d, length [] -> t [...]
    normal: Callable[[Array, Any], Array]  # point [..., 3], length [...] -> [..., 3], any length


def _dot(x: Vector, y: Vector) -> Array:
    return sum((p * q for p, q in zip(x[1:], y[1:], strict=True)), x[0] * y[0])


def _round(o: Vector, d: Vector) -> tuple[Array, Array]:
    """Returns t of the entry into what is round in the coordinates given, and whether it is one.

    From the point nearest to the middle: b^2 - a c would cancel for a toe seen from afar.
    """
    inverse = 1.0 / jnp.maximum(_dot(d, d), 1e-20)
    nearest = -_dot(o, d) * inverse
    off = [p + nearest * x for p, x in zip(o, d, strict=True)]
    inside = 1.0 - _dot(off, off)
    return nearest - jnp.sqrt(jnp.maximum(inside, 0.0) * inverse), inside > 0.0


def _ahead(t: Array, hit: Array) -> Array:
    return jnp.where(hit & (t > 0.0), t, jnp.inf)


def _enter_ball(o: Vector, d: Vector, length: Array) -> Array:
    return _ahead(*_round(o, d))


def _enter_capsule(o: Vector, d: Vector, length: Array) -> Array:
    t, hit = _round(o[:2], d[:2])
    z = o[2] + t * d[2]
    at_end, hit_end = _round([o[0], o[1], o[2] - jnp.where(z > 0.0, length, -length)], d)
    side = jnp.abs(z) <= length
    return _ahead(jnp.where(side, t, at_end), hit & (side | hit_end))


def _enter_cylinder(o: Vector, d: Vector, length: Array) -> Array:
    t = (jnp.sign(o[2]) * length - o[2]) / d[2]  # the lid on this side
    x, y = o[0] + t * d[0], o[1] + t * d[1]
    lid = _ahead(t, (jnp.abs(o[2]) > length) & (x * x + y * y <= 1.0))
    t, hit = _round(o[:2], d[:2])
    side = hit & (jnp.abs(o[2] + t * d[2]) <= length)
    return jnp.minimum(_ahead(t, side), lid)


def _slabs(o: Vector, d: Vector, top: Array | float) -> tuple[Array, Array]:
    """Returns t where rays come into a box, -1 to 1 but to `top` along z, and where they leave."""
    inverse = [1.0 / x for x in d]
    low = [(-1.0 - p) * i for p, i in zip(o, inverse, strict=True)]
    high = [(end - p) * i for end, p, i in zip((1.0, 1.0, top), o, inverse, strict=True)]
    enters = functools.reduce(jnp.maximum, map(jnp.minimum, low, high))
    return enters, functools.reduce(jnp.minimum, map(jnp.maximum, low, high))


def _enter_box(o: Vector, d: Vector, length: Array) -> Array:
    enters, leaves = _slabs(o, d, 1.0)
    return _ahead(enters, enters <= leaves)


def _enter_plane(o: Vector, d: Vector, length: Array) -> Array:
    t = -o[2] / d[2]
    within = [jnp.abs(p + t * x) <= 1.0 for p, x in zip(o[:2], d[:2], strict=True)]
    return _ahead(t, (o[2] > 0.0) & (d[2] < 0.0) & within[0] & within[1])


def _surface(heights: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Returns a field's height at x and y [...], counted in cells, and its slopes along both."""
    last_row, last_column = (n - 2 for n in heights.shape)
    column = jnp.clip(jnp.floor(x), 0, last_column).astype(jnp.int32)
    row = jnp.clip(jnp.floor(y), 0, last_row).astype(jnp.int32)
    low, high, x, y = heights[row, column], heights[row + 1, column + 1], x - column, y - row
    # Two triangles a cell, on both sides of the diagonal from its least x and y to its greatest.
    corner = jnp.where(x > y, heights[row, column + 1], heights[row + 1, column])
    slope_x = jnp.where(x > y, corner - low, high - corner)
    slope_y = jnp.where(x > y, high - corner, corner - low)
    return low + x * slope_x + y * slope_y, slope_x, slope_y


def _enter_field(o: Vector, d: Vector, form: tuple[Array, Array]) -> Array:
    """Goes from edge to edge of triangles: between two, a ray's height above them is linear.

    Edges are where x, y (in cells) or their difference is whole. `form`: heights [R, C] of a field
    that reaches down to z = -1, and t [...] beyond which nothing is looked for.
    """
    heights, limit = form
    begin, end = _slabs(o, d, heights.max())
    begin = jnp.maximum(begin, 0.0)
    end = jnp.maximum(begin, jnp.minimum(end, limit))
    half_x, half_y = (0.5 * (n - 1) for n in heights.shape[::-1])
    x, y, dx, dy = half_x * (o[0] + 1.0), half_y * (o[1] + 1.0), half_x * d[0], half_y * d[1]
    start, speed = jnp.stack([x, y, x - y])[:, None], jnp.stack([dx, dy, dx - dy])
    speed = jnp.where(speed == 0.0, 1e-20, speed)
    way = jnp.sign(speed)

    def above(t: Array) -> Array:
        return o[2] + t * d[2] - _surface(heights, x + t * dx, y + t * dy)[0]

    def go_on(carry: tuple) -> tuple:
        t, height, edge, found = carry
        meets = (edge - start) / speed
        then = jnp.clip(meets.min(0), t, end)
        after = above(then)
        entry = t + (then - t) * height / (height - after)
        found = jnp.minimum(found, jnp.where((height > 0.0) & (after <= 0.0), entry, jnp.inf))
        return then, after, edge + jnp.where(meets <= then, way, 0.0), found

    edge, height = way * (jnp.floor(way * (start + begin * speed)) + 1.0), above(begin)
    # Below the surface at once, a ray has come in at a side or the bottom, unless it begins there.
    found = jnp.where((begin > 0.0) & (begin < end) & (height <= 0.0), begin, jnp.inf)
    carry = begin, height, edge, found
    return jax.lax.while_loop(lambda c: ((c[0] < end) & jnp.isinf(c[3])).any(), go_on, carry)[3]


def _normal_of_capsule(p: Array, length: Array) -> Array:
    return p - UP * jnp.clip(p, -length[..., None], length[..., None])


def _normal_of_cylinder(p: Array, length: Array) -> Array:
    on_lid = jnp.abs(p[..., 2]) > length * (1.0 - 1e-4)
    return jnp.where(on_lid[..., None], jnp.sign(p) * UP, p * (1.0 - UP))


def _normal_of_box(p: Array, length: Array) -> Array:
    size = jnp.abs(p)
    return jnp.where(size == size.max(-1, keepdims=True), p, 0.0)


def _normal_of_field(p: Array, heights: Array) -> Array:
    x, y = (0.5 * (n - 1) for n in heights.shape[::-1])
    _, slope_x, slope_y = _surface(heights, x * (p[..., 0] + 1.0), y * (p[..., 1] + 1.0))
    return jnp.stack([-x * slope_x, -y * slope_y, jnp.ones_like(slope_x)], axis=-1)


# In this order shapes stand in a scene. Boxes are last: those of an episode follow the model's.
KINDS = {
    _GEOM.mjGEOM_PLANE: Kind(
        lambda s: np.array([s[0] or ENDLESS, s[1] or ENDLESS, 1.0]),
        _enter_plane,
        lambda p, _: jnp.broadcast_to(UP, p.shape),
    ),
    FIELD: Kind(lambda s: s, _enter_field, _normal_of_field),  # heights in place of a length
    _GEOM.mjGEOM_SPHERE: Kind(lambda s: s[[0, 0, 0]], _enter_ball, lambda p, _: p),
    _GEOM.mjGEOM_ELLIPSOID: Kind(lambda s: s, _enter_ball, lambda p, _: p),
    _GEOM.mjGEOM_CAPSULE: Kind(lambda s: s[[0, 0, 0]], _enter_capsule, _normal_of_capsule),
    _GEOM.mjGEOM_CYLINDER: Kind(lambda s: s[[0, 0, 0]], _enter_cylinder, _normal_of_cylinder),
    _GEOM.mjGEOM_BOX: Kind(lambda s: s, _enter_box, _normal_of_box),
}
