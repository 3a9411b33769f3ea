"""Python functions that compiled programs on a CPU call by name."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.physics import engine_c, host_calls
from purerl.physics.interface import Physics
from tests import quick

PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.05" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def pendulum(mass=1.0):
    return mujoco.MjModel.from_xml_string(PENDULUM.format(mass=mass))


def swing(physics, changes=None):
    """Returns where a control step takes the pendulum."""
    state, _ = physics.init(jnp.full(1, 1.0), jnp.zeros(1), changes)
    return float(physics.step(state, jnp.full(1, 0.5), changes)[0].qpos[0])


def reference(model, substeps):
    """The same by MuJoCo itself."""
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = 1.0, 0.5
    mujoco.mj_step(model, data, substeps)
    return data.qpos[0]


def test_a_program_calls_a_function_of_rows_under_nested_vmap_and_scan():
    seen = []

    def double(rows):
        seen.append(rows.shape)
        return np.concatenate([2 * rows, rows[..., :1]], axis=-1)

    host_calls.register("test-double", double)

    def step(row, _):
        return host_calls.call("test-double", 4, row)[:3], None

    @jax.jit
    @jax.vmap
    @jax.vmap
    def loop(row):
        return jax.lax.scan(step, row, length=3)[0]

    rows = np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    np.testing.assert_array_equal(loop(rows), 8 * rows)
    assert seen == [(4, 2, 3)] * 3  # once a step, for all together


def test_what_the_function_raises_ends_the_program_and_the_next_call_is_fine():
    broken = [True]

    def fail(rows):
        if broken[0]:
            raise SystemExit("no more memory")  # not even this may pass XLA unseen
        return rows

    host_calls.register("test-fail", fail)
    program = jax.jit(lambda row: host_calls.call("test-fail", 2, row))
    with pytest.raises(jax.errors.JaxRuntimeError, match="no more memory"):
        program(jnp.ones(2)).block_until_ready()
    broken[0] = False
    np.testing.assert_array_equal(program(jnp.ones(2)), [1, 1])


def test_a_result_of_another_shape_is_an_error():
    host_calls.register("test-shape", lambda rows: np.zeros(3, np.float32))
    with pytest.raises(jax.errors.JaxRuntimeError, match="shape"):
        jax.jit(lambda row: host_calls.call("test-shape", 2, row))(jnp.ones(2)).block_until_ready()


def test_engines_that_differ_in_anything_do_not_answer_for_each_other():
    light, heavy = pendulum(), pendulum(mass=2.0)
    physics = Physics(light, (), 2, "c")
    got = {
        "light": swing(physics),
        "heavy": swing(Physics(heavy, (), 2, "c")),
        "longer": swing(Physics(light, (), 3, "c")),
        "with readings": swing(Physics(light, ("xpos",), 2, "c")),
        "changed": swing(Physics(light, (), 2, "c"), {"dof_damping": jnp.full(1, 5.0)}),
        "changed otherwise": swing(physics, physics.derive({"dof_armature": jnp.full(1, 5.0)})),
    }
    damped, slow = pendulum(), pendulum()
    damped.dof_damping[:], slow.dof_armature[:] = 5.0, 5.0
    want = {
        "light": reference(light, 2),
        "heavy": reference(heavy, 2),
        "longer": reference(light, 3),
        "with readings": reference(light, 2),
        "changed": reference(damped, 2),
        "changed otherwise": reference(slow, 2),
    }
    assert got == pytest.approx(want, abs=1e-6)
    assert len({round(value, 6) for value in want.values()}) == 5  # or it would show nothing


def test_a_model_changed_afterwards_changes_no_engine():
    model = pendulum(mass=3.0)  # no other test's, whose engine would answer
    physics = Physics(model, (), 2, "c")
    want = reference(model, 2)
    model.dof_damping[:] = 5.0
    with pytest.raises(ValueError, match="dof_damping was edited after"):
        swing(physics)
    physics.model = pendulum(mass=3.0)  # as it was: the engine has a copy of that
    assert swing(physics) == pytest.approx(want, abs=1e-6)
    assert swing(Physics(model, (), 2, "c")) == pytest.approx(reference(model, 2), abs=1e-6)


def test_on_a_gpu_machine_jax_calls_the_host(monkeypatch):
    physics = Physics(pendulum(), ("xpos",), 2, "c")
    states = jax.vmap(lambda q: physics.init(q, jnp.zeros(1))[0])(jnp.ones((3, 1)))

    def step(state):
        return physics.step(state, jnp.full(1, 0.5))

    want = quick.jit(jax.vmap(step))(states)
    monkeypatch.setattr(engine_c.jax, "default_backend", lambda: "gpu")
    program = jax.jit(jax.vmap(lambda state: step(state)))  # another function, to trace anew
    assert "pure_callback" in str(program.trace(states).jaxpr)
    jax.tree.map(np.testing.assert_array_equal, program(states), want)


COMPILE = """
import sys, jax, jax.numpy as jnp, mujoco, numpy as np
from purerl.physics.interface import Physics
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name))
physics = Physics(mujoco.MjModel.from_xml_path(sys.argv[2]), (), 2, "c")
@jax.jit
def step(q):
    return physics.step(physics.init(q, jnp.zeros(1))[0], jnp.ones(1))[0].qpos
q = jnp.ones(1)
found.clear()
print(np.asarray(step(q))[0], found.count("/jax/compilation_cache/cache_hits"))
"""


def test_another_process_finds_the_program_compiled(tmp_path):
    path, other = tmp_path / "pendulum.xml", tmp_path / "other.xml"
    path.write_text(PENDULUM.format(mass=1.0))
    other.write_text(PENDULUM.format(mass=2.0))

    def start(xml):
        command = [sys.executable, "-c", COMPILE, tmp_path / "cache", xml]
        position, hits = subprocess.check_output(command, text=True).split()
        return float(position), int(hits)

    first, second, third = start(path), start(path), start(other)
    assert (first[1], second[1], third[1]) == (0, 1, 0)
    assert first[0] == second[0] != third[0]


LEAVE = """
import jax, jax.numpy as jnp
from purerl.envs import cartpole_swingup
env = cartpole_swingup.build(cartpole_swingup.Options(), "c")
state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64))
@jax.jit
def swing(state):
    step = jax.vmap(lambda s: env.step(s, jnp.zeros(1)))
    return jax.lax.scan(lambda s, _: (step(s), None), state, None, length=2000)[0]
state = swing(state)
"""


@pytest.mark.slow
def test_a_process_that_leaves_in_the_middle_of_a_computation_ends_well():
    """A call after Python's end has nobody to answer it: the process crashed, or hung."""
    subprocess.run([sys.executable, "-c", LEAVE], check=True, timeout=120)
