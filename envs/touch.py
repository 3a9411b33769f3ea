"""What a walker touches that physics does not know: balls that hinder nothing."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import Array, eyes


def touched(
    model: mujoco.MjModel, geoms: Sequence[int], readings: Any, balls: Array, radius: float
) -> Array:
    """Tells which balls are touched, [M] bool.

    Args:
      model: as it was compiled.
      geoms: ids of ellipsoids or of capsules, G of them: what touches.
      readings: with `xpos` and `xmat`.
      balls: their middles [M, 3] [m].
      radius: of each [m].
    """
    ids = np.array(geoms)
    body = model.geom_bodyid[ids]
    turn = np.stack([eyes.rotation(quat) for quat in model.geom_quat[ids]])
    inner = balls[:, None] - readings.xpos[body]  # [M, G, 3]
    inner = (inner[..., None] * readings.xmat[body]).sum(-2) - model.geom_pos[ids]
    own = (inner[..., None] * turn).sum(-2)
    (kind,) = {int(x) for x in model.geom_type[ids]}
    away = jax.vmap(jax.vmap(DISTANCES[kind]), (0, None))(own, model.geom_size[ids])
    return (away < radius).any(1)


def distance_to_ellipsoid(point: Array, radii: Any) -> Array:
    """Returns the distance of a point [3] from an ellipsoid's surface, [], 0 inside [m].

    The nearest point is x r^2 / (r^2 + t), with the t for which it is on the surface: by bisection
    (D. Eberly, "Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid", 2013).
    """
    square = jnp.square(jnp.asarray(radii, jnp.float32))

    def outside(t: Array) -> Array:
        return (square * jnp.square(point / (square + t))).sum() > 1.0

    def halve(_, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        far = outside(middle)
        return jnp.where(far, middle, low), jnp.where(far, high, middle)

    most = jnp.sqrt(jnp.square(point).sum()) * jnp.sqrt(square.max())
    low, _ = jax.lax.fori_loop(0, 40, halve, (jnp.zeros(()), most))
    nearest = point * square / (square + low)
    return jnp.where(outside(jnp.zeros(())), jnp.sqrt(jnp.square(point - nearest).sum()), 0.0)


def distance_to_capsule(point: Array, size: Any) -> Array:
    """Returns the distance of a point [3] from a capsule along z, [], 0 inside [m].

    Args:
      point: in its frame.
      size: its radius, and half the length between the middles of its ends.
    """
    axis = jnp.clip(point[2], -size[1], size[1])
    return jnp.maximum(jnp.sqrt(jnp.square(point.at[2].add(-axis)).sum()) - size[0], 0.0)


_GEOM = mujoco.mjtGeom
DISTANCES = {
    int(_GEOM.mjGEOM_ELLIPSOID): distance_to_ellipsoid,
    int(_GEOM.mjGEOM_CAPSULE): distance_to_capsule,
}
