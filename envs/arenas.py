"""The arenas: an endless floor, and a corridor of platforms that differs in every episode.

A maze's and a bowl's sizes, and what is drawn of them, are in `mazes.py` and `bowls.py`.

The corridor's model holds only a few boxes, the window. Before each control step they become the
platforms that the body can reach from where it is: `course_changes` is a pure function of the
episode's course and the torso's position, applied as per-environment model fields. That is the
same physics as a model with all platforms, at a cost that does not grow with the corridor
(MJX computes every candidate contact, near or far).
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from dm_control import mjcf
from dm_control.locomotion.arenas import corridors, floors

from purerl import Array
from purerl.envs.bodies import Body
from purerl.envs.bowls import Bowl, add_terrain
from purerl.envs.mazes import Maze

GROUND = "ground"  # the floor's geom; a corridor's boxes are ground_0, ground_1, ...
TARGET = "target"  # body and geom of the floor's orb
TREAT = 0.05  # radius of a maze's targets [m]
_THICKNESS = 0.16  # half height of a platform, as in dm_control [m]


@dataclasses.dataclass(frozen=True)
class Floor:
    """A flat floor without end."""

    tile: float = 1.0  # edge of one square of the checker pattern [m]
    orb: float = 0.0  # radius of a ball that can be anywhere and hinders nothing; 0: none [m]


@dataclasses.dataclass(frozen=True)
class GapsCorridor:
    """A straight corridor along +x of platforms with gaps between them.

    A course is an array [P, 2] of the platforms' start and end [m], drawn once an episode.
    """

    platform_length: tuple[float, float] = (0.4, 0.8)  # least and greatest [m]
    gap_length: tuple[float, float] = (0.05, 0.2)  # least and greatest [m]
    length: float = 40.0  # from x = 0 [m]
    start_length: float = 6.0  # of the first platform, which begins at x = 0 [m]
    spawn_x: float = 5.0  # where the body starts, on the first platform [m]
    width: float = 2.0  # [m]
    boxes: int = 3  # size of the window; `boxes_in_reach` says how many a body needs

    def __post_init__(self):
        """Refuses ranges that make no corridor."""
        _check_range("platform_length", self.platform_length)
        _check_range("gap_length", self.gap_length)
        if not 0 < self.spawn_x < self.start_length < self.length:
            raise ValueError(
                f"spawn_x {self.spawn_x}, start_length {self.start_length}, length {self.length}: "
                "a corridor needs 0 < spawn_x < start_length < length [m]."
            )
        if self.boxes < 2:
            raise ValueError(f"boxes is {self.boxes}: a body over a gap needs at least 2.")

    @property
    def platforms(self) -> int:
        """P: enough to reach the end of the corridor in every draw, and two to be seen beyond."""
        shortest = self.platform_length[0] + self.gap_length[0]
        return 3 + math.ceil((self.length - self.start_length) / shortest)

    @property
    def longest_platform(self) -> float:
        """[m]."""
        return max(self.start_length, self.platform_length[1])

    @property
    def single_gap(self) -> bool:
        """Whether the platform behind the first gap is as long as the whole corridor."""
        return self.platform_length[0] >= self.length


Arena = Floor | GapsCorridor | Maze | Bowl


def check_passable(arena: Arena, body: Body) -> None:
    """Raises if a gap can be wider than the body can cross, or a window miss what it touches.

    A single gap may be: whether the body crosses it is what is asked.
    """
    if not isinstance(arena, GapsCorridor):
        return
    if arena.gap_length[1] > body.longest_gap and not arena.single_gap:
        raise ValueError(
            f"gap_length goes up to {arena.gap_length[1]} m, but the {body.name} is about "
            f"{body.longest_gap} m long and cannot cross a wider gap: lower gap_length."
        )
    needed = boxes_in_reach(arena, body.reach)
    if arena.boxes < needed:
        raise ValueError(
            f"boxes is {arena.boxes}, but the {body.name} can touch {needed} platforms at once: "
            f"set boxes={needed}, or lengthen platform_length."
        )


def boxes_in_reach(arena: GapsCorridor, reach: float) -> int:
    """How many platforms can lie, in part, within `reach` [m] on both sides of a point.

    k platforms do if k - 2 of them and k - 1 gaps, all of the least length, fit within 2 reach.
    """
    gap, platform = arena.gap_length[0], arena.platform_length[0]
    return 2 + max(0, math.floor((2 * reach - gap) / (platform + gap)))


def build_arena(arena: Arena) -> mjcf.RootElement:
    """Returns dm_control's arena with our ground in it."""
    if isinstance(arena, Floor):
        return _build_floor(arena)
    if isinstance(arena, Bowl):
        root = _build_floor(Floor())
        add_terrain(root, arena)
        return root
    if isinstance(arena, Maze):
        return _build_maze(arena)
    root = corridors.EmptyCorridor(name="arena", visible_side_planes=False).mjcf_model
    _remove_walls(root)
    material = _checker(root, tile=0.5)
    half = [arena.longest_platform / 2, arena.width / 2, _THICKNESS]
    for i in range(arena.boxes):
        # Compiled at the size of the longest: the bounding sphere stays, and has to hold them all.
        body = root.worldbody.add("body", name=f"{GROUND}_{i}")
        body.add("geom", name=f"{GROUND}_{i}", type="box", size=half, mass=0, material=material)
    return root


