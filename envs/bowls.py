"""A bowl of bumps that is drawn anew in every episode, and the planes that stand for its ground.

An episode's bumps are a grid [B, B] of spline coefficients, from which every height follows. MJX
has one height field for all environments, so physics has none: each geom that can touch the ground
has a plane of its own, which only it meets, and which lies as the ground lies beneath it.

The letters: G edges of cells along x and along y, K points.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control import mjcf
from scipy import ndimage

from purerl import Array

TERRAIN = "terrain"  # the height field and its geom


@dataclasses.dataclass(frozen=True)
class Bowl:
    """Sizes of dm_control's bowl; around it and where it is lower, the ground is at z = 0."""

    half: float = 6.0  # of its edge [m]
    height: float = 0.5  # of the highest bump there can be [m]
    depth: float = 0.01  # of its lowest point below z = 0 [m]
    edges: int = 201  # G
    bump: float = 0.2  # from one to the next [m]
    least: float = 0.5  # of a bump, where the highest is 1

    @property
    def bumps(self) -> int:
        """B."""
        return int(2 * self.half / self.bump)

    @property
    def cell(self) -> float:
        """Edge of a cell [m]."""
        return 2 * self.half / (self.edges - 1)


class Tables(NamedTuple):
    """What heights are made with: the shape, times the spline's bumps along both axes."""

    filter: np.ndarray  # [B, B] bumps -> coefficients, along one axis
    spline: np.ndarray  # [G, B] coefficients -> heights, along one axis; four in a row are not 0
    first: np.ndarray  # [G] which is the first of the four
    shape: np.ndarray  # [G, G] of the bowl, rows along y [m]


@functools.cache
def tables(bowl: Bowl) -> Tables:
    """Returns the linear maps of `scipy.ndimage.zoom`, which dm_control smooths bumps with."""
    number, edges = bowl.bumps, bowl.edges
    filter_ = ndimage.spline_filter1d(np.eye(number), axis=0, output=float)
    spline = ndimage.zoom(np.eye(number), (edges / number, 1)) @ np.linalg.inv(filter_)
    middle = np.arange(edges) * (number - 1) / (edges - 1)
    first = np.clip(np.floor(middle).astype(int) - 1, 0, number - 4)
    y, x = np.ogrid[-1 : 1 : edges * 1j, -1 : 1 : edges * 1j]
    radius = np.clip(np.sqrt(x * x + y * y), 0.1, 1)
    return Tables(filter_, spline, first, bowl.height * (0.5 - np.cos(2 * np.pi * radius) / 2))


def draw_bumps(key: Array, bowl: Bowl) -> Array:
    """Draws an episode's bumps: [B, B], uniform."""
    return jax.random.uniform(key, (bowl.bumps, bowl.bumps), minval=bowl.least)


def coefficients(bowl: Bowl, bumps: Array) -> Array:
    """Returns bumps [B, B] as the coefficients of a cubic spline [B, B]."""
    return _both_ways(tables(bowl).filter, bumps)


def heights(bowl: Bowl, terrain: Array) -> Array:
    """Returns all heights of the terrain above its lowest point, [G, G], rows along y [m].

    `terrain` is its coefficients [B, B].
    """
    return jnp.float32(tables(bowl).shape) * _both_ways(tables(bowl).spline, terrain)


def _both_ways(matrix: np.ndarray, x: Array) -> Array:
    """Applies a matrix along both axes of x; a GPU would round what goes into it."""
    exact, own = jax.lax.Precision.HIGHEST, jnp.float32(matrix)
    return jnp.matmul(jnp.matmul(own, x, precision=exact), own.T, precision=exact)


def ground(bowl: Bowl, terrain: Array, place: Array) -> tuple[Array, Array]:
    """Returns how high the ground is at places, [K] [m], and its normals there, [K, 3].

    Of MuJoCo's triangles of a height field, or of the plane z = 0 where that is higher.

    Args:
      bowl: its sizes.
      terrain: coefficients [B, B].
      place: x and y [K, 2] [m].
    """
    where = (place + bowl.half) / bowl.cell
    corner = jnp.clip(jnp.floor(where).astype(jnp.int32), 0, bowl.edges - 2)
    inner, near = where - corner, _corners(bowl, terrain, corner)
    # Each cell's diagonal goes from its least x and y to its greatest.
    below = inner[:, 0] > inner[:, 1]
    along_x = jnp.where(below, near[:, 0, 1] - near[:, 0, 0], near[:, 1, 1] - near[:, 1, 0])
    along_y = jnp.where(below, near[:, 1, 1] - near[:, 0, 1], near[:, 1, 0] - near[:, 0, 0])
    height = near[:, 0, 0] + inner[:, 0] * along_x + inner[:, 1] * along_y
    over = (height > 0.0) & (jnp.abs(place) <= bowl.half).all(1)
    normal = jnp.stack([-along_x, -along_y, jnp.full_like(height, bowl.cell)], axis=1)
    normal = jnp.where(over[:, None], normal, jnp.array([0.0, 0.0, 1.0]))
    return jnp.where(over, height, 0.0), normal / jnp.linalg.norm(normal, axis=1, keepdims=True)


