"""The `jax` engine: MJX, traced once, with every sum in a fixed order."""

import contextlib
import functools
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import exact
from purerl.core.records import Array, PyTree
from purerl.physics.host_calls import usable_cores
from purerl.physics.lookup import reading_shapes
from purerl.physics.mjx_alone import without_warp

with without_warp(), contextlib.redirect_stdout(io.StringIO()):  # MJX prints that it is absent
    from mujoco import mjx
    from mujoco.mjx._src import forward, sensor, smooth, solver

_IN_IMPL = ("cinert", "crb", "ten_velocity", "actuator_velocity", "subtree_linvel")
_IN_IMPL += ("subtree_angmom", "cacc", "cfrc_int", "cfrc_ext")
# What MuJoCo computes with the sensors of accelerations: under RK4 at the first of four stages,
# where MJX has the last; forces and accelerations are the last stage's.
_OF_SENSORS = ("sensordata", "cacc", "cfrc_int", "cfrc_ext")
# On a GPU a control step is one kernel if the Jacobian of its constraints has no more numbers. That
# of a humanoid has 8,181. A rodent's kernel is 1.5 times as fast as XLA's and takes two minutes to
# make, where `warp` is 3 to 4 times as fast as that (lab/2026-11-29-half-the-memory.md).
MOST_OF_A_KERNEL = 10_000
TRIED, TRIED_FOR = 32, 12  # simulations and control steps on which a kernel is compared with XLA


class JaxEngine:
    """Steps a model with MJX; see `interface.Physics` for what `init` and `step` promise."""

    def __init__(
        self,
        model: mujoco.MjModel,
        record: Any,
        late: tuple[str, ...],
        substeps: int,
        platform: str | None = None,
    ):
        """Puts the model on the device; ValueError if MJX cannot simulate all of it.

        `record` is the NamedTuple of readings; those that are `late` are of the last substep.
        `exact.rewrite` is told the `platform`, by default that of this process's first device.
        """
        self.record, self.late, self.substeps = record, late, substeps
        self.shapes = reading_shapes(model, record._fields)
        device = jax.local_devices()[0]  # MJX by itself takes the first of all processes
        with mjx_defaults():
            try:
                self.model = mjx.put_model(model, device=device, impl="jax")
                self.data = mjx.make_data(model, device=device, impl="jax")
                senses = [smooth.kinematics, sensor.sensor_pos, sensor.sensor_vel]
                rows = not _forgets_sensors(self.data)
                senses += [sensor.sensor_acc] * bool(late or rows) + [solver.solve] * rows
                for sense in senses:
                    jax.eval_shape(functools.partial(sense, self.model), self.data)
            except (NotImplementedError, TypeError, ValueError, LookupError) as error:
                raise ValueError(
                    f"MJX cannot simulate this model: {error} Change the model{_hint(model)}, or "
                    "use engine 'c'."
                ) from error
        # MJX takes seconds to trace: reset, training and evaluation share one trace of each.
        platform = platform or device.platform
        self._exact_init = exact.rewrite(self.plain_init, platform=platform)
        self._exact_step = exact.rewrite(self.plain_step, platform=platform)
        self.stepped_by: list[str] | None = None  # of `exact.with_kernel`
        if platform == "gpu" and self.data._impl.efc_J.size <= MOST_OF_A_KERNEL:
            self._apart = _to_compare_on()
            self.stepped_by = []
            self._exact_step = exact.with_kernel(
                self.plain_step, self._exact_step, self._reached, self.stepped_by.append
            )

    def init(self, state: PyTree, changes: dict[str, Array], ctrl: Array | None = None) -> tuple:
        """Returns the readings at `state` under ctrl [nu], by default zeros."""
        with mjx_defaults():
            return self._exact_init(state, changes, ctrl)

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Advances one control step."""
        with mjx_defaults():
            return self._exact_step(state, ctrl, changes)

    def plain_init(self, state: PyTree, changes: dict[str, Array], ctrl: Array | None) -> tuple:
        """Does what `init` does, with sums in any order."""
        data = self.data.replace(**vars(state), **({} if ctrl is None else {"ctrl": ctrl}))
        return self._read(_forward(self._changed(changes), data, bool(self.late)))

    def plain_step(
        self, state: PyTree, ctrl: Array, changes: dict[str, Array]
    ) -> tuple[PyTree, tuple]:
        """Does what `step` does, with sums in any order."""
        model = self._changed(changes)
        rk4 = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4

        def substep(carry, _):
            data = self.data.replace(**vars(carry[0]), ctrl=ctrl)
            after = mjx.step(model, data)
            first = after
            if self.late and (rk4 or _forgets_sensors(data)):
                first = _forward(model, data, True)
            late = {n: after if rk4 and n not in _OF_SENSORS else first for n in self.late}
            state = carry[0].replace(**{n: getattr(after, n) for n in vars(carry[0])})
            return (state, [_field_of(late[n], n) for n in self.late]), None

        start = [jnp.zeros(_field_of(self.data, n).shape) for n in self.late]
        (state, late), _ = jax.lax.scan(substep, (state, start), None, self.substeps)
        places = [f"_impl.{name}" if name in _IN_IMPL else name for name in self.late]
        data = self.data.replace(**vars(state)).tree_replace(dict(zip(places, late, strict=True)))
        return state, self._read(_kinematics(model, data))

    def _reached(self, step: Callable, *example: PyTree) -> tuple[tuple, tuple]:
        """Returns arguments of a `step` for some simulations that XLA has stepped, and its results.

        They begin as the model says, near rest, and move under random controls.
        """
        state, ctrl, changes = example
        quickly = {"xla_backend_optimization_level": 0} if self._apart else None
        in_turn = lambda *args: jax.lax.map(lambda x: step(*x), args)  # noqa: E731
        by_xla = jax.jit(in_turn, compiler_options=quickly)  # a `vmap` would be traced for seconds
        rng = np.random.default_rng(0)

        def several(x: Any, like: Any) -> np.ndarray:
            return np.tile(np.reshape(x, like.shape), (TRIED, *[1] * like.ndim)).astype(like.dtype)

        states = state.replace(
            **{n: several(getattr(self.data, n), x) for n, x in vars(state).items()}
        )
        states.qvel[:] += 0.1 * rng.normal(size=states.qvel.shape)
        changes = {n: several(getattr(self.model, n), x) for n, x in changes.items()}
        with jax.default_device(self._apart):
            for _ in range(TRIED_FOR):
                ctrls = rng.uniform(-1, 1, (TRIED, *ctrl.shape)).astype(np.float32)
                args = states, ctrls, changes
                states, readings = by_xla(*args)
        return jax.tree.map(np.asarray, (args, (states, readings)))

    def _changed(self, changes: dict[str, Array]) -> mjx.Model:
        """Returns the model with changes; MJX's matrices (`cam_mat0`) are [n, 3, 3]."""
        shaped = {n: x.reshape(getattr(self.model, n).shape) for n, x in changes.items()}
        return self.model.tree_replace(shaped) if changes else self.model

    def _read(self, data: mjx.Data) -> tuple:
        read = [jnp.reshape(_field_of(data, n), shape) for n, shape in self.shapes.items()]
        return self.record(*(x.astype(jnp.float32) for x in read))


