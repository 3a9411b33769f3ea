"""The bowl against dm_control's own terrain and task, and its planes against a height field."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dm_control import mjcf
from dm_control.locomotion.arenas import bowl as dm_bowl
from dm_control.locomotion.tasks import escape
from dm_control.locomotion.walkers import rodent

from purerl.envs import arenas, bowls, compose as composing, escape_bowl, sight
from purerl.envs.bodies import RODENT
from purerl.envs.bowls import Bowl
from purerl.envs.compose import PREFIX, compose
from purerl.physics.lookup import find
from tests import quick

BOWL = Bowl()
SLOPE = np.float32([2.0, 1.0])  # a place on one [m]
BUMPS = np.random.default_rng(0).uniform(BOWL.least, 1.0, (BOWL.bumps, BOWL.bumps))


@pytest.fixture(scope="module")
def terrain():
    return np.asarray(bowls.coefficients(BOWL, jnp.float32(BUMPS)))


@quick.jit
def ground(terrain, place):
    return bowls.ground(BOWL, terrain, place)


@quick.jit
def heights(terrain):
    return bowls.heights(BOWL, terrain)


def test_the_terrain_is_dm_controls(terrain):
    """Of the same bumps, and of the same size."""
    arena = dm_bowl.Bowl()
    physics = mjcf.Physics.from_mjcf_model(arena.mjcf_model)
    blind = SimpleNamespace(bind=physics.bind, model=physics.model, contexts=None)
    arena.initialize_episode(blind, SimpleNamespace(uniform=lambda low, high, size: BUMPS))
    right = physics.model.hfield_data.reshape(BOWL.edges, BOWL.edges)
    sizes = (BOWL.half, BOWL.half, BOWL.height, 0.1)
    np.testing.assert_allclose(physics.model.hfield_size[0], sizes)
    np.testing.assert_allclose(physics.named.model.geom_pos["terrain"], [0, 0, -BOWL.depth])
    np.testing.assert_allclose(heights(terrain), BOWL.height * right, atol=1e-5)


def field_model(walker: bool = False) -> mujoco.MjModel:
    """dm_control's ground as MuJoCo has it, with a rodent as ours or without."""
    root = arenas.build_arena(BOWL)
    if walker:
        body = RODENT.build()
        composing.keep_sensors(body, ())
        composing.attach(root, body, RODENT, 0.0)
    model = mjcf.Physics.from_mjcf_model(root).model.ptr
    if walker:
        composing.mask_contacts(model, RODENT, False)
        composing.round_ellipsoids(model)
        composing.set_solver(model, RODENT, "c", RODENT.timestep)
    return model


def put(model: mujoco.MjModel, terrain) -> None:
    """Writes a terrain into the model's height field, as dm_control does."""
    model.hfield_data[:] = np.asarray(heights(terrain)).ravel() / BOWL.height


def test_the_ground_is_where_mujocos_rays_meet_it(terrain):
    """In both triangles of cells, where the plane is higher, and beside the field."""
    model = field_model()
    put(model, terrain)
    data, random = mujoco.MjData(model), np.random.default_rng(1)
    mujoco.mj_forward(model, data)

    def height(x: float, y: float) -> float:
        geom = np.zeros(1, np.int32)
        return 2 - mujoco.mj_ray(model, data, [x, y, 2], [0, 0, -1], None, 1, -1, geom)

    place = random.integers(-112, 112, (60, 2)) * BOWL.cell
    place += BOWL.cell * np.where(random.random((60, 1)) < 0.5, [0.3, 0.6], [0.7, 0.2])
    found, normal = map(np.asarray, ground(terrain, np.float32(place)))
    np.testing.assert_allclose(found, [height(*p) for p in place], atol=1e-5)
    e = 1e-3
    slopes = [[height(x + e, y) - height(x - e, y), height(x, y + e) - height(x, y - e)]
              for x, y in place]  # fmt: skip
    np.testing.assert_allclose(-normal[:, :2] / normal[:, 2:], np.array(slopes) / 2 / e, atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-5)
    assert (found == 0.0).sum() > 3 and (normal[:, 2] < 0.9).sum() > 10


def test_planes_are_tangents(terrain):
    place = np.float32(np.random.default_rng(2).uniform(-5, 5, (20, 2)))
    planes = quick.jit(lambda t, p: bowls.planes(BOWL, t, p))
    point, turn = map(np.asarray, planes(terrain, place))
    height, normal = map(np.asarray, ground(terrain, place))
    np.testing.assert_allclose(point, np.column_stack([place, height]), atol=1e-6)
    for quat, up in zip(turn, normal, strict=True):
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, [0.0, 0.0, 1.0], np.float64(quat))
        np.testing.assert_allclose(turned, up, atol=1e-6)


