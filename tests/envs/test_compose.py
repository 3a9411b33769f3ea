"""Bodies in arenas: names, spawning, and a corridor whose window is all that matters."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from purerl.envs import arenas, compose as compose_module
from purerl.envs.arenas import Floor, GapsCorridor, course_changes, draw_course
from purerl.envs.bodies import ANT, RODENT
from purerl.envs.compose import PREFIX, compose
from purerl.physics.interface import Physics
from purerl.physics.lookup import find, names
from tests import quick

ANT_CORRIDOR = GapsCorridor(platform_length=(1.5, 2.0), gap_length=(0.05, 0.2), width=4.0)
RODENT_CORRIDOR = GapsCorridor(boxes=2)
CASES = {"ant": (ANT, ANT_CORRIDOR), "rodent": (RODENT, RODENT_CORRIDOR)}
ALL_BOXES = 12  # enough for a short corridor's whole course


@pytest.fixture(params=sorted(CASES))
def case(request):
    """A body and its corridor."""
    return CASES[request.param]


def short(arena: GapsCorridor) -> GapsCorridor:
    """A short corridor from x = 0: `ALL_BOXES` boxes hold the whole course."""
    length = 1.5 + (ALL_BOXES - 3) * (arena.platform_length[0] + arena.gap_length[0]) - 1e-6
    return dataclasses.replace(arena, length=length, start_length=1.5, spawn_x=1.0)


def with_course(composed, course, x):
    """A copy of the composed model with the window for x written into it."""
    model = composed.model.__copy__()
    for name, value in course_changes(composed.boxes, course, x, composed.body.reach).items():
        getattr(model, name)[:] = value
    return model


def forward(model, qpos):
    """Accelerations and the number of contacts at qpos, at rest."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data.qacc.copy(), data.ncon


def random_qpos(composed, rng, x):
    """The body near x, low and turned at random, joints anywhere in their ranges."""
    model = composed.model
    qpos = model.qpos0.copy()
    qpos[:3] = x, rng.uniform(-0.3, 0.3), composed.body.spawn_height * rng.uniform(-0.2, 1.0)
    qpos[3:7] += 0.4 * rng.normal(size=4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    for joint in composed.joints:
        qpos[model.jnt_qposadr[joint]] = rng.uniform(*model.jnt_range[joint])
    return qpos


def test_the_body_stands_on_its_torso_and_settles_healthy(case):
    body, corridor = case
    for arena in (Floor(), corridor):
        composed = compose(body, arena, engine="c")
        course = draw_course(jax.random.key(0), corridor)
        model = composed.model if isinstance(arena, Floor) else with_course(composed, course, 5.0)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.xpos[composed.torso], data.qpos[:3])
        np.testing.assert_allclose(data.qpos[2], body.spawn_height)
        for _ in range(int(1.0 / model.opt.timestep)):
            mujoco.mj_step(model, data)
        low, high = body.healthy_height
        assert low < data.qpos[2] < high
        assert data.ncon > 0
        # The subtree is the walker and nothing else: the lab's reward once read the arena's.
        own = [i for i, name in enumerate(names(model, "body")) if name.startswith(PREFIX)]
        np.testing.assert_allclose(
            model.body_subtreemass[composed.torso], model.body_mass[own].sum(), rtol=1e-4
        )


def test_reach_holds_the_colliding_parts(case):
    body, corridor = case
    composed = compose(body, corridor, engine="c")
    model, data, rng = composed.model, mujoco.MjData(composed.model), np.random.default_rng(0)
    touching = np.flatnonzero(model.geom_contype)
    farthest = 0.0
    for _ in range(300):
        data.qpos[:] = random_qpos(composed, rng, 0.0)
        mujoco.mj_kinematics(model, data)
        away = np.linalg.norm(data.geom_xpos[touching] - data.qpos[:3], axis=1)
        farthest = max(farthest, (away + model.geom_rbound[touching]).max())
    assert 0.7 * body.reach < farthest < body.reach - 0.02


