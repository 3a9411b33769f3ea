"""Engines behind `Physics`: what they promise, against MuJoCo itself and against each other."""

import copy
import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dm_control import suite

from purerl import exact
from purerl.envs import run
from purerl.exact.traces import equations
from purerl.physics import lookup
from purerl.physics.changes import CHANGEABLE_FIELDS
from purerl.physics.interface import READINGS, Physics, choose_engine
from tests import quick

# Two legs that touch a floor, a ball, a tendon, a filtered motor, a mocap body and sensors.
XML = """
<mujoco>
  <option timestep="0.004" cone="pyramidal" iterations="50" ls_iterations="50"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="target" mocap="true" pos="1 2 3"><site name="goal"/></body>
    <body name="trunk" pos="0 0 0.6">
      <freejoint name="root"/>
      <geom name="trunk" type="sphere" size="0.1"/>
      <site name="eye" pos="0.1 0 0"/>
      <body name="left" pos="0 0.1 0">
        <joint name="left" type="hinge" axis="0 1 0" damping="0.5" range="-1 1" limited="true"/>
        <geom name="left" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04"/>
      </body>
      <body name="right" pos="0 -0.1 0">
        <joint name="right" type="hinge" axis="0 1 0" damping="0.5"/>
        <geom name="right" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed>
  </tendon>
  <actuator>
    <motor name="left" joint="left" gear="5" ctrllimited="true" ctrlrange="-1 3"/>
    <general name="right" joint="right" dyntype="filter" dynprm="0.05" gainprm="5"
      ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <framepos name="eye" objtype="site" objname="eye"/>
    <gyro name="gyro" site="eye"/>
    <accelerometer name="acceleration" site="eye"/>
    <subtreelinvel name="velocity" body="trunk"/>
  </sensor>
</mujoco>
"""
NUMBER, STEPS = 4, 10


@functools.cache
def biped(disable=0):
    model = mujoco.MjModel.from_xml_string(XML)
    model.opt.disableflags |= disable
    return model


@functools.cache
def physics(engine):
    return Physics(biped(), READINGS, substeps=3, engine=engine)


def starts(number, model):
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (number, 1))
    qpos[:, 7:] += rng.uniform(-0.3, 0.3, qpos[:, 7:].shape)
    return jnp.float32(qpos), jnp.float32(rng.uniform(-0.5, 0.5, (number, model.nv)))


@functools.cache
def compiled(engine):
    """One program an engine, shared by all tests: compiling MJX takes most of their time."""
    p = physics(engine)
    return quick.jit(jax.vmap(p.init)), quick.jit(jax.vmap(p.step))


@functools.cache
def trajectory(engine):
    """Returns first readings [B], states [T, B], readings [T, B], and the controls [T, B, nu]."""
    init, step = compiled(engine)
    controls = np.random.default_rng(1).uniform(-1, 1, (STEPS, NUMBER, biped().nu))
    controls = jnp.float32(controls)
    state, first = init(*starts(NUMBER, biped()))
    seen = []
    for control in controls:
        state, readings = step(state, control)
        seen.append((state, readings))
    # By numpy: JAX would compile it for each shape.
    states, readings = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *seen)
    return first, states, readings, controls


@pytest.mark.slow
@pytest.mark.parametrize("cores", [{0}, {0, 7}])
def test_c_has_a_thread_for_each_core_that_it_may_use_and_the_same_bits(monkeypatch, cores):
    """A job on a cluster may use a few of many, and MuJoCo by itself takes all."""
    _, states, _, controls = trajectory("c")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: cores)
    p = Physics(copy.copy(biped()), READINGS, substeps=3, engine="c")
    state, _ = jax.vmap(p.init)(*starts(NUMBER, biped()))
    assert p._engine.rows_of(NUMBER, (), ())[0].nthread == len(cores)
    for control, *expected in zip(controls, *jax.tree.leaves(states), strict=True):
        state, _ = jax.vmap(p.step)(state, control)
        jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(state), expected)


