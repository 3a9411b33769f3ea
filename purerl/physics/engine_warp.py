"""The `warp` engine: MJX-Warp, whose kernels step a whole batch at once, for NVIDIA GPUs.

It runs on a CPU too, slowly: that is for tests. There it is exact; on a GPU its kernels add with
atomics, in any order.

What is batched here is the control step, not the physics step: `vmap` of a control step becomes
one call for MJX-Warp's own batch (`warp_buffers.py`), and the size of the batch, which one
simulation cannot know, decides how much room contacts get.
"""

import copy
import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import warp

warp.config.log_level = warp.LOG_ERROR  # or it lists its devices, and each of some 100 kernels
warp.init()

from mujoco.mjx._src import math as mjx_math  # noqa: E402
from mujoco.mjx.third_party import mujoco_warp as mjw  # noqa: E402

from purerl.core.errors import unknown_name  # noqa: E402
from purerl.core.records import Array, PyTree  # noqa: E402
from purerl.physics.changes import CONSTANTS  # noqa: E402
from purerl.physics.engine_mjx import mjx_defaults  # noqa: E402
from purerl.physics.lookup import reading_shapes  # noqa: E402
from purerl.physics.warp_buffers import Batch, Shapes, Stage, make_call, put_model, room  # noqa: E402

# Running out of iterations is the solver's setting; everything else drops something.
_DROPPED = ~int(mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS)