def with_real_platforms(body, arena, course, monkeypatch):
    """The reference: every platform of the course, compiled where it is and as long as it is."""

    def build(_):
        root = arenas.build_arena(dataclasses.replace(arena, boxes=len(course)))
        for i, (start, end) in enumerate(np.float64(course)):
            geom = root.find("geom", f"ground_{i}")
            geom.pos = [(start + end) / 2, 0, -geom.size[2]]
            geom.size = [(end - start) / 2, *geom.size[1:]]
        return root

    with monkeypatch.context() as patch:
        patch.setattr(compose_module, "build_arena", build)
        return compose(body, arena, engine="c").model


@pytest.mark.slow
def test_the_window_equals_all_platforms(case, monkeypatch):
    body, corridor = case
    arena = short(corridor)
    assert arena.platforms == ALL_BOXES
    few = compose(body, arena, engine="c")
    rng, touching = np.random.default_rng(1), 0
    for i in range(4):
        course = draw_course(jax.random.key(i), arena)
        full = with_real_platforms(body, arena, course, monkeypatch)
        for x in rng.uniform(0.5, float(course[-2, 1]), 30):
            qpos = random_qpos(few, rng, x)
            expected, contacts = forward(full, qpos)
            got, found = forward(with_course(few, course, x), qpos)
            assert found == contacts
            np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
            touching += contacts > 0
    assert touching > 40


def test_the_rodent_is_stable_under_random_actions():
    """The masks and the time step were chosen for this; top speeds were 92 rad/s in 20 s of 256."""
    model = compose(RODENT, Floor(), engine="c").model
    batch, rng = Batch(model, 8), np.random.default_rng(0)
    for _ in range(100):
        batch.bind("ctrl")[:] = rng.uniform(-1, 1, (8, model.nu))
        batch.step(nstep=5)
        assert np.abs(batch.bind("qvel")).max() < 200
    np.testing.assert_allclose(batch.bind("time"), 100 * 5 * model.opt.timestep)  # none was reset