def test_c_is_mujoco_with_its_state_rounded_at_control_steps():
    first, states, readings, controls = trajectory("c")
    model, data = biped(), mujoco.MjData(biped())
    qpos, qvel = starts(NUMBER, model)
    data.qpos, data.qvel = qpos[1], qvel[1]
    mujoco.mj_forward(model, data)
    np.testing.assert_array_equal(first.xpos[1], np.float32(data.xpos))
    np.testing.assert_array_equal(first.sensordata[1], np.float32(data.sensordata))
    data.qacc_warmstart = 0
    for t, control in enumerate(controls[:, 1]):
        for name in ("qpos", "qvel", "act", "qacc_warmstart"):
            getattr(data, name)[:] = np.float32(getattr(data, name))
        data.ctrl = control
        mujoco.mj_step(model, data, 3)
        mujoco.mj_step1(model, data)  # positions and velocities are those of the state returned
        np.testing.assert_array_equal(states.qpos[t, 1], np.float32(data.qpos))
        np.testing.assert_array_equal(states.act[t, 1], np.float32(data.act))
        for name in ("xpos", "cvel", "subtree_com", "actuator_force", "sensordata"):
            expected = np.float32(getattr(data, name))
            np.testing.assert_array_equal(getattr(readings, name)[t, 1], expected, err_msg=name)


@pytest.mark.slow
def test_engines_agree_on_every_reading():
    a, b = trajectory("c"), trajectory("jax")
    assert a[2]._fields == b[2]._fields == READINGS
    for name in READINGS:
        for x, y in (
            (getattr(a[0], name), getattr(b[0], name)),
            (getattr(a[2], name), getattr(b[2], name)),
        ):
            assert (x.shape, x.dtype) == (y.shape, y.dtype), name
            scale = max(1.0, np.abs(x).max(initial=0.0))
            np.testing.assert_allclose(x / scale, y / scale, atol=2e-3, err_msg=name)
    for x, y in zip(jax.tree.leaves(a[1]), jax.tree.leaves(b[1]), strict=True):
        scale = max(1.0, np.abs(x).max(initial=0.0))
        np.testing.assert_allclose(x / scale, y / scale, atol=2e-3)


def test_a_velocity_is_current_whatever_else_is_read():
    """Together with others a reading may be current only because another one asked for it."""
    model = biped()
    for name in ("cvel", "qfrc_bias", "actuator_velocity"):
        p = Physics(model, (name,), substeps=3, engine="c")
        state, _ = p.init(*(x[0] for x in starts(1, model)))
        state, readings = p.step(state, jnp.ones(model.nu))
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.act = state.qpos, state.qvel, state.act
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(getattr(readings, name), getattr(data, name), 1e-3, 1e-4)


def test_the_fields_that_may_change_are_those_that_mjx_traces():
    from mujoco.batch import MODEL_FIELDS
    from mujoco.mjx._src.types import Model

    floats = {name for name, kind in Model.__annotations__.items() if kind is jax.Array}
    integers = {"geom_matid", "light_type", "light_active", "light_castshadow", "mat_texid"}
    assert set(CHANGEABLE_FIELDS) == (floats & set(MODEL_FIELDS)) - integers


