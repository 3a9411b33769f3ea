"""The `warp` engine, on a CPU: MJX-Warp runs the same kernels there, slowly and exactly."""

import copy
import dataclasses
import functools
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.envs import run
from purerl.physics.interface import (
    READINGS,
    Physics,
    choose_engine,
    overflow_metric,
    overflow_reading,
)
from purerl.runs import manifest
from tests.physics.test_interface import NUMBER, biped, compiled, starts, trajectory

pytest.importorskip("warp", reason="engine 'warp' needs warp-lang: pip install -e '.[warp]'")

import warp  # noqa: E402

from purerl.checks.check_env import check_env  # noqa: E402
from purerl.physics import engine_warp, warp_buffers  # noqa: E402

pytestmark = pytest.mark.slow


def same(first, second):
    """Asserts equal bits, whatever the leading axes."""
    for x, y in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(np.reshape(x, np.shape(y)), y)


def relative_error(value, expected):
    """Returns the error of rows [B, n], over the largest number of each row, [B]."""
    scale = np.maximum(1.0, np.abs(expected).max(axis=-1))
    return np.abs(np.asarray(value) - np.asarray(expected)).max(axis=-1) / scale


@functools.cache
def running():
    """Returns a batch of bipeds at the end of the `c` engine's trajectory, and controls."""
    return jax.tree.map(lambda x: x[-1], trajectory("c")[1]), jnp.full((NUMBER, 2), 0.5)


