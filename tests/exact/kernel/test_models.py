"""Control steps of MJX as kernels, against XLA's, on states that XLA has reached."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import exact
from purerl.exact.kernel import compilers, compiling
from purerl.physics.engine_mjx import mjx_defaults
from purerl.physics.interface import Physics
from tests import quick
from tests.exact.kernel import by_one_lane, by_warps, needs_compiler, rows

N = 4  # environments


@pytest.fixture
def kernels_are_compiled_quickly(monkeypatch):
    """g++ takes ten times as long to make a body's kernel faster as to make it at all."""
    monkeypatch.setattr(compilers, "CPU_WORDS", [*compilers.CPU_WORDS, "-O0"])


PENDULUM = """
<mujoco>
  <worldbody>
    <body><joint name="j" axis="0 1 0" damping="0.1"/><geom size="0.1" pos="0 0 -0.5"/></body>
  </worldbody>
  <actuator><motor joint="j"/></actuator>
  <sensor><jointpos joint="j"/></sensor>
</mujoco>
"""
# Equalities, frictions, limits and springs, a tendon, a muscle, a servo, sensors of all stages.
ARM = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" iterations="3" ls_iterations="5"/>
  <worldbody>
    <geom type="plane" size="2 2 1"/>
    <body name="fixed" pos="0 0 0.5">
      <joint name="a" axis="0 1 0" frictionloss="0.1" limited="true" range="-20 20"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0 0"/>
      <body pos="0.3 0 0">
        <joint name="b" axis="0 1 0" stiffness="2" damping="0.2" armature="0.01"/>
        <joint name="c" axis="0 0 1"/>
        <geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0"/>
        <body name="hand" pos="0.3 0 0">
          <joint name="d" axis="0 1 0"/><geom size="0.05"/><site name="tip" size="0.06"/>
        </body>
      </body>
    </body>
    <body name="other" pos="0.4 0 0.12"><freejoint/><geom name="ball" size="0.1"/></body>
  </worldbody>
  <tendon>
    <fixed name="t" limited="true" range="-0.2 0.2" frictionloss="0.05" stiffness="1">
      <joint joint="b" coef="1"/><joint joint="d" coef="-0.5"/>
    </fixed>
  </tendon>
  <equality>
    <joint joint1="c" joint2="d" polycoef="0 0.5 0 0 0"/>
    <connect body1="hand" body2="other" anchor="0 0 0"/>
  </equality>
  <actuator>
    <position joint="a" kp="5"/><muscle joint="b" lengthrange="-1 1"/>
    <velocity name="v" joint="d" kv="0.2"/>
  </actuator>
  <sensor>
    <accelerometer site="tip"/><gyro site="tip"/><touch site="tip"/><subtreecom body="fixed"/>
    <framepos objtype="body" objname="hand"/><tendonpos tendon="t"/><actuatorfrc actuator="v"/>
  </sensor>
</mujoco>
"""
# Elliptic cones with all kinds of friction, a capsule that lies on a box, a mocap body.
HEAP = """
<mujoco>
  <option cone="elliptic" iterations="4" ls_iterations="6" impratio="2"/>
  <worldbody>
    <geom type="plane" size="2 2 1"/>
    <body name="box" pos="0 0 0.1" quat="1 0.02 0.03 0.1">
      <freejoint/><geom type="box" size="0.1 0.1 0.1" condim="4"/>
    </body>
    <body pos="0.02 0 0.249" quat="1 0.1 1 0">
      <freejoint/><geom type="capsule" size="0.05 0.1" condim="6"/>
    </body>
    <body name="hand" mocap="true" pos="0.3 0 0.3"/>
    <body name="held" pos="0.3 0 0.3"><freejoint/><geom type="sphere" size="0.05"/></body>
  </worldbody>
  <equality><weld body1="hand" body2="held"/></equality>
</mujoco>
"""
MODELS = {
    "pendulum": (PENDULUM, ("xpos", "sensordata"), 3, ()),
    "arm": (ARM, ("xpos", "sensordata", "qfrc_constraint"), 2, ("geom_friction", "body_mass")),
    "heap": (HEAP, ("cvel",), 2, ("geom_friction",)),
}


def stepping(physics):
    """Returns the engine's own control step, whose changed fields of the model are inputs."""

    @functools.partial(jax.jit, inline=True)  # traced once, for the kernel and for XLA
    def step(state, ctrl, changes):
        with mjx_defaults():
            return physics._engine.plain_step(state, ctrl, changes)

    return step