def test_the_reward_is_dm_controls():
    """Of its own code, told where the head is and how upright torso and pelvis are."""
    random, task = np.random.default_rng(0), escape.Escape.__new__(escape.Escape)
    walker = SimpleNamespace(root_body="torso", pelvis_body="pelvis")
    task.__dict__.update(_reward_body="walker/head", _walker=walker)
    reward = quick.jit(lambda distance, up: escape_bowl.reward_of(BOWL, distance, up))
    for _ in range(300):
        head, ups = random.normal(size=3) * 4, dict(zip(("torso", "pelvis"), random.uniform(-1, 1, 2)))  # noqa: B905, E501  # fmt: skip
        physics = SimpleNamespace(
            model=SimpleNamespace(hfield_size=np.array([[BOWL.half]])),
            named=SimpleNamespace(data=SimpleNamespace(site_xpos={"walker/head": head})),
            bind=lambda body, ups=ups: SimpleNamespace(xmat=np.array([ups[body]])),
        )
        right = task.get_reward(physics)
        distance, up = np.float32(np.linalg.norm(head)), np.float32(min(ups.values()))
        assert float(reward(distance, up)) == pytest.approx(right, abs=1e-5)
    assert task.get_discount(None) == 1.0  # nothing ends an episode


def test_the_ground_around_is_told_from_where_the_body_looks(terrain):
    """Turned by 90 degrees it looks along y; the last place of the first row is far ahead."""
    turned = np.float32([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    place = np.float32([1.0, 2.0, 0.3])
    around = quick.jit(lambda t, *where: escape_bowl.ground_around(BOWL, t, RODENT, *where))
    told = np.asarray(around(terrain, place, turned)).reshape(5, 8)
    corner = np.float32([[1.0 + RODENT.reach, 2.0 + RODENT.sight]])
    right = ground(terrain, corner)[0][0] - 0.3
    assert float(told[0, 7]) == pytest.approx(float(right), abs=1e-6)


@pytest.mark.slow
def test_the_terrain_is_drawn(terrain):
    """The columns below the body end where the ground is, none is above it."""
    # Operation by operation: each program fuses, and so rounds, them in its own way.
    center, half = map(np.asarray, bowls.columns(BOWL, terrain, np.float32([2.0, 1.0])))
    top, places = (center + half)[:, 2], jnp.asarray(center[:, :2])
    right = np.asarray(bowls.ground(BOWL, terrain, places)[0])
    fine = half[:, 0] < BOWL.cell
    np.testing.assert_allclose(top[fine], right[fine], atol=1e-6)
    assert (top < right + 1e-6).all() and (half > 0).all() and np.median(right - top) < 0.05
    assert np.abs(center[fine, :2] - [2.0, 1.0]).max() < 0.5 < 5.5 < center[~fine, 0].max()


def test_each_geom_meets_the_ground_by_its_own_plane_with_dm_controls_friction(terrain):
    """A pair has what MuJoCo would mix of geom and terrain; nothing else touches anything."""
    model, other = compose(RODENT, BOWL, "c").model, field_model(walker=True)
    assert not model.geom_conaffinity.any() and model.npair == len(RODENT.ground_geoms)
    put(other, terrain)
    data = mujoco.MjData(other)
    data.qpos[2] = 0.02
    mujoco.mj_forward(other, data)
    assert data.ncon > 10
    pairs = {model.geom(b).name: k for k, (a, b) in enumerate(zip(*sides(model), strict=True))}
    assert len(pairs) == model.npair == len({*sides(model)[0]})
    for contact in data.contact:
        k = pairs[other.geom(max(contact.geom)).name]
        np.testing.assert_allclose(model.pair_friction[k], contact.friction)
        np.testing.assert_allclose(model.pair_solref[k], contact.solref)
        np.testing.assert_allclose(model.pair_solimp[k], contact.solimp)
        assert (model.pair_dim[k], model.pair_margin[k]) == (contact.dim, 0.0)


def sides(model: mujoco.MjModel) -> tuple:
    """The planes and the geoms of pairs."""
    return model.pair_geom1, model.pair_geom2


@pytest.fixture(scope="module")
def env():
    """Builds and compiles."""
    made = escape_bowl.build(escape_bowl.Options(eyes=sight.Sight(number=1, size=8)), "c")
    return made, quick.jit(jax.vmap(made.reset)), quick.jit(jax.vmap(made.step))


@pytest.mark.slow
def test_a_body_begins_above_the_ground_and_falls_as_on_a_height_field(env):
    """Against MuJoCo with the terrain itself, in the middle and on a slope, for 0.2 s.

    Where a geom lies across an edge the two differ: a field holds it at more points.
    """
    made, reset, step = env
    states = reset(jax.random.split(jax.random.key(0), 8))
    assert len({x.tobytes() for x in np.asarray(states.task["terrain"])}) == 8
    turns = np.asarray(states.physics.qpos[:, 3:7])
    assert turns.std(axis=0).min() > 0.2
    other, qpos = field_model(walker=True), np.array(states.physics.qpos)
    data = [mujoco.MjData(other) for _ in range(8)]

    def contacts(k: int, lift: float) -> int:
        put(other, states.task["terrain"][k])
        data[k].qpos[:] = qpos[k]
        data[k].qpos[2] += lift
        mujoco.mj_forward(other, data[k])
        return data[k].ncon

    assert not any(contacts(k, 0.0) for k in range(8))
    assert all(contacts(k, -0.035) for k in range(8))
    for k in range(4, 8):  # on a slope, as low as nothing touches
        qpos[k, :2] += SLOPE
        while contacts(k, 0.0):
            qpos[k, 2] += 0.01
    places = states.task["places"].at[4:].add(SLOPE)
    physics = states.physics.replace(qpos=jnp.float32(qpos))
    states = states.replace(physics=physics, task=states.task | {"places": places})
    for _ in range(10):
        states = step(states, jnp.zeros((8, made.action_size)))
    parted = []
    for k, one in enumerate(data):
        contacts(k, 0.0)
        mujoco.mj_step(other, one, 50)
        parted.append(np.abs(one.qpos[:3] - states.physics.qpos[k, :3]))
    assert np.median(parted, axis=0).max() < 0.005 and np.max(parted) < 0.025
    assert not np.asarray(states.terminated).any()


@pytest.mark.slow
def test_a_states_reward_and_origin_are_dm_controls(env):
    made, reset, step = env
    states = step(reset(jax.random.split(jax.random.key(1), 8)), jnp.zeros((8, made.action_size)))
    walker = rodent.Rat()
    task = escape.Escape(walker, dm_bowl.Bowl(), physics_timestep=0.001, control_timestep=0.02)
    physics = mjcf.Physics.from_mjcf_model(task.root_entity.mjcf_model)
    offset = walker.root_body.pos.copy()
    for k in range(8):
        qpos = np.asarray(states.physics.qpos[k], float)
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, offset, qpos[3:7])
        with physics.reset_context():
            physics.data.qpos[:] = [*(qpos[:3] - turned), *qpos[3:]]
        assert float(states.reward[k]) == pytest.approx(task.get_reward(physics), abs=1e-5)
        torso = physics.named.data.xmat["walker/torso"].reshape(3, 3)
        origin = -physics.named.data.xpos["walker/torso"] @ torso
        told = states.observation["policy"][k, -3:]
        np.testing.assert_allclose(told, origin, atol=1e-5)


@pytest.mark.slow
def test_eyes_see_the_terrain(env):
    made, reset, _ = env
    states = reset(jax.random.split(jax.random.key(2), 8))
    pictures = np.asarray(states.observation["eyes"], int)
    assert pictures.shape == (8, 1, 8, 8) and pictures.std(axis=(1, 2, 3)).min() > 5
    assert states.observation["privileged"].shape == (8, 40)
    assert find(made.parts.looks, "geom", "terrain") >= 0
    assert made.parts.model.nhfield == 0 and PREFIX == "walker/"


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["jax", "warp"])
def test_engines_have_a_ground_of_their_own_in_each_simulation(engine):
    """A step of two ants that lie in different bowls."""
    if engine == "warp":
        pytest.importorskip("warp")
    one = escape_bowl.build(escape_bowl.Options(body="ant"), "c")
    state = quick.jit(jax.vmap(one.reset))(jax.random.split(jax.random.key(0), 2))
    # At one place and in one pose: the bowls alone differ.
    state = state.replace(physics=jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), state.physics))
    step, action = quick.jit(jax.vmap(one.step)), jnp.zeros((2, one.action_size))
    for _ in range(40):
        state = step(state, action)
    other = escape_bowl.build(escape_bowl.Options(body="ant"), engine)
    right, found = step(state, action), quick.jit(jax.vmap(other.step))(state, action)
    np.testing.assert_allclose(found.physics.qpos, right.physics.qpos, atol=1e-4)
    assert np.abs(np.diff(right.physics.qpos, axis=0)).max() > 0.01
    assert np.abs(right.physics.qvel[:, 2]).max() < 1.0  # on the ground, not falling