def _build_floor(arena: Floor) -> mjcf.RootElement:
    """dm_control's floor; a plane is endless whatever size it is drawn at."""
    dm_floor = floors.Floor(name="arena", size=(100, 100), reflectance=0.0)
    dm_floor.ground_geoms[0].name = GROUND
    dm_floor.ground_geoms[0].material.texrepeat = [2 / arena.tile] * 2
    root = dm_floor.mjcf_model
    if arena.orb:
        _add_target(root, TARGET, arena.orb)
    return root


def _build_maze(arena: Maze) -> mjcf.RootElement:
    """A floor, a window of walls, and the treats."""
    root = _build_floor(Floor())
    half = [arena.cell / 2, arena.cell / 2, arena.height / 2]
    for i in range(arena.boxes):
        body = root.worldbody.add("body", name=f"{GROUND}_{i}")
        body.add("geom", name=f"{GROUND}_{i}", type="box", size=half, mass=0)
    for i in range(arena.targets):
        _add_target(root, f"{TARGET}_{i}", TREAT)
    return root


def _add_target(root: mjcf.RootElement, name: str, radius: float) -> None:
    """Adds a ball [m] that can be anywhere and hinders nothing."""
    body = root.worldbody.add("body", name=name, mocap=True)
    white = {"contype": 0, "conaffinity": 0, "rgba": [1, 1, 1, 1]}
    body.add("geom", name=name, type="sphere", size=[radius], **white)


def _remove_walls(root: mjcf.RootElement) -> None:
    """Removes the corridor's walls and the plane below it.

    Each plane is a candidate contact of every geom of the body. A body that leaves the side of the
    corridor falls, and has then failed, as in a gap.
    """
    for geom in root.worldbody.find_all("geom", immediate_children_only=True):
        geom.remove()


def _checker(root: mjcf.RootElement, tile: float) -> mjcf.Element:
    """A checker pattern, so that a video shows motion; `tile` [m] is the edge of a square."""
    texture = root.asset.add(
        "texture",
        name=GROUND,
        type="cube",
        builtin="checker",
        rgb1=[0.35, 0.4, 0.45],
        rgb2=[0.45, 0.5, 0.55],
        width=100,
        height=100,
    )
    return root.asset.add(
        "material", name=GROUND, texture=texture, texuniform=True, texrepeat=[0.5 / tile] * 2
    )


def draw_course(key: Array, arena: GapsCorridor) -> Array:
    """Draws the platforms of one episode.

    Args:
      key: typed key [].
      arena: the corridor; lengths are uniform in its ranges.

    Returns:
      [P, 2] start and end of each platform along x [m], in order; the first is `[0, start_length]`.
    """
    platform_key, gap_key = jax.random.split(key)
    shape = (arena.platforms - 1,)
    platforms = _draw_lengths(platform_key, arena.platform_length, shape)
    gaps = _draw_lengths(gap_key, arena.gap_length, shape)
    ends = arena.start_length + jnp.cumsum(platforms + gaps)
    first = jnp.array([[0.0, arena.start_length]], jnp.float32)
    return jnp.concatenate([first, jnp.stack([ends - platforms, ends], axis=1)])


