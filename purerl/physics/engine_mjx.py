"""The `jax` engine: MJX, traced once, with every sum in a fixed order."""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import exact
from purerl.core.records import Array, PyTree

with contextlib.redirect_stdout(io.StringIO()):  # it prints that warp, which is optional, is absent
    from mujoco import mjx
    from mujoco.mjx._src import forward, sensor, smooth

_IN_IMPL = ("cinert", "crb", "ten_velocity", "actuator_velocity", "subtree_linvel")
_IN_IMPL += ("subtree_angmom", "cacc", "cfrc_int", "cfrc_ext")


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
        _check_known(model)
        self.record, self.late, self.substeps = record, late, substeps
        self.shapes = reading_shapes(model, record._fields)
        device = jax.local_devices()[0]  # MJX by itself takes the first of all processes
        with mjx_defaults():
            try:
                self.model = mjx.put_model(model, device=device, impl="jax")
            except NotImplementedError as error:
                raise ValueError(
                    f"MJX cannot simulate this model: {error} Change the model, or use engine 'c'."
                ) from error
            self.data = mjx.make_data(model, device=device, impl="jax")
        # MJX takes seconds to trace: reset, training and evaluation share one trace of each.
        platform = platform or device.platform
        self._exact_init = exact.rewrite(self.plain_init, platform=platform)
        self._exact_step = exact.rewrite(self.plain_step, platform=platform)

    def init(self, state: PyTree, changes: dict[str, Array]) -> tuple:
        """Returns the readings at `state` under no control."""
        with mjx_defaults():
            return self._exact_init(state, changes)

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Advances one control step."""
        with mjx_defaults():
            return self._exact_step(state, ctrl, changes)

    def plain_init(self, state: PyTree, changes: dict[str, Array]) -> tuple:
        """Does what `init` does, with sums in any order."""
        model = self.model.tree_replace(changes) if changes else self.model
        data = _forward(model, _load_state(self.data, state), bool(self.late))
        return self._read(data)

    def plain_step(
        self, state: PyTree, ctrl: Array, changes: dict[str, Array]
    ) -> tuple[PyTree, tuple]:
        """Does what `step` does, with sums in any order."""
        model = self.model.tree_replace(changes) if changes else self.model

        def substep(carry, _):
            data = _load_state(self.data, carry[0]).replace(ctrl=ctrl)
            after = mjx.step(model, data)
            late = _forward(model, data, True) if self.late and _forgets_sensors(data) else after
            state = carry[0].replace(**{n: getattr(after, n) for n in vars(carry[0])})
            return (state, [_field_of(late, n) for n in self.late]), None

        start = [jnp.zeros(_field_of(self.data, n).shape) for n in self.late]
        (state, late), _ = jax.lax.scan(substep, (state, start), None, self.substeps)
        places = [f"_impl.{name}" if name in _IN_IMPL else name for name in self.late]
        data = _load_state(self.data, state).tree_replace(dict(zip(places, late, strict=True)))
        return state, self._read(_kinematics(model, data))

    def _read(self, data: mjx.Data) -> tuple:
        read = [jnp.reshape(_field_of(data, n), shape) for n, shape in self.shapes.items()]
        return self.record(*(x.astype(jnp.float32) for x in read))


def _check_known(model: mujoco.MjModel) -> None:
    """Raises ValueError for what MJX leaves out silently: the motion would be another than C's."""
    bits = (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER)
    passive = [bool(model.opt.disableflags & int(bit)) for bit in bits]
    left_out = {
        f"noslip_iterations = {model.opt.noslip_iterations}": model.opt.noslip_iterations,
        "only one of springs and dampers disabled": passive[0] != passive[1],
    }
    for what in ("jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping"):
        left_out[f"a non-zero {what}poly"] = getattr(model, f"{what}poly").any()
    for what, there in left_out.items():
        if there:
            raise ValueError(
                f"The model has {what}, which MJX does not have and leaves out without a word: "
                "remove it, on every engine, or use engine 'c'."
            )


def reading_shapes(model: mujoco.MjModel, names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Returns each reading's shape; rotation matrices are [n, 3, 3] on every engine."""
    data = mujoco.MjData(model)
    shapes = {name: np.shape(getattr(data, name)) for name in names}
    matrices = ("xmat", "ximat", "geom_xmat", "site_xmat", "cam_xmat")
    return {n: (s[0], 3, 3) if n in matrices else s for n, s in shapes.items()}


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


def _load_state(data: mjx.Data, state: PyTree) -> mjx.Data:
    """Puts an integration state into a blank `mjx.Data`."""
    return data.replace(**vars(state))


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
