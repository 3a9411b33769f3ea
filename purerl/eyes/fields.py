"""Where a ray enters a height field, and how its surface lies there.

A field is scaled to -1 to 1 along x and y and to a bottom at z = -1. Its surface is MuJoCo's: two
triangles a cell, divided by the diagonal from its least x and y to its greatest.

The letters: R, C rows along y and columns along x of heights; N rays; g [...] place on the grid.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from purerl.core.records import Array


def surface(heights: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Returns the height at x and y [...], counted in cells, and its slopes along both."""
    column, row = (
        jnp.clip(jnp.floor(g).astype(jnp.int32), 0, n - 2)
        for g, n in zip((x, y), heights.shape[::-1], strict=True)
    )
    low, high, x, y = heights[row, column], heights[row + 1, column + 1], x - column, y - row
    corner = jnp.where(x > y, heights[row, column + 1], heights[row + 1, column])
    slope_x = jnp.where(x > y, corner - low, high - corner)
    slope_y = jnp.where(x > y, high - corner, corner - low)
    return low + x * slope_x + y * slope_y, slope_x, slope_y


def enter_field(o: Sequence[Array], d: Sequence[Array], form: tuple[Array, Array]) -> Array:
    """Returns t of each ray's entry [N]; `form`: heights [R, C], and t [N] beyond which it ends.

    It goes from edge to edge of the triangles, which lie along x, along y and along diagonals:
    between two edges, a ray's height above the surface is linear.
    """
    heights, limit = form
    half = [0.5 * (n - 1) for n in heights.shape[::-1]]
    ends = (-1.0, 1.0), (-1.0, 1.0), (-1.0, heights.max())
    sides = [
        [(end - p) / jnp.where(x == 0.0, 1e-20, x) for end in both]
        for p, x, both in zip(o, d, ends, strict=True)
    ]
    begin = functools.reduce(jnp.maximum, [jnp.minimum(*both) for both in sides], 0.0)
    end = functools.reduce(jnp.minimum, [jnp.maximum(*both) for both in sides], limit)
    x, y = (h * (p + 1.0) for h, p in zip(half, o, strict=False))
    dx, dy = (h * p for h, p in zip(half, d, strict=False))
    start, speed = jnp.stack([x, y, x - y])[:, None], jnp.stack([dx, dy, dx - dy])
    speed = jnp.where(speed == 0.0, 1e-20, speed)

    def above(t: Array) -> Array:
        return o[2] + t * d[2] - surface(heights, x + t * dx, y + t * dy)[0]

    def go_on(carry: tuple) -> tuple:
        t, height, edge, _ = carry
        meets = (edge - start) / speed
        then = jnp.clip(meets.min(0), t, end)
        after, passed = above(then), meets <= then
        share = height / jnp.maximum(height - after, 1e-20)
        met = (height > 0.0) & (after <= 0.0)
        entry = jnp.where(met, t + share * (then - t), jnp.inf)
        return then, after, edge + jnp.where(passed, jnp.sign(speed), 0.0), entry

    def goes_on(carry: tuple) -> Array:
        return (carry[0] < end) & jnp.isinf(carry[3])

    def step(carry: tuple) -> tuple:
        return jax.tree.map(lambda new, old: jnp.where(goes_on(carry), new, old), go_on(carry), carry)

    way = jnp.sign(speed)
    first = way * (jnp.floor(way * (start + begin * speed)) + 1.0)
    height = above(begin)
    # Below the surface at once, it has come in at a side or the bottom, unless it begins there.
    outside = (begin > 0.0) & (begin < end) & (height <= 0.0)
    carry = begin, height, first, jnp.where(outside, begin, jnp.inf)
    return jax.lax.while_loop(lambda c: goes_on(c).any(), step, carry)[3]


def normal_of_field(p: Array, heights: Array) -> Array:
    """Returns the surface's normals at, above or below points p [..., 3], of any length."""
    x, y = (0.5 * (n - 1) for n in heights.shape[::-1])
    _, slope_x, slope_y = surface(heights, x * (p[..., 0] + 1.0), y * (p[..., 1] + 1.0))
    return jnp.stack([-x * slope_x, -y * slope_y, jnp.ones_like(slope_x)], axis=-1)