def _corners(bowl: Bowl, terrain: Array, corner: Array) -> Array:
    """Returns the heights of cells' corners, [K, 2, 2], rows along y [m]; `corner` [K, 2] ints."""
    made = tables(bowl)
    four = made.first[:, None] + np.arange(4)
    weights = jnp.float32(np.take_along_axis(made.spline, four, axis=1))
    x, y = (corner[:, k, None] + jnp.arange(2) for k in (0, 1))
    window = terrain[jnp.array(four)[y][:, :, None, :, None], jnp.array(four)[x][:, None, :, None]]
    smooth = (window * weights[y][:, :, None, :, None] * weights[x][:, None, :, None]).sum((3, 4))
    return smooth * jnp.float32(made.shape)[y[:, :, None], x[:, None]] - bowl.depth


def planes(bowl: Bowl, terrain: Array, place: Array) -> tuple[Array, Array]:
    """Returns the ground beneath places [K, 2] as planes: points [K, 3] [m], quaternions [K, 4]."""
    height, normal = ground(bowl, terrain, place)
    x, y, z = normal.T
    turn = jnp.stack([1.0 + z, -y, x, jnp.zeros_like(z)], axis=1)  # that takes the z-axis there
    turn /= jnp.linalg.norm(turn, axis=1, keepdims=True)
    return jnp.concatenate([place, height[:, None]], axis=1), turn


def columns(bowl: Bowl, terrain: Array, place: Array) -> tuple[Array, Array]:
    """Returns the terrain as boxes to be drawn: centers and half sizes, [P, 3] each [m].

    Fine ones around `place` [2], where the body is, and coarse and low ones everywhere.
    """
    fine, coarse = bowl.cell / 2, 5 * bowl.cell
    near = jnp.round(place / fine) * fine + _grid(15, fine)
    far = _grid(round(bowl.half / coarse), coarse)
    high = heights(bowl, terrain) - bowl.depth
    low = jax.lax.reduce_window(high, jnp.inf, jnp.minimum, (6, 6), (5, 5), "valid")
    top = jnp.concatenate([ground(bowl, terrain, near)[0], jnp.maximum(low.ravel(), 0.0)])
    half = jnp.concatenate([jnp.full(len(near), fine / 2), jnp.full(len(far), coarse / 2)])
    bottom = -bowl.depth
    center = jnp.concatenate([jnp.concatenate([near, far]), (top + bottom)[:, None] / 2], axis=1)
    return center, jnp.stack([half, half, (top - bottom) / 2], axis=1)


def _grid(number: int, step: float) -> np.ndarray:
    """Returns the middles of 2 * number by 2 * number squares around the origin, [P, 2]."""
    along = (np.arange(-number, number) + 0.5) * step
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


# --- what MuJoCo gets of it ---


def add_terrain(root: mjcf.RootElement, bowl: Bowl) -> None:
    """Adds a height field for eyes to a floor, flat until an episode says what heights it has."""
    size = (bowl.half, bowl.half, bowl.height, 0.1)
    root.asset.add("hfield", name=TERRAIN, nrow=bowl.edges, ncol=bowl.edges, size=size)
    looks = {"pos": [0, 0, -bowl.depth], "rgba": [0.4, 0.45, 0.5, 1]}
    root.worldbody.add("geom", name=TERRAIN, type="hfield", hfield=TERRAIN, **looks)


def with_planes(root: mjcf.RootElement, name: str, touching: Sequence[str]) -> mujoco.MjModel:
    """Compiles a bowl with planes in the terrain's place, called `name`_0, ..., one for each geom.

    A geom alone meets its own, which is clear, and lies anywhere until an environment says where
    the ground beneath that geom is. `touching`: names of the geoms.
    """
    root.find("geom", TERRAIN).remove()
    root.find("hfield", TERRAIN).remove()
    for number, geom in enumerate(touching):
        flat = {"type": "plane", "size": [1, 1, 1], "rgba": [0, 0, 0, 0]}
        plane = root.worldbody.add("geom", name=f"{name}_{number}", **flat)
        root.contact.add("pair", geom1=plane, geom2=root.find("geom", geom))
    model = mjcf.Physics.from_mjcf_model(root).model.ptr
    mix_pairs(model)
    return model


def mix_pairs(model: mujoco.MjModel) -> None:
    """Gives each pair what a contact of its geoms has without it: the compiler leaves defaults."""
    sides = np.stack([model.pair_geom1, model.pair_geom2])
    priority = model.geom_priority[sides]
    counts = priority == priority.max(0)  # the geom of the higher priority alone, else both
    share = counts * model.geom_solmix[sides]
    share = (share / share.sum(0))[..., None]
    friction = (counts[..., None] * model.geom_friction[sides]).max(0)
    model.pair_dim[:] = (counts * model.geom_condim[sides]).max(0)
    model.pair_friction[:] = friction[:, [0, 0, 1, 2, 2]]
    model.pair_solref[:] = (share * model.geom_solref[sides]).sum(0)
    model.pair_solimp[:] = (share * model.geom_solimp[sides]).sum(0)