@pytest.mark.parametrize("engine", ["c", "jax"])
def test_mjx_is_imported_by_its_engine_alone_and_quietly(engine):
    code = f"""
import sys, mujoco, numpy as np
from purerl.physics.interface import Physics
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><freejoint/><geom size='.1'/>"
    "</body></worldbody></mujoco>")
physics = Physics(model, ("xpos",), engine="{engine}")
physics.check_changes({{"geom_friction": np.ones((1, 3))}})
assert ("mujoco.mjx" in sys.modules) == ("{engine}" == "jax") and "warp" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert "Failed to import" not in done.stderr


def test_batching_changes_no_bit_on_c():
    p = physics("c")
    qpos, qvel = starts(6, p.model)
    init = jax.jit(lambda q, v: p.init(q, v))
    flat = jax.jit(jax.vmap(p.init))(qpos, qvel)
    nested = jax.jit(jax.vmap(jax.vmap(p.init)))(qpos.reshape(2, 3, -1), qvel.reshape(2, 3, -1))
    flat, nested = jax.device_get((flat, nested))
    for i in range(6):
        one = init(qpos[i], qvel[i])
        for x, y, z in zip(*map(jax.tree.leaves, (one, flat, nested)), strict=True):
            np.testing.assert_array_equal(x, y[i])
            np.testing.assert_array_equal(x, z[i // 3, i % 3])


@pytest.mark.parametrize("engine", ["c", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_blow_up_is_nan_and_touches_no_other(engine):
    step = compiled(engine)[1]
    state = jax.tree.map(lambda x: x[0], trajectory("c")[1])
    ctrl = jnp.zeros((NUMBER, biped().nu))
    good = step(state, ctrl)
    bad = step(state.replace(qpos=state.qpos.at[2, 0].set(jnp.nan)), ctrl)
    for x, y in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
        keep = np.array([0, 1, 3])
        np.testing.assert_array_equal(x[keep], y[keep])
    assert np.isnan(bad[0].qpos[2, 0]) and np.isnan(bad[1].xpos[2]).any()
    nan_control = step(state, ctrl.at[1].set(jnp.nan))
    assert np.isnan(nan_control[0].qvel[1]).any() and np.isfinite(nan_control[0].qvel[0]).all()


def test_a_silent_reset_of_mujoco_is_nan_on_c():
    """MuJoCo answers a blow-up with a warning, and resets the simulation to a healthy start."""
    p = physics("c")
    state, _ = p.init(*(x[0] for x in starts(1, p.model)))
    after, readings = p.step(state.replace(qvel=state.qvel.at[7].set(1e20)), jnp.zeros(2))
    for leaf in jax.tree.leaves((after, readings)):
        assert np.isnan(leaf).all()


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["c", "jax"])
def test_changes_are_each_environments_own(engine):
    p = Physics(biped(), ("geom_xpos",), substeps=1, engine=engine)
    changed = biped().geom_pos.copy()
    changed[1] += (0.0, 0.0, 0.3)
    both = {"geom_pos": jnp.float32(np.stack([biped().geom_pos, changed]))}
    qpos, qvel = starts(1, p.model)
    qpos, qvel = jnp.tile(qpos, (2, 1)), jnp.zeros((2, p.model.nv))
    state, _ = quick.jit(jax.vmap(physics("c").init))(qpos, qvel)
    _, readings = quick.jit(jax.vmap(p.step))(state, jnp.zeros((2, p.model.nu)), both)
    lifted = readings.geom_xpos[1] - readings.geom_xpos[0]
    np.testing.assert_allclose(lifted[1], (0.0, 0.0, 0.3), atol=1e-3)
    np.testing.assert_allclose(lifted[2:], 0.0, atol=1e-3)
    if engine == "c":  # what one call changed must not stay for the next
        plain, _ = quick.jit(jax.vmap(p.step))(state, jnp.zeros((2, p.model.nu)))
        np.testing.assert_array_equal(plain.qpos[0], plain.qpos[1])


def pedestal(x, extra=""):
    """Four boxes, of which one at x, and a body of four geoms that falls from above the origin."""
    return mujoco.MjModel.from_xml_string(f"""<mujoco>{extra}<worldbody>
      <geom name="pedestal" type="box" size=".3 .3 .1" pos="{x} 0 .1"/>
      <geom type="box" size=".3 .3 .1" pos="4 0 .1"/>
      <geom type="box" size=".3 .3 .1" pos="4 2 .1"/>
      <geom type="box" size=".3 .3 .1" pos="4 -2 .1"/>
      <body pos="0 0 .4"><freejoint/>
        <geom type="capsule" size=".05" fromto="-.2 0 0 .2 0 0"/>
        <geom type="capsule" size=".05" fromto="0 -.2 0 0 .2 0"/>
        <geom type="sphere" size=".06" pos=".2 0 0"/>
        <geom type="sphere" size=".06" pos="-.2 0 0"/>
      </body></worldbody></mujoco>""")


def fall(model, changes):
    """Height [m] of the body after 1 s on `c`."""
    physics = Physics(model, (), 500, "c")
    state, _ = physics.init(model.qpos0, jnp.zeros(model.nv), changes)
    return float(physics.step(state, jnp.zeros(0), changes)[0].qpos[2])


def test_a_geom_that_changes_put_somewhere_is_touched_there():
    away = pedestal(-4.0)
    moved = {"geom_pos": jnp.float32(away.geom_pos).at[away.geom("pedestal").id, 0].set(0.0)}
    assert fall(pedestal(0.0), None) == pytest.approx(0.26, abs=0.01)
    assert fall(away, moved) == pytest.approx(0.26, abs=0.01)
    assert fall(away, None) < 0.0


def test_a_mocap_body_starts_where_changes_put_it():
    bodies = "<body mocap='true' pos='1 0 0'/><body mocap='true'/>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    physics = Physics(model, (), 1, "c")
    changes = {"body_pos": jnp.float32(model.body_pos).at[2].set(jnp.arange(3.0))}
    state, _ = physics.init(jnp.zeros(0), jnp.zeros(0), changes)
    np.testing.assert_array_equal(state.mocap_pos, [[1, 0, 0], [0, 1, 2]])


HINGE = """<mujoco>{0}<worldbody><body><joint type="hinge" axis="0 1 0" {1}/>
  <geom type="capsule" size=".05" fromto="0 0 0 .5 0 0"/></body></worldbody></mujoco>"""


def test_a_sensor_of_energy_reads_its_own_simulation():
    """With the bit `energy` MuJoCo's batch would read that of the simulation before."""
    text = HINGE.format("<option><flag energy='enable'/></option>", "")
    text = text.replace("</mujoco>", "<sensor><e_kinetic/></sensor></mujoco>")
    physics = Physics(mujoco.MjModel.from_xml_string(text), ("sensordata",), 1, "c")
    both = jax.vmap(physics.init)(jnp.zeros((9, 1)), jnp.arange(1.0, 10.0)[:, None])[1].sensordata
    np.testing.assert_allclose(both[:, 0] / both[0, 0], np.arange(1.0, 10.0) ** 2, rtol=1e-5)