def _to_compare_on() -> jax.Device | None:
    """Returns where a kernel's comparison is computed: a CPU, for which XLA compiles a step sooner.

    None, the first device, if JAX has no CPU, or two threads there, on which MJX may stop for ever.
    """
    with contextlib.suppress(RuntimeError):
        return jax.local_devices(backend="cpu")[0] if usable_cores() > 2 else None
    return None


def _hint(model: mujoco.MjModel) -> str:
    """Tells what MJX's own words do not."""
    rays = (model.sensor_type == mujoco.mjtSensor.mjSENS_RANGEFINDER).any()
    return " (a rangefinder needs a <material> in it)" if rays and not model.nmat else ""


def mjx_defaults() -> contextlib.ExitStack:
    """MJX relies on implicit promotion: its tracing is exempt from a caller's stricter rules.

    Its matrix products are whole float32 ones: a GPU's default has 10 bits of mantissa (TF32).
    """
    stack = contextlib.ExitStack()
    stack.enter_context(jax.default_matmul_precision("highest"))
    stack.enter_context(jax.numpy_dtype_promotion("standard"))
    stack.enter_context(jax.numpy_rank_promotion("allow"))
    return stack


def _field_of(data: mjx.Data, name: str) -> Array:
    """Returns a field of `mjx.Data`, wherever it is kept."""
    return getattr(data._impl if name in _IN_IMPL else data, name)


def _kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Makes position- and velocity-dependent fields current, without collision or constraints.

    What no reading uses is dropped by the compiler.
    """
    parts = (smooth.kinematics, smooth.com_pos, smooth.camlight, smooth.tendon, smooth.crb)
    parts += (smooth.transmission, sensor.sensor_pos, forward.fwd_velocity, sensor.sensor_vel)
    for part in parts:
        data = part(model, data)
    return data


def _forgets_sensors(data: mjx.Data) -> bool:
    """`mjx.forward` skips the acceleration sensors of a model without constraints."""
    return data._impl.efc_J.size == 0


def _forward(model: mjx.Model, data: mjx.Data, sensors: bool) -> mjx.Data:
    """`mjx.forward`, with the acceleration sensors in every case."""
    data = mjx.forward(model, data)
    return sensor.sensor_acc(model, data) if sensors and _forgets_sensors(data) else data