def test_it_agrees_with_mujoco_on_every_reading():
    a, b = trajectory("c"), trajectory("warp")
    assert a[2]._fields == b[2]._fields == READINGS
    for x, y in zip(jax.tree.leaves(a[:3]), jax.tree.leaves(b[:3]), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        scale = max(1.0, np.abs(x).max(initial=0.0))
        np.testing.assert_allclose(x / scale, y / scale, atol=1e-4)


def test_readings_of_bodies_are_those_of_a_whole_forward_pass():
    p, (state, ctrl) = Physics(biped(), engine_warp._OF_BODIES, 3, "warp"), running()
    assert p._engine.make_current is engine_warp._bodies
    found, expected = jax.jit(jax.vmap(p.step))(state, ctrl), compiled("warp")[1](state, ctrl)
    same(found[0], expected[0])
    same(found[1], [getattr(expected[1], name) for name in engine_warp._OF_BODIES])
    for others in (("cvel",), ("sensordata",), ("xpos", "ten_length")):
        assert Physics(biped(), others, 3, "warp")._engine.make_current is engine_warp._forward


def test_an_ant_meets_the_platforms_of_its_own_corridor_as_in_mujoco():
    """Among its geoms are some that no joint moves and whose place `changes` say."""
    options = run.Options(arena="gaps")
    c, warp = (run.build(options, engine) for engine in ("c", "warp"))
    state = jax.jit(jax.vmap(c.reset))(jax.random.split(jax.random.key(3), 6))
    step_c, step_warp = (
        jax.jit(jax.vmap(lambda p, u, s, env=env: env.physics.step(p, u, env.model_changes(s))))
        for env in (c, warp)
    )
    step, errors = jax.jit(jax.vmap(c.step)), []
    for t in range(12):
        action = jax.random.uniform(jax.random.key(t), (6, 8), minval=-1.0)
        expected, readings = step_c(state.physics, action, state)
        found, seen = step_warp(state.physics, action, state)
        errors.append(relative_error(found.qvel, expected.qvel))
        assert relative_error(seen.actuator_force, readings.actuator_force).max() < 1e-4
        assert not seen.overflow.any()
        state = step(state, action)
    assert np.max(errors) < 1e-4


def test_however_it_is_batched_the_bits_are_the_same():
    p, (state, ctrl) = Physics(biped(), READINGS, substeps=3, engine="warp"), running()
    flat = compiled("warp")[1](state, ctrl)
    split = jax.tree.map(lambda x: x.reshape(2, NUMBER // 2, *x.shape[1:]), (state, ctrl))
    same(jax.jit(jax.vmap(jax.vmap(p.step)))(*split), flat)
    same(jax.jit(jax.vmap(p.step, (0, None)))(state, ctrl[0]), flat)
    one = jax.jit(p.step)(*jax.tree.map(lambda x: x[1], (state, ctrl)))
    same(one, jax.tree.map(lambda x: x[1], flat))


def test_a_blow_up_is_nan_and_touches_no_other():
    step, (state, ctrl) = compiled("warp")[1], running()
    good, keep = step(state, ctrl), np.array([0, 1, 3])
    for bad in (
        step(state.replace(qpos=state.qpos.at[2, 0].set(jnp.nan)), ctrl),
        step(state.replace(qvel=state.qvel.at[2, 7].set(1e20)), ctrl),
        step(state, ctrl.at[2].set(jnp.nan)),
    ):
        same(*(jax.tree.map(lambda x: x[keep], both) for both in (bad, good)))
        assert np.isnan(bad[0].qvel[2]).any()
    assert all(np.isnan(x[2]).all() for x in jax.tree.leaves(bad))  # and so are its readings


# What no kernel writes: it is given, or constant.
CONSTANT = {"qfrc_applied", "xfrc_applied", "eq_active", "geom_xpos", "geom_xmat"}
CONSTANT |= {"xpos", "xquat", "xipos", "xmat", "ximat"}  # the world's


def poison(data):
    """Makes all numbers NaN that MJX-Warp keeps from one call to the next."""
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        if dataclasses.is_dataclass(value):
            poison(value)
        elif isinstance(value, warp.array) and value.size and field.name not in CONSTANT:
            numbers = value.numpy()
            value.assign(np.full_like(numbers, np.nan) if numbers.dtype == np.float32 else numbers)


@pytest.mark.parametrize("jacobian", ["DENSE", "SPARSE"])
def test_a_call_leaves_nothing_to_the_next(jacobian):
    model = copy.copy(biped())
    model.opt.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{jacobian}")
    p, (_, state, ctrl) = Physics(model, READINGS, 2, "warp"), crouching("c")
    init, step = jax.jit(jax.vmap(p.init)), jax.jit(jax.vmap(p.step))
    first = init(state.qpos, state.qvel), step(state, ctrl)
    assert jnp.isfinite(first[1][0].qpos).all()
    (batch,) = p._engine.batches.values()
    assert batch.model.is_sparse == (jacobian == "SPARSE")
    poison(batch.data)
    same(step(state, ctrl), first[1])
    poison(batch.data)
    same(init(state.qpos, state.qvel), first[0])
    step(state.replace(qpos=state.qpos.at[:, 2].set(-jnp.inf)), ctrl)
    same(step(state, ctrl), first[1])


def test_what_found_no_room_is_not_told_again(monkeypatch):
    monkeypatch.setattr(warp_buffers, "MOST_ROWS", 3)
    step, state, ctrl = crouching("warp", overflow_reading("warp"))
    assert step(state, ctrl)[1].overflow.sum() == 3
    high = jax.tree.map(lambda x: jnp.stack([x[3]] * NUMBER), state)
    assert not step(high, ctrl)[1].overflow.any()


def test_without_memory_it_says_how_to_get_some(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("Failed to allocate")

    monkeypatch.setattr(warp_buffers.mjw, "make_data", refuse)
    with pytest.raises(RuntimeError, match="64 simulations .* XLA_PYTHON_CLIENT_MEM_FRACTION"):
        warp_buffers.Batch(biped(), 64, 8, 64, ())


def test_a_sum_with_the_damping_of_actuators_is_not_changed():
    model = copy.copy(biped())
    p, (state, ctrl) = Physics(model, (), 2, "warp"), running()
    one = jax.tree.map(lambda x: x[0], state)
    p.step(one, ctrl[0], {"dof_damping": jnp.float32(model.dof_damping)})
    model.actuator_damping[0] = 1.0
    with pytest.raises(ValueError, match="'dof_damping'.* use engine 'c'"):
        Physics(model, (), 2, "warp").step(one, ctrl[0], {"dof_damping": model.dof_damping})


def test_a_program_has_the_same_text_whenever_it_is_traced():
    p, (state, ctrl) = Physics(biped(), READINGS, 2, "warp"), running()
    texts = [jax.jit(jax.vmap(p.step)).lower(state, ctrl).as_text() for _ in range(2)]
    assert texts[0] == texts[1] and "call_id = 0" in texts[0]


def test_a_field_of_another_size_than_expected_is_refused():
    batch = warp_buffers.Batch(biped(), 2, 8, 64, ())
    with pytest.raises(ValueError, match="keeps 'qvel' in .* not in 12: this version"):
        batch.call("step", (), ("qvel",), (warp.zeros(3),))


def crouching(engine, readings=()):
    """Returns a step of bipeds whose feet are in the floor, and what to give it."""
    p = Physics(biped(), readings, substeps=2, engine=engine)
    qpos, qvel = starts(NUMBER, biped())
    qpos = qpos.at[:, 2].set(jnp.array([0.35, 0.4, 0.42, 2.0]))
    state, _ = jax.jit(jax.vmap(Physics(biped(), (), 2, "c").init))(qpos, qvel)
    return jax.jit(jax.vmap(p.step)), state, jnp.zeros((NUMBER, 2))


def test_contacts_agree_with_mujoco():
    (step_c, state, ctrl), (step_warp, *_) = crouching("c"), crouching("warp")
    expected, found = step_c(state, ctrl)[0], step_warp(state, ctrl)[0]
    assert (jnp.abs(expected.qvel - state.qvel)[:3].max(axis=1) > 1.0).all(), "nothing was hit"
    assert relative_error(found.qvel, expected.qvel).max() < 1e-3


@pytest.mark.parametrize(("limit", "lost"), [("MOST_ROWS", [1, 1, 1, 0]), ("contacts", [1] * 4)])
def test_what_finds_no_room_is_told(monkeypatch, limit, lost):
    """Rows of constraints are each simulation's own; all share the room for contacts."""
    if limit == "MOST_ROWS":
        monkeypatch.setattr(warp_buffers, "MOST_ROWS", 3)
    else:
        monkeypatch.setattr(engine_warp, "room", lambda *_: (1, 64))
        monkeypatch.setattr(warp_buffers, "MOST_CONTACTS", 1)
    step, state, ctrl = crouching("warp", overflow_reading("warp"))
    after, readings = step(state, ctrl)
    np.testing.assert_array_equal(overflow_metric(readings)["overflow_count"], lost)
    assert np.isfinite(after.qpos).all()
    step, state, ctrl = crouching("warp")  # without the reading
    np.testing.assert_array_equal(np.isnan(step(state, ctrl)[0].qpos).any(axis=1), lost)


def test_room_is_what_the_model_can_need():
    """An ant: 12 capsules with two points each and a ball, 4 rows a contact; 8 limits; 14 dofs."""
    env = run.build(run.Options(), "warp")
    contacts, rows = env.physics._engine.contacts, env.physics._engine.rows
    assert contacts == 25
    assert 25 * 4 + 8 <= rows <= 25 * 4 + 8 + 14 + 16
    assert set(env.step(env.reset(jax.random.key(0)), jnp.zeros(8)).metrics) >= {"overflow_count"}
    assert overflow_reading("c") == overflow_reading("jax") == ()


@pytest.mark.parametrize("name", ["geom_friction", "body_mass", "jnt_range"])
def test_a_changed_field_is_each_simulations_own(name):
    own = jnp.float32(getattr(biped(), name))
    _, state, ctrl = crouching("c")
    state = jax.tree.map(lambda x: jnp.stack([x[1], x[1]]), state)
    results = {}
    for engine in ("c", "warp"):
        p = Physics(biped(), (), substeps=2, engine=engine)
        step = jax.jit(jax.vmap(lambda s, u, v, p=p: p.step(s, u, p.derive({name: v}))[0].qvel))
        results[engine] = step(state, ctrl[:2], jnp.stack([own, 1.5 * own]))
    assert relative_error(results["warp"], results["c"]).max() < 1e-4
    assert relative_error(results["c"][:1], results["c"][1:]).max() > 2e-3, "it has no effect"


NESTED = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body pos="1 0 0" euler="0 0.2 0"><body pos="0 1 0" euler="0.3 0 0">
    <geom type="box" size="0.1 0.1 0.1" pos="0 0 1" euler="0 0 0.4"/>
  </body></body>
  <body pos="0 0 1"><freejoint/><geom size="0.1" pos="0.1 0 0"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize("changed", [("geom_pos", "geom_quat"), ("body_pos", "body_quat")])
def test_geoms_go_where_changes_say_though_no_joint_moves_them(changed):
    model, rng = mujoco.MjModel.from_xml_string(NESTED), np.random.default_rng(0)
    changes = {}
    for name in changed:
        value = np.float32(getattr(model, name))
        value[1:] += rng.uniform(-0.3, 0.3, value[1:].shape)  # the world's own frame stays
        size = np.linalg.norm(value, axis=1, keepdims=True)
        changes[name] = value / size if name.endswith("quat") else value
    found, plain = {}, None
    for engine in ("c", "warp"):
        p = Physics(model, ("geom_xpos", "geom_xmat"), 1, engine)
        found[engine] = p.init(model.qpos0, np.zeros(model.nv), changes)[1]
        plain = p.init(model.qpos0, np.zeros(model.nv))[1]
    for x, y, z in zip(found["warp"], found["c"], plain, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
        assert (jnp.abs(x - z).max(axis=-1)[1:] > 0.01).any()


def test_a_field_that_it_never_reads_is_refused_by_name():
    p, (state, ctrl) = Physics(biped(), (), engine="warp"), running()
    one = jax.tree.map(lambda x: x[0], state)
    with pytest.raises(ValueError, match="can change on engine 'warp' 'dof_M0'"):
        p.step(one, ctrl[0], {"dof_M0": jnp.ones(biped().nv)})
    with pytest.raises(ValueError, match="reading 'overflow'"):
        Physics(biped(), ("overflow",), engine="jax")


@pytest.mark.parametrize("arena", ["floor", "gaps"])
def test_an_ant_keeps_to_the_protocol(arena):
    check_env(run.build(run.Options(arena=arena), "warp"), num_envs=2, num_steps=1)


def test_a_run_is_not_exact_and_says_of_which_version():
    facts = manifest.describe_process("warp", [])
    assert facts["versions"]["warp-lang"] and not facts["bit_exact"]
    assert "warp-lang" not in manifest.describe_process("c", [])["versions"]


def test_it_is_never_chosen_by_itself():
    assert choose_engine("auto") == "c" and choose_engine("warp") == "warp"
    assert importlib.util.find_spec("warp")