def test_what_mjx_refuses_is_a_value_error():
    shapes = "<geom type='cylinder' size='.1 .1'/>", "<geom type='box' size='.1 .1 .1'/>"
    bodies = "".join(f"<body><freejoint/>{shape}</body>" for shape in shapes)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(ValueError, match="MJX cannot simulate this model.*CYLINDER"):
        Physics(model, (), 1, "jax")


@pytest.mark.parametrize(
    ("engine", "field"),
    [("c", "body_gravcomp"), ("jax", "dof_frictionloss"), ("jax", "dof_dampingpoly")],
)
def test_changes_that_would_do_nothing_are_refused(engine, field):
    model = mujoco.MjModel.from_xml_string(HINGE.format("", ""))
    changes = {field: jnp.ones(getattr(model, field).shape)}
    with pytest.raises(ValueError, match=f"{field}.*nothing"):
        Physics(model, (), 1, engine).init(jnp.zeros(1), jnp.zeros(1), changes)


def test_wrong_names_and_shapes_are_explained():
    with pytest.raises(ValueError, match="engine 'cpu'.*There are: auto, c, jax, warp"):
        choose_engine("cpu")
    with pytest.raises(ValueError, match="reading 'xpoz'. Did you mean 'xpos'"):
        Physics(biped(), ("xpoz",), engine="c")
    with pytest.raises(ValueError, match="sensors, and the model has them disabled"):
        off = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        Physics(biped(off), ("sensordata",), engine="c")
    with pytest.raises(ValueError, match="add one of accelerometer"):
        Physics(suite.load("cartpole", "swingup").physics.model.ptr, ("cfrc_ext",), engine="c")
    p = physics("c")
    qpos, qvel = (x[0] for x in starts(1, p.model))
    with pytest.raises(ValueError, match="Did you mean 'geom_friction'"):
        p.init(qpos, qvel, {"geom_frictions": qpos})
    with pytest.raises(ValueError, match=r"changes\['body_mass'\] has shape \(3,\).* \(5,\)"):
        p.init(qpos, qvel, {"body_mass": jnp.ones(3)})
    with pytest.raises(ValueError, match=r"qvel has shape \(9,\)"):
        p.init(qpos, qpos, {})