def start(physics, changed, seed=0):
    """Returns arguments of a step for N environments, each a bit otherwise."""
    rng, model = np.random.default_rng(seed), physics.model
    qpos = np.tile(model.qpos0, (N, 1)).astype(np.float32)
    qvel = (0.3 * rng.normal(size=(N, model.nv))).astype(np.float32)
    # A state is the same on every engine, and to begin one on `jax` is to compile half of a step.
    init = Physics(model, engine="c").init
    states = [init(jnp.asarray(p), jnp.asarray(v))[0] for p, v in zip(qpos, qvel, strict=True)]
    state = jax.tree.map(lambda *x: np.stack(x), *states)
    fields = {n: np.asarray(getattr(model, n), np.float32) for n in changed}
    changes = {
        n: x * rng.uniform(0.8, 1.2, (N, *x.shape)).astype(np.float32) for n, x in fields.items()
    }
    return state, np.zeros((N, model.nu), np.float32), changes


def compared(physics, changed, control_steps):
    """Returns the kernel, its agreement with XLA at each control step, and the last arguments."""
    step, (state, ctrl, changes) = stepping(physics), start(physics, changed)
    one = jax.tree.map(lambda x: x[0], (state, ctrl, changes))
    kernel = exact.compile_kernel(step, *one)
    by_xla, by_kernel, found = quick.jit(jax.vmap(step)), jax.jit(jax.vmap(kernel)), []
    rng = np.random.default_rng(1)
    for _ in range(control_steps):
        ctrl = rng.uniform(-1, 1, ctrl.shape).astype(np.float32)
        args = state, ctrl, changes
        flat = [
            np.concatenate(rows(*map(np.asarray, jax.tree.leaves(f(*args)))), 1)
            for f in (by_kernel, by_xla)
        ]
        found.append(compiling.agreement(*flat))
        state = jax.tree.map(np.asarray, by_xla(*args)[0])
    return kernel, found, args


@needs_compiler
@pytest.mark.usefixtures("kernels_are_compiled_quickly")
@pytest.mark.parametrize(
    "name", ["pendulum", *(pytest.param(n, marks=pytest.mark.slow) for n in ("arm", "heap"))]
)
def test_a_control_step_is_xlas(name):
    xml, readings, substeps, changed = MODELS[name]
    physics = Physics(mujoco.MjModel.from_xml_string(xml), readings, substeps, "jax")
    _, found, _ = compared(physics, changed, 4)
    assert all(x.agrees and x.error < 1e-4 for x in found), found


def physics_of(body):
    """Returns a task's physics, with its substeps and readings."""
    from purerl.envs import run
    from purerl.envs.suite import tasks

    if body == "humanoid":
        return tasks.build(tasks.Options(task="humanoid-run"), "jax").physics
    return run.build(run.Options(body=body), "jax").physics


def share_a_block(kernel):
    """Returns how many environments share a block of an H200."""
    return compilers.block_of(kernel.text, 90).environments


@needs_compiler
@pytest.mark.slow
@pytest.mark.usefixtures("kernels_are_compiled_quickly")
@pytest.mark.parametrize(
    "body, share, off",
    [("ant", 16, 0), pytest.param("humanoid", 4, 1e-3, marks=pytest.mark.nightly)],
)
def test_a_bodys_control_step_is_xlas(tmp_path, body, share, off):
    """Five substeps and a task's readings, from the air to the floor: contacts come and go."""
    physics = physics_of(body)
    kernel, found, args = compared(physics, (), 16)
    assert max(x.error for x in found) < 1e-4, found
    assert sum(x.off for x in found) <= off * sum(x.size for x in found), found
    assert share_a_block(kernel) >= share
    assert (args[0].qpos[:, 2] < physics.model.qpos0[2]).all(), "they have fallen"
    arrays = rows(*map(np.asarray, jax.tree.leaves(args)))
    one = by_one_lane(kernel.text, *arrays)
    warps = by_warps(
        kernel.text, *arrays, folder=tmp_path, warps=compilers.block_of(kernel.text, 90).warps
    )
    assert all(
        (x.view(np.int32) == y.view(np.int32)).all() for x, y in zip(one, warps, strict=True)
    )


@pytest.mark.nightly
def test_rodents_share_a_block():
    """2 min."""
    physics = physics_of("rodent")
    one = jax.tree.map(lambda x: x[0], start(physics, ()))
    assert share_a_block(exact.compile_kernel(stepping(physics), *one)) >= 4
