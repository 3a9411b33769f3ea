"""Mazes that are drawn, and the rodent that forages in one."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.envs import maze_forage, mazes, sight
from purerl.envs.mazes import Maze

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

NUMBER = 64


@pytest.fixture(scope="module")
def drawn():
    maze = Maze()
    keys = jax.random.split(jax.random.key(0), NUMBER)
    return maze, jax.tree.map(
        np.asarray, jax.jit(jax.vmap(lambda k: mazes.draw_maze(k, maze)))(keys)
    )


def reached(free: np.ndarray) -> np.ndarray:
    """The cells that can be reached from a corner, by filling."""
    seen = np.zeros_like(free)
    seen[1, 1] = True
    for _ in range(free.size):
        near = np.pad(seen, 1)
        near = near[:-2, 1:-1] | near[2:, 1:-1] | near[1:-1, :-2] | near[1:-1, 2:]
        seen |= near & free
    return seen


def test_every_free_cell_of_a_maze_can_be_reached(drawn):
    maze, one = drawn
    for free in one.free:
        assert np.array_equal(reached(free), free)
        assert not free[[0, -1]].any() and not free[:, [0, -1]].any()  # closed all round
        assert free[1::2, 1::2].all()
    assert len({free.tobytes() for free in one.free}) == NUMBER


def test_a_tree_has_no_circle():
    """25 places are joined by 24 openings."""
    for seed in range(8):
        free = np.asarray(mazes.spanning_tree(jax.random.key(seed), 11))
        assert free.sum() == 25 + 24 and np.array_equal(reached(free), free)


def check_places(maze: Maze, one: mazes.Drawn) -> None:
    places = np.concatenate([one.start[:, None], one.targets], axis=1)
    cells = np.round(places / maze.cell + (maze.cells - 1) / 2).astype(int)
    for free, mine in zip(np.asarray(one.free), cells, strict=True):
        assert free[mine[:, 0], mine[:, 1]].all()
        assert len(np.unique(mine, axis=0)) == 1 + maze.targets


def test_targets_and_the_start_are_free_cells_of_their_own(drawn):
    maze, one = drawn
    check_places(maze, one)
    assert maze.targets == 12
    assert one.start.std(axis=0).min() > 0.5


def test_a_treat_is_not_in_a_wall_where_rooms_have_too_few_cells_of_their_own():
    """One of 3,000 mazes; with twelve rooms one of ten."""
    for maze, key in (
        (Maze(), jax.random.split(jax.random.key(0), 10000)[1783]),
        (Maze(rooms=12), jax.random.key(0)),
    ):
        keys = jnp.concatenate([key[None], jax.random.split(jax.random.clone(key), 63)])
        one = jax.jit(jax.vmap(lambda k, maze=maze: mazes.draw_maze(k, maze)))(keys)
        check_places(maze, one)


def test_walls_near_are_all_that_a_body_can_touch(drawn):
    """Every wall cell within 0.24 m of a free place is in the window."""
    maze, one = drawn
    free = one.free[0]
    centers, halves = map(np.asarray, mazes.all_walls(maze, jnp.asarray(free)))
    assert (halves[:, 2] > 0).sum() == (~free).sum()
    random = np.random.default_rng(0)
    for cell in random.permutation(np.argwhere(free))[:40]:
        place = np.asarray(mazes.center_of(maze, cell)) + random.uniform(-0.25, 0.25, 2)
        outside = np.maximum(np.abs(centers[:, :2] - place) - halves[:, :2], 0.0)
        touching = (np.linalg.norm(outside, axis=1) < 0.24) & (halves[:, 2] > 0)
        near = np.asarray(mazes.walls_near(maze, jnp.asarray(free), jnp.float32(place)))
        window = {tuple(np.round(x, 3)) for x in near[near[:, 2] > 0, :2]}
        assert {tuple(np.round(x, 3)) for x in centers[touching, :2]} <= window


def test_sizes_that_make_no_maze_are_refused():
    for words in ({"cells": 10}, {"room": (4,)}, {"room": (11,)}):
        with pytest.raises(ValueError, match="give odd numbers of cells"):
            Maze(**words)


@pytest.fixture(scope="module")
def env():
    """20 s to build and to compile."""
    made = maze_forage.build(maze_forage.Options(eyes=sight.Sight(number=1, size=16)), "c")
    return made, jax.jit(made.reset), jax.jit(made.step)


@pytest.mark.slow
def test_a_treat_is_found_once_gone_then_and_all_end_the_episode(env):
    made, reset, step = env
    state = reset(jax.random.key(0))
    assert float(state.reward) == 0.0 and state.observation["eyes"].shape == (1, 16, 16)
    data = mujoco.MjData(made.parts.model)
    data.qpos[:] = state.physics.qpos
    mujoco.mj_forward(made.parts.model, data)
    skull = data.geom("walker/skull_0_collision").xpos
    here = state.replace(task=state.task | {"targets": state.task["targets"].at[2].set(skull)})
    after = step(here, jnp.zeros(made.action_size))
    assert float(after.reward) == 50.0 == 50 * float(after.metrics["treats_count"])
    later = step(after, jnp.zeros(made.action_size))
    assert float(later.reward) == 0.0 and float(later.physics.mocap_pos[2, 2]) == maze_forage.GONE
    rest = {"found": jnp.ones(12, bool).at[2].set(False)}
    assert bool(step(here.replace(task=here.task | rest), jnp.zeros(made.action_size)).terminated)
    assert not bool(after.terminated)


@pytest.mark.slow
def test_a_wall_stops_the_body_and_is_seen(env):
    """Pushed at 2 m/s toward a wall, the trunk does not come through it."""
    made, reset, step = env
    state = reset(jax.random.key(1))
    free = np.asarray(state.task["free"])
    cell = next(c for c in np.argwhere(free) if not free[c[0] + 1, c[1]])
    wall = float(mazes.center_of(made.maze, cell)[0]) + made.maze.cell / 2
    place = mazes.center_of(made.maze, jnp.asarray(cell))
    qpos = state.physics.qpos.at[:2].set(place).at[3:7].set(jnp.array([1.0, 0, 0, 0]))
    qvel = state.physics.qvel.at[0].set(2.0)
    state = state.replace(physics=state.physics.replace(qpos=qpos, qvel=qvel))
    farthest = -np.inf
    for _ in range(25):
        state = step(state, jnp.zeros(made.action_size))
        farthest = max(farthest, float(state.physics.qpos[0]))
    assert wall - 0.2 < farthest < wall
    readings = made.physics.init(state.physics.qpos, state.physics.qvel, made.model_changes(state))[
        1
    ]
    distance = made.eyes.distance(readings.xpos, readings.xmat, made.scenery(state))
    assert np.isfinite(distance).all()  # a closed maze: walls or the ground everywhere, and it sees