def test_an_engine_that_is_not_installed_is_told_how_to_be(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs .* \(python -m pip install .*'\.\[warp\]'"):
        choose_engine("warp")


def test_look_ups_by_name():
    model = biped()
    assert lookup.find(model, "body", "left") == 3
    np.testing.assert_array_equal(lookup.qpos_indices(model, ["right", "root"]), [8, *range(7)])
    np.testing.assert_array_equal(lookup.qvel_indices(model, ["right", "root"]), [7, *range(6)])
    assert lookup.sensor_slice(model, "gyro") == slice(3, 6)
    with pytest.raises(ValueError, match="no joint 'lefft'. Did you mean 'left'.* root, left"):
        lookup.find(model, "joint", "lefft")
    ctrl = lookup.scale_action(model, jnp.array([0.0, -1.0]))
    np.testing.assert_allclose(ctrl, [1.0, -1.0])


@functools.cache
def engine_for(model, readings):
    """Returns engine `jax`, which takes seconds to be made, and arguments of its step."""
    p = Physics(model, readings, substeps=2, engine="jax")
    p_c = Physics(model, (), substeps=2, engine="c")
    state, _ = jax.eval_shape(p_c.init, model.qpos0, np.zeros(model.nv))
    return p._engine, (state, jnp.zeros(model.nu, jnp.float32), {})


@functools.cache
def step_trace(model, rewritten, readings=("xpos", "subtree_com", "cvel")):
    engine, arguments = engine_for(model, readings)
    return jax.make_jaxpr(engine.step if rewritten else engine.plain_step)(*arguments)


FORCES = ("cfrc_ext", "sensordata", "ten_length", "qfrc_actuator")


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_no_scatter_sum_is_left_in_a_humanoid(jacobian):
    model = suite.load("humanoid", "run").physics.model.ptr
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.jacobian = {"dense": 0, "sparse": 1}[jacobian]
    assert len(exact.unordered_in(step_trace(model, rewritten=False))) > 20
    assert not exact.unordered_in(step_trace(model, rewritten=True))


@pytest.mark.nightly
def test_no_scatter_sum_is_left_in_a_rodent():
    """70 s. Nor in an ant: `test_manifest.py` looks at a whole update of one."""
    env = run.build(run.Options(body="rodent"), engine="jax")
    assert not exact.unordered_in(step_trace(env.physics.model, True, run.READINGS))


def test_no_scatter_sum_is_left_in_a_cartpole():
    model = suite.load("cartpole", "swingup").physics.model.ptr
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)  # MJX has none
    assert not exact.unordered_in(step_trace(model, rewritten=True))


@pytest.mark.slow
def test_no_scatter_sum_is_left_with_forces_and_sensors():
    assert exact.unordered_in(step_trace(biped(), False, FORCES))
    assert not exact.unordered_in(step_trace(biped(), True, FORCES))


@pytest.mark.slow
def test_rewriting_changes_no_number_of_mjx():
    p = physics("jax")
    state = jax.tree.map(lambda x: x[-1], trajectory("c")[1])
    ctrl = jnp.full((NUMBER, 2), 0.5)
    rewritten = compiled("jax")[1](state, ctrl)
    plain = quick.jit(jax.vmap(lambda s, u: p._engine.plain_step(s, u, {})))(state, ctrl)
    for x, y in zip(*map(jax.tree.leaves, (rewritten, plain)), strict=True):
        scale = max(1.0, np.abs(y).max(initial=0.0))
        np.testing.assert_allclose(x / scale, y / scale, atol=1e-5)


def products(closed):
    """Returns the precision of every matrix product in a trace, at any depth."""
    dots = [e for e in equations(closed) if e.primitive.name == "dot_general"]
    return [e.params["precision"] for e in dots]


def test_physics_multiplies_matrices_in_whole_float32():
    """By default a GPU would round their factors to 10 bits; a CPU shows no difference."""
    found = products(step_trace(biped(), True, FORCES))
    assert len(found) > 5
    assert set(found) == {(jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)}