def _draw_lengths(key: Array, limits: tuple[float, float], shape: tuple[int, ...]) -> Array:
    low, high = limits
    return low + (high - low) * jax.random.uniform(key, shape, jnp.float32)


class BoxFields(NamedTuple):
    """Where the corridor's boxes are in a compiled model, and that model's own values."""

    boxes: tuple[int, ...]  # geom ids, W of them
    geom_pos: Array  # [ngeom, 3]
    geom_size: Array  # [ngeom, 3]
    geom_aabb: Array  # [ngeom, 6]
    geom_rbound: Array  # [ngeom]


def box_fields(model: mujoco.MjModel, boxes: tuple[int, ...]) -> BoxFields:
    """Takes from a model what `course_changes` needs; `boxes` are geom ids."""
    own = {n: jnp.float32(getattr(model, n)) for n in BoxFields._fields if n != "boxes"}
    return BoxFields(boxes=tuple(boxes), **own)


def course_changes(fields: BoxFields, course: Array, x: Array, reach: float) -> dict[str, Array]:
    """Makes the window's boxes the platforms in reach of x; pure.

    Args:
      fields: of the composed model.
      course: [P, 2] platforms of this episode [m], none longer than the arena's `longest_platform`.
      x: [] the torso's position along the corridor [m].
      reach: of the body [m].

    Returns:
      Model fields for `Physics.step`: `geom_pos` and `geom_size`, [ngeom, 3] each, and the bounds
      that follow from a box's size: `geom_aabb` [ngeom, 6] and `geom_rbound` [ngeom].
    """
    number = len(fields.boxes)
    first = jnp.sum(course[:, 1] < x - reach)
    first = jnp.clip(first, 0, course.shape[0] - number)
    window = jax.lax.dynamic_slice(course, (first, 0), (number, 2))
    ids = jnp.array(fields.boxes)
    half = (window[:, 1] - window[:, 0]) / 2
    size = fields.geom_size.at[ids, 0].set(half)
    return {
        "geom_pos": fields.geom_pos.at[ids, 0].set(window.mean(axis=1)).at[ids, 2].set(-_THICKNESS),
        "geom_size": size,
        "geom_aabb": fields.geom_aabb.at[ids, 3].set(half),
        "geom_rbound": fields.geom_rbound.at[ids].set(jnp.linalg.norm(size[ids], axis=1)),
    }


def platform_boxes(course: Array, width: float) -> tuple[Array, Array]:
    """Returns a course [P, 2] as boxes: centers [P, 3] and half sizes [P, 3] [m]."""
    half = (course[:, 1] - course[:, 0]) / 2
    zero = jnp.zeros_like(half)
    centers = jnp.stack([course.mean(axis=1), zero, zero - _THICKNESS], axis=1)
    return centers, jnp.stack([half, zero + width / 2, zero + _THICKNESS], axis=1)


def distances_to_next_edges(course: Array, x: Array, number: int, sight: float) -> Array:
    """What lies ahead: signed distances from x to the next edges of platforms.

    In pairs, start and end, of the platform at x and those after it; over a gap the first pair is
    the platform ahead. A negative start thus means ground under x.

    Args:
      course: [P, 2] [m].
      x: [] position along the corridor [m].
      number: how many edges, even.
      sight: distances are clipped to +-sight [m].

    Returns:
      [number] [m].
    """
    if number % 2:
        raise ValueError(f"number of edges is {number}: edges come in pairs, give an even number.")
    first = jnp.clip(jnp.sum(course[:, 1] < x), 0, course.shape[0] - number // 2)
    edges = jax.lax.dynamic_slice(course, (first, 0), (number // 2, 2)).reshape(number)
    return jnp.clip(edges - x, -sight, sight)


def gaps_crossed(course: Array, x: Array) -> Array:
    """How many gaps lie wholly behind x: [] int32; a body that fell into one has not crossed it."""
    return jnp.sum(course[1:, 0] <= x).astype(jnp.int32)


def _check_range(name: str, limits: tuple[float, float]) -> None:
    low, high = limits
    if not 0 < low <= high < math.inf:
        raise ValueError(
            f"{name} is {limits}: give (least, greatest) in metres with 0 < least <= greatest."
        )