def test_a_box_is_where_its_platform_is(case):
    """A ray down onto each platform hits its top; into a gap it hits nothing."""
    body, corridor = case
    composed = compose(body, corridor, engine="c")
    course = np.asarray(draw_course(jax.random.key(3), corridor))
    for x in (6.5, 20.0, 30.0):
        model = with_course(composed, jnp.asarray(course), x)
        data = mujoco.MjData(model)
        data.qpos[1] = 50.0  # the body out of the way
        mujoco.mj_kinematics(model, data)
        for probe in x + body.reach * np.linspace(-1.0, 1.0, 47):
            on = ((course[:, 0] < probe) & (probe < course[:, 1])).any()
            start, hit = np.array([probe, 0.0, 1.0]), np.zeros(1, np.int32)
            down = np.array([0.0, 0.0, -1.0])
            far = mujoco.mj_ray(model, data, start, down, None, 1, -1, hit, None)
            np.testing.assert_allclose(far, 1.0 if on else -1.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_courses_differ_between_environments(engine):
    """The same state over ground in one environment, over a gap in the other: one falls."""
    composed = compose(ANT, ANT_CORRIDOR, engine=engine)
    physics = Physics(composed.model, ("xpos",), substeps=5, engine=engine)
    ground = jnp.array([[2.0, 8.0], [9.0, 10.0], [11.0, 12.0]])
    gap = jnp.array([[0.0, 2.0], [9.0, 10.0], [11.0, 12.0]])
    qpos = jnp.asarray(composed.model.qpos0).at[2].set(0.37)

    def fall(course):
        def control_step(state, _):
            changes = course_changes(composed.boxes, course, state.qpos[0], ANT.reach)
            return physics.step(state, jnp.zeros(8), changes)

        changes = course_changes(composed.boxes, course, qpos[0], ANT.reach)
        state, _ = physics.init(qpos, jnp.zeros(composed.model.nv), changes)
        return jax.lax.scan(control_step, state, None, 8)[0].qpos[2]

    heights = quick.jit(jax.vmap(fall))(jnp.stack([ground, gap]))
    assert heights[0] > 0.33
    np.testing.assert_allclose(heights[1], 0.37 - 9.81 * 0.2**2 / 2, atol=0.01)


def test_draw_course_keeps_its_ranges():
    corridor = GapsCorridor()
    courses = jax.vmap(lambda key: draw_course(key, corridor))(jax.random.split(jax.random.key(0)))
    for course in np.asarray(courses, np.float64):
        np.testing.assert_allclose(course[0], [0.0, 6.0])
        assert course[-1, 1] >= corridor.length
        platforms, gaps = course[1:, 1] - course[1:, 0], course[1:, 0] - course[:-1, 1]
        for lengths, (low, high) in ((platforms, (0.4, 0.8)), (gaps, (0.05, 0.2))):
            assert lengths.min() > low - 1e-5 and lengths.max() < high + 1e-5
            assert lengths.max() - lengths.min() > 0.7 * (high - low)
    assert not np.allclose(courses[0], courses[1])


def test_edges_and_gaps_by_hand():
    course = jnp.array([[0.0, 6.0], [6.1, 7.0], [7.2, 8.0], [8.1, 9.0]])
    edges = lambda x: np.asarray(arenas.distances_to_next_edges(course, x, 4, sight=1.5))  # noqa: E731
    np.testing.assert_allclose(edges(5.5), [-1.5, 0.5, 0.6, 1.5], atol=1e-5)
    np.testing.assert_allclose(edges(6.05), [0.05, 0.95, 1.15, 1.5], atol=1e-5)
    np.testing.assert_allclose(edges(9.5), [-1.5, -1.5, -1.4, -0.5], atol=1e-5)
    crossed = [int(arenas.gaps_crossed(course, x)) for x in (5.0, 6.05, 6.2, 7.1, 7.3, 9.5)]
    assert crossed == [0, 0, 1, 1, 2, 3]
    with pytest.raises(ValueError, match="even"):
        arenas.distances_to_next_edges(course, 0.0, 3, sight=1.0)


def test_bad_input_is_refused():
    for name in ("platform_length", "gap_length"):
        for limits in ((0.0, 0.1), (0.5, 0.4), (-1.0, 1.0)):
            with pytest.raises(ValueError, match=name):
                GapsCorridor(**{name: limits})
    with pytest.raises(ValueError, match="cannot cross"):
        compose(RODENT, GapsCorridor(gap_length=(0.1, 0.9)))
    with pytest.raises(ValueError, match="boxes=3"):
        compose(ANT, dataclasses.replace(ANT_CORRIDOR, boxes=2))
    with pytest.raises(ValueError, match="Did you mean 'torso'"):
        compose(dataclasses.replace(ANT, torso="torsso"), Floor())
    with pytest.raises(ValueError, match="no geom 'tusk'.*upper_leg_L0_collision"):
        compose(dataclasses.replace(RODENT, ground_geoms=("tusk",)), Floor())
    with pytest.raises(ValueError, match="There are: .*walker/floating"):
        find(compose(ANT, Floor()).model, "camera", "behind")


def test_what_is_kept_and_what_is_not(case):
    body, corridor = case
    composed = compose(body, corridor)
    model = composed.model
    find(model, "camera", PREFIX + "egocentric")
    assert [model.sensor(i).name for i in range(model.nsensor)] == ["walker/torso_velocity"]
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    # No part touches another: every candidate pair is of a part and the ground.
    body_geoms = [i for i in range(model.ngeom) if model.geom(i).name.startswith(PREFIX)]
    assert not model.geom_conaffinity[body_geoms].any()
    assert model.geom_contype[body_geoms].any()
