"""Mazes of rooms and corridors on a grid, drawn anew in every episode, as pure functions.

A maze is a grid [N, N] bool of what is free, N odd. Cells with two odd coordinates are always free;
a random spanning tree opens walls between them, and rooms are cut out of what is left. Sizes are
those of dm_control's forage task, which takes its mazes from `labmaze`.
"""

import dataclasses
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl import Array


@dataclasses.dataclass(frozen=True)
class Maze:
    """Sizes of a maze."""

    cells: int = 11  # N, along both edges, odd
    cell: float = 0.5  # edge of a cell [m]
    height: float = 0.3  # of a wall [m]
    rooms: int = 4
    room: tuple[int, ...] = (3, 5)  # their edges are of these, odd [cells]
    targets_per_room: int = 3
    boxes: int = 4  # walls that a body can touch at once: it is smaller than a cell

    def __post_init__(self):
        """Refuses sizes that make no maze."""
        if self.cells % 2 == 0 or any(edge % 2 == 0 or edge > self.cells - 2 for edge in self.room):
            raise ValueError(
                f"cells is {self.cells} and room {self.room}: give odd numbers of cells, and rooms "
                "at least 2 cells smaller than the maze."
            )

    @property
    def targets(self) -> int:
        """How many there are in a maze."""
        return self.rooms * self.targets_per_room


class Drawn(NamedTuple):
    """One episode's maze."""

    free: Array  # [N, N] bool; the first axis is along x
    start: Array  # [2] where the body begins [m]
    targets: Array  # [M, 2] [m]


def draw_maze(key: Array, maze: Maze) -> Drawn:
    """Draws a maze, where the body begins, and targets in each room, all in cells of their own."""
    tree_key, room_key, place_key = jax.random.split(key, 3)
    rooms = draw_rooms(room_key, maze)
    free = spanning_tree(tree_key, maze.cells) | rooms.any(0)
    # In each room the cells of the highest scores that no room before it has taken; if it has too
    # few of its own, since rooms overlap, others that are free.
    score = jax.random.uniform(place_key, (maze.cells, maze.cells))
    taken, chosen = jnp.zeros_like(free), []
    for number in range(maze.rooms):
        wanted = maze.targets_per_room + (number == 0)
        ranked = jnp.where(rooms[number], score, score - 1.0)
        _, best = jax.lax.top_k(jnp.where(free & ~taken, ranked, -2.0).ravel(), wanted)
        chosen.append(best)
        taken = taken.ravel().at[best].set(True, unique_indices=True).reshape(taken.shape)
    index = jnp.concatenate(chosen)
    place = center_of(maze, jnp.stack([index // maze.cells, index % maze.cells], axis=1))
    return Drawn(free, place[0], place[1:])


def draw_rooms(key: Array, maze: Maze) -> Array:
    """Draws rooms, [R, N, N] bool: which cells each has. They may overlap."""
    size_key, place_key = jax.random.split(key)
    size = jax.random.choice(size_key, jnp.array(maze.room), (maze.rooms, 2))
    steps = (maze.cells - size) // 2  # a room begins at an odd coordinate
    first = 1 + 2 * jax.random.randint(place_key, size.shape, 0, steps)
    along = jnp.arange(maze.cells)
    inside = (along >= first[:, :, None]) & (along < (first + size)[:, :, None])  # [R, 2, N]
    return inside[:, 0, :, None] & inside[:, 1, None, :]


def spanning_tree(key: Array, cells: int) -> Array:
    """Returns a maze without circles, [N, N] bool, by Prim's algorithm with random weights."""
    odd = range(1, cells, 2)
    nodes = {place: number for number, place in enumerate(itertools.product(odd, odd))}
    pairs = [((x, y), (x + 2 * dx, y + 2 * (1 - dx))) for x, y in nodes for dx in (0, 1)]
    edges = [(a, b) for a, b in pairs if b in nodes]
    ends = jnp.array([[nodes[a], nodes[b]] for a, b in edges])
    weights = jax.random.uniform(key, (len(edges),))

    def grow(_, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        inside, open_ = carry
        crosses = inside[ends[:, 0]] != inside[ends[:, 1]]
        best = jnp.argmin(jnp.where(crosses, weights, jnp.inf))
        return inside.at[ends[best]].set(True), open_.at[best].set(True)

    begun = jnp.zeros(len(nodes), bool).at[0].set(True), jnp.zeros(len(edges), bool)
    _, open_ = jax.lax.fori_loop(0, len(nodes) - 1, grow, begun)
    between = np.array([np.add(a, b) // 2 for a, b in edges])
    free = jnp.zeros((cells, cells), bool).at[tuple(np.array(list(nodes)).T)].set(True)
    return free.at[tuple(between.T)].set(open_, unique_indices=True)


def center_of(maze: Maze, cell: Array) -> Array:
    """Returns the middle of cells [..., 2] [m]; that of the maze is the origin."""
    return (cell - (maze.cells - 1) / 2) * maze.cell


def all_walls(maze: Maze, free: Array) -> tuple[Array, Array]:
    """Returns a maze's walls as boxes: centers and half sizes, [N * N, 3] each [m].

    Where a cell is free, the box is far below the ground, and nothing.
    """
    cells = jnp.stack(jnp.meshgrid(*[jnp.arange(maze.cells)] * 2, indexing="ij"), -1).reshape(-1, 2)
    center, half = center_of(maze, cells), maze.cell / 2
    height = jnp.where(free.ravel(), -10.0, maze.height / 2)
    size = jnp.where(free.ravel()[:, None], 0.0, jnp.array([half, half, maze.height / 2]))
    return jnp.concatenate([center, height[:, None]], axis=1), size


def walls_near(maze: Maze, free: Array, place: Array) -> Array:
    """Returns the middles of the walls that a body at `place` [2] can touch, [boxes, 3] [m].

    Of the two by two cells nearest to it; what is free is far below the ground.
    """
    corner = jnp.floor(place / maze.cell + (maze.cells - 1) / 2).astype(jnp.int32)
    cells = jnp.clip(corner + jnp.array([[0, 0], [0, 1], [1, 0], [1, 1]]), 0, maze.cells - 1)
    height = jnp.where(free[cells[:, 0], cells[:, 1]], -10.0, maze.height / 2)
    return jnp.concatenate([center_of(maze, cells), height[:, None]], axis=1)