# The few sensors that sense constraints without forces.
_OF_CONSTRAINTS = ("JOINTLIMITPOS", "JOINTLIMITVEL", "TENDONLIMITPOS", "TENDONLIMITVEL")
_OF_CONSTRAINTS += ("GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "CONTACT")
# Readings for which the places of bodies and their mass are enough.
_OF_BODIES = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos")
_OF_BODIES += ("geom_xmat", "site_xpos", "site_xmat", "subtree_com", "cinert", "cdof")
_INTEGRATED = ("qpos", "qvel", "act", "time", "qacc_warmstart")  # of a PhysicsState
_SUMS = {"dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly"}
_SUMS |= {"actuator_gear"}  # of a joint's damping and an actuator's, times its gear squared
_PLACES = {"geom_pos", "geom_quat", "body_pos", "body_quat"}


class WarpEngine:
    """Steps a model with MJX-Warp; see `interface.Physics` for what `init` and `step` promise."""

    def __init__(self, model: mujoco.MjModel, record: Any, late: tuple[str, ...], substeps: int):
        """Prepares the model; memory on a device is taken when a batch is first stepped there.

        Args:
          model: the model.
          record: the NamedTuple of readings, of which "overflow" may be one.
          late: the readings that are those of the last substep.
          substeps: physics steps in one control step.
        """
        self.record, self.late, self.substeps = record, late, substeps
        names = tuple(name for name in record._fields if name != "overflow")
        if "subtree_com" in names:  # `_combine` needs both
            names += ("xipos",)
        self.shapes = reading_shapes(model, names)
        of_acceleration = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
        self.late_sensors = np.repeat(of_acceleration, model.sensor_dim)  # [nsensordata] bool
        self.massless = model.body_subtreemass < mujoco.mjMINVAL
        self.early = tuple(n for n in self.shapes if n not in late or n == "sensordata")
        self.model = copy.copy(model)
        # It has no midphase, and refuses a model that switches it off.
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        self.contacts, self.rows = room(model, _on_host(self.model))
        sensors = [int(getattr(mujoco.mjtSensor, f"mjSENS_{name}")) for name in _OF_CONSTRAINTS]
        sensed = "sensordata" in names and bool(np.isin(model.sensor_type, sensors).any())
        self.make_current = _how_to_read(self.early, sensed)
        self.batches: dict[Any, Batch] = {}
        self.calls: dict[Any, Callable] = {}

    def init(self, state: PyTree, changes: dict[str, Array], ctrl: Array | None = None) -> tuple:
        """Returns the readings at `state` under ctrl [nu], by default zeros."""
        ctrl = jnp.zeros(self.model.nu, jnp.float32) if ctrl is None else ctrl
        return _over_batch(self._init)(state, ctrl, _known(self.model, changes))

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Advances one control step."""
        return _over_batch(self._step)(state, ctrl, _known(self.model, changes))

    def _init(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple:
        """As `init`, of a batch [B]."""
        size = state.time.shape[0]
        found = self._combine(*self._call("init", state, ctrl, changes))
        return self._read(found, jnp.zeros(size, jnp.float32))

    def _step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """As `step`, of a batch [B]."""
        late, early = self._call("step", state, ctrl, changes)
        dropped = (late["overflow"] & _DROPPED) != 0
        # A NaN control would be clipped into the actuator's range.
        lost = ~_finite(state.time.shape[0], (state, ctrl, changes))
        if "overflow" not in self.record._fields:
            lost |= dropped  # nobody looks
        state = state.replace(**{name: late[name] for name in _INTEGRATED})
        blow_up = jax.vmap(lambda yes, x: jnp.where(yes, jnp.nan, x))
        both = state, self._combine(late, early)
        state, found = jax.tree.map(functools.partial(blow_up, lost), both)
        return state, self._read(found, dropped.astype(jnp.float32))

    def _call(
        self, name: str, state: PyTree, ctrl: Array, changes: dict[str, Array]
    ) -> list[dict[str, Array]]:
        """Runs "init" or "step" of a batch, and returns the fields late and early."""
        given = {**vars(state), "ctrl": ctrl, **changes}
        if _PLACES & set(changes):
            given |= jax.vmap(lambda c: _place_static_geoms(self.model, c))(changes)
        size, changed = state.time.shape[0], tuple(sorted(changes))
        if (name, size, changed) not in self.calls:
            takes = {field: value.shape[1:] for field, value in given.items()}
            batch = functools.partial(self._batch, size=size, changed=changed)
            call = make_call(name, self._stages(name, takes), takes, size, batch)
            self.calls[name, size, changed] = call
        return self.calls[name, size, changed](given)

    def _stages(self, name: str, takes: Shapes) -> tuple[Stage, Stage]:
        """Returns what "init" and "step" run: the physics, then what makes readings current."""
        late = {n: self.shapes[n] for n in self.late}
        if name == "init":
            first = Stage(mjw.forward if late else _nothing, late)
        else:
            integrated = {n: takes[n] for n in _INTEGRATED}
            first = Stage(self._steps, late | integrated | {"overflow": ()})
        return first, Stage(self.make_current, {n: self.shapes[n] for n in self.early})

    def _batch(self, device: Any, size: int, changed: tuple[str, ...]) -> Batch:
        """Returns the batch on a device, of a size and with such changes."""
        key = device.alias, size, changed
        if key not in self.batches:
            self.batches[key] = Batch(self.model, size, self.contacts, self.rows, changed)
        return self.batches[key]

    def _steps(self, model: mjw.Model, data: mjw.Data) -> None:
        """Runs the physics steps of a control step."""
        for _ in range(self.substeps):
            mjw.step(model, data)

    def _combine(self, late: dict[str, Array], early: dict[str, Array]) -> dict[str, Array]:
        """Returns the fields of a batch: those of the last substep, and the current ones."""
        found = late | early
        if "sensordata" in found:
            value = jnp.where(self.late_sensors, late["sensordata"], early["sensordata"])
            found["sensordata"] = value
        if "subtree_com" in found:  # MuJoCo's, where there is no mass; MJX-Warp has zero there
            value = jnp.where(self.massless[:, None], early["xipos"], early["subtree_com"])
            found["subtree_com"] = value
        return {name: found[name] for name in self.shapes}

    def _read(self, found: dict[str, Array], dropped: Array) -> tuple:
        """Returns the record of readings."""
        found = found | {"overflow": dropped}
        return self.record(*(found[name] for name in self.record._fields))


def _on_host(model: mujoco.MjModel) -> mjw.Model:
    """Returns MJX-Warp's model on the CPU; ValueError if it cannot simulate it."""
    try:
        with warp.ScopedDevice("cpu"):
            return put_model(model, {})
    except NotImplementedError as error:
        raise ValueError(
            f"MJX-Warp cannot simulate this model: {error} Change the model, or use engine 'c'."
        ) from error


def _how_to_read(early: tuple[str, ...], constraints_matter: bool) -> Callable:
    """Returns what makes the early readings current, at the least cost."""
    if not early:
        return _nothing
    if set(early) <= set(_OF_BODIES):
        return _bodies
    return mjw.forward if constraints_matter else _forward


def _bodies(model: mjw.Model, data: mjw.Data) -> None:
    """Makes what `_OF_BODIES` names current, and no more."""
    mjw.kinematics(model, data)
    mjw.com_pos(model, data)


def _forward(model: mjw.Model, data: mjw.Data) -> None:
    """Makes what follows from positions and velocities current: nothing of constraints."""
    model, model.opt = copy.copy(model), copy.copy(model.opt)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    mjw.forward(model, data)


def _nothing(model: mjw.Model, data: mjw.Data) -> None:
    """Runs no kernel."""


def _known(model: mujoco.MjModel, changes: dict[str, Array]) -> dict[str, Array]:
    """Refuses changes of fields of which MJX-Warp has one value for the whole batch, or none.

    Constants that it does not read are left out: what they follow from is there.
    """
    # Those that may differ between simulations have the type of an array [*, ...].
    types = {f.name: getattr(f.type, "shape", ()) for f in dataclasses.fields(mjw.Model)}
    fields = [name for name, shape in types.items() if shape[:1] == ("*",)]
    derived = CONSTANTS if set(changes) - set(CONSTANTS) else ()
    changes = {n: x for n, x in changes.items() if n in fields or n not in derived}
    for name in changes:
        if name not in fields:
            what = "model field that can change on engine 'warp'"
            raise ValueError(unknown_name(what, name, fields))
    sums = _SUMS & set(changes)
    if sums and (model.actuator_damping.any() or model.actuator_dampingpoly.any()):
        raise ValueError(
            f"changes[{min(sums)!r}] would do another thing on engine 'warp', where MJX-Warp has "
            "made a sum of it and of the damping of actuators (actuator_damping): take that out "
            "of the model, or use engine 'c' or 'jax'."
        )
    return changes


def _finite(size: int, trees: PyTree) -> Array:
    """Tells which simulations of trees [B, ...] have only finite numbers, [B] bool."""
    leaves = [jnp.isfinite(x).reshape(size, -1).all(axis=1) for x in jax.tree.leaves(trees)]
    return jnp.stack(leaves).all(axis=0)


def _place_static_geoms(model: mujoco.MjModel, changes: dict[str, Array]) -> dict[str, Array]:
    """Puts geoms that no joint moves where `changes` say: MJX-Warp takes their place as given.

    Returns:
      "geom_xpos" [ngeom, 3] [m] and "geom_xmat" [ngeom, 3, 3]; of other geoms they mean nothing.
    """
    body_pos, body_quat, pos, quat = (
        changes.get(name, jnp.asarray(getattr(model, name), jnp.float32))
        for name in ("body_pos", "body_quat", "geom_pos", "geom_quat")
    )
    body = model.geom_bodyid
    with mjx_defaults():
        while body.any():  # a body out; the world's frame, which is its own parent, changes nothing
            pos = body_pos[body] + jax.vmap(mjx_math.rotate)(pos, body_quat[body])
            quat = jax.vmap(mjx_math.quat_mul)(body_quat[body], quat)
            body = model.body_parentid[body]
        return {"geom_xpos": pos, "geom_xmat": jax.vmap(mjx_math.quat_to_mat)(quat)}


def _over_batch(function: Callable, axes: int = 0) -> Callable:
    """Makes of a function of trees [B, ...] one of trees with `axes` leading axes.

    `vmap` of what it returns adds an axis, and all of them together are the batch in the end.
    """

    @jax.custom_batching.custom_vmap
    def call(*args: PyTree) -> PyTree:
        lead = args[0].time.shape
        number = math.prod(lead)
        flat = jax.tree.map(lambda x: x.reshape(number, *x.shape[axes:]), args)
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), function(*flat))

    @call.def_vmap
    def add_axis(size: int, batched: list, *args: PyTree) -> tuple[PyTree, PyTree]:
        def spread(x: Array, has: bool) -> Array:
            return x if has else jnp.broadcast_to(x, (size, *x.shape))

        args = jax.tree.map(spread, args, tuple(batched))
        out = _over_batch(function, axes + 1)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return call
