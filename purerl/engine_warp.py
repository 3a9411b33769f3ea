"""The `warp` engine: MJX-Warp, whose kernels step a whole batch at once, for NVIDIA GPUs.

It runs on a CPU too, slowly: that is for tests. There it is exact; on a GPU its kernels add with
atomics, in any order.

What is batched here is the control step, not the physics step: `vmap` of a control step becomes
one loop of substeps around MJX-Warp's own batch (the other way round was 1.7 times slower), and
the size of the batch, which one simulation cannot know, decides how much room contacts get.
"""

import copy
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
from mujoco.mjx.third_party.mujoco_warp import OverflowType  # noqa: E402
from mujoco.mjx.warp.types import _BATCH_DIM  # noqa: E402

from purerl.engine_jax import (  # noqa: E402
    field_of,
    load_state,
    make_data,
    mjx,
    mjx_defaults,
    put_model,
    reading_shapes,
    save_state,
)
from purerl.model import unknown_name  # noqa: E402
from purerl.types import Array, PyTree  # noqa: E402

# Room in the buffers: what the model can need at most, but no more than this for a simulation.
MOST_CONTACTS = 128  # simulations share it: one may have all contacts that the model allows
MOST_ROWS = 512  # of constraints; each simulation has its own
# Running out of iterations is the solver's setting; everything else drops something.
_DROPPED = ~int(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)

_GEOM = mujoco.mjtGeom
_ONE_POINT = (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID)
_S = mujoco.mjtSensor
_OF_CONSTRAINTS = (_S.mjSENS_JOINTLIMITPOS, _S.mjSENS_JOINTLIMITVEL, _S.mjSENS_TENDONLIMITPOS)
_OF_CONSTRAINTS += (_S.mjSENS_TENDONLIMITVEL, _S.mjSENS_GEOMDIST, _S.mjSENS_GEOMNORMAL)
_OF_CONSTRAINTS += (_S.mjSENS_GEOMFROMTO, _S.mjSENS_CONTACT)
# Readings for which the places of bodies and their mass are enough.
_OF_BODIES = ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos")
_OF_BODIES += ("geom_xmat", "site_xpos", "site_xmat", "subtree_com", "cinert", "cdof")


class WarpEngine:
    """Steps a model with MJX-Warp; see `physics.Physics` for what `init` and `step` promise."""

    def __init__(self, model: mujoco.MjModel, record: Any, late: tuple[str, ...], substeps: int):
        """Puts the model on the device.

        Args:
          model: the model.
          record: the NamedTuple of readings, of which "overflow" may be one.
          late: the readings that are those of the last substep.
          substeps: physics steps in one control step.
        """
        self.record, self.late, self.substeps = record, late, substeps
        names = [name for name in record._fields if name != "overflow"]
        self.shapes = reading_shapes(model, tuple(names))
        self.late_sensors = _late_sensors(model)
        self.massless = model.body_subtreemass < mujoco.mjMINVAL
        early = {name for name in names if name not in late or name == "sensordata"}
        self.forward = _bodies if early <= set(_OF_BODIES) else mjx.forward
        free = _unconstrained(model, "sensordata" in names)
        with mjx_defaults():
            self.model, self.free = _put_model(model), _put_model(free)
            self.contacts, self.rows = room(model, self.model)
            self.data = make_data(model, "warp", naconmax=0, njmax=self.rows)
            # The model without constraints needs no room for them.
            own = free.opt.disableflags == model.opt.disableflags
            self.free_data = self.data if own else make_data(free, "warp", naconmax=0, njmax=0)

    def init(self, state: PyTree, changes: dict[str, Array]) -> tuple:
        """Returns the readings at `state` under no control."""
        return _over_batch(self._init)(state, _known(changes))

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Advances one control step."""
        return _over_batch(self._step)(state, ctrl, _known(changes))

    def _init(self, state: PyTree, changes: dict[str, Array]) -> tuple:
        """As `init`, of a batch [B]."""
        now = self._now(state, changes)
        data = now
        if self.late:
            data = _run(mjx.forward, self.model, self._begin(self.data, state, changes), changes)
        return self._read(now, data, jnp.zeros(state.time.shape))

    def _step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """As `step`, of a batch [B]."""
        data = self._begin(self.data, state, changes).replace(ctrl=ctrl)

        def substep(data: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            return _run(mjx.step, self.model, data, changes), None

        data, _ = jax.lax.scan(substep, data, None, self.substeps)
        dropped = (data._impl.overflow & _DROPPED) != 0
        # A NaN control would be clipped into the actuator's range.
        lost = ~_finite(state.time.shape[0], (state, ctrl, changes))
        if "overflow" not in self.record._fields:
            lost |= dropped  # nobody looks
        state = jax.vmap(_lose)(lost, save_state(state, data))
        return state, self._read(self._now(state, changes), data, dropped.astype(jnp.float32))

    def _now(self, state: PyTree, changes: dict[str, Array]) -> mjx.Data:
        """Makes what the readings of a batch need current, at the least cost."""
        return _run(self.forward, self.free, self._begin(self.free_data, state, changes), changes)

    def _begin(self, data: mjx.Data, state: PyTree, changes: dict[str, Array]) -> mjx.Data:
        """Returns blank data for a batch, at `state` [B], with room for its contacts."""
        size = state.time.shape[0]
        # One simulation may need all that the model allows; many have 128 each to share.
        number = min(size * self.contacts, max(self.contacts, size * MOST_CONTACTS))
        number = number if data._impl.njmax else 0
        impl = data._impl
        buffers = {
            k: getattr(impl, k) for k in impl.__dataclass_fields__ if k.startswith("contact__")
        }
        # Made while running: as constants they would be a part of the program.
        buffers = {k: jnp.zeros((number, *v.shape[1:]), v.dtype) for k, v in buffers.items()}
        data = data.replace(_impl=impl.replace(**buffers, naconmax=number, naccdmax=number))

        def load(state: PyTree, changes: dict[str, Array]) -> mjx.Data:
            return _place_static_geoms(self.model, load_state(data, state), changes)

        return jax.vmap(load)(state, changes)

    def _read(self, now: mjx.Data, last: mjx.Data, dropped: Array) -> tuple:
        """Returns the readings of a batch: those of the last substep, the others from `now`."""
        found = {"overflow": dropped}
        for name, shape in self.shapes.items():
            value = field_of(last if name in self.late else now, name)
            if name == "sensordata":
                value = jnp.where(self.late_sensors, value, now.sensordata)
            if name == "subtree_com":  # MuJoCo's, where there is no mass; MJX-Warp has zero there
                value = jnp.where(self.massless[:, None], now.xipos, value)
            found[name] = value.reshape(value.shape[0], *shape).astype(jnp.float32)
        return self.record(*(found[name] for name in self.record._fields))


def room(model: mujoco.MjModel, on_device: mjx.Model) -> tuple[int, int]:
    """Returns how many contacts and rows of constraints one simulation gets room for.

    The first is all that the model allows (pairs of geoms that can touch, times the points of
    each), the second what all of them, all equalities, limits and frictions need, or `MOST_ROWS`.
    """
    impl = on_device._impl
    if model.nflex or model.nhfield or (model.geom_type == _GEOM.mjGEOM_SDF).any():
        return MOST_CONTACTS, MOST_ROWS  # as many points as there are cells: no useful bound
    pairs = np.asarray(impl.nxn_geom_pair_filtered).reshape(-1, 2)
    contacts = int(_points(model.geom_type[pairs]).sum())
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    each = impl.nmaxpyramid if pyramidal else impl.nmaxcondim
    # A weld has 6 rows. MJX-Warp drops an equality that would end where the buffer ends: 8 more.
    others = 6 * model.neq + model.nv + 2 * model.ntendon + model.njnt + 8
    rows = contacts * max(1, int(each)) + others
    return contacts, min(rows, MOST_ROWS)


def _points(types: np.ndarray) -> np.ndarray:
    """Returns how many points pairs of geoms, types [n, 2], can touch in at most, [n]."""
    one = np.isin(types, [int(g) for g in _ONE_POINT]).any(axis=1)
    two = (types == _GEOM.mjGEOM_CAPSULE).any(axis=1)
    return np.where(one, 1, np.where(two, 2, 8))


def _unconstrained(model: mujoco.MjModel, sensors: bool) -> mujoco.MjModel:
    """Returns the model without constraints: positions and velocities do not depend on them.

    But for a few sensors, with which it is the model as it is.
    """
    if sensors and np.isin(model.sensor_type, [int(s) for s in _OF_CONSTRAINTS]).any():
        return model
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model


def _put_model(model: mujoco.MjModel) -> mjx.Model:
    """Puts a model on the device; MJX-Warp does not print of overflow, which is a reading.

    It has no midphase, and refuses a model that switches it off.
    """
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    put = put_model(model, "warp")
    return put.replace(opt=put.opt.replace(_impl=put.opt._impl.replace(warn_overflow=0)))


def _late_sensors(model: mujoco.MjModel) -> np.ndarray:
    """Tells which numbers of `sensordata` need the acceleration, [nsensordata] bool."""
    late = model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC
    return np.repeat(late, model.sensor_dim)


def _known(changes: dict[str, Array]) -> dict[str, Array]:
    """Refuses changes of fields of which MJX-Warp has one value for the whole batch, or none."""
    fields = [name for name, batched in _BATCH_DIM["Model"].items() if batched]
    for name in changes:
        if name not in fields:
            what = "model field that can change on engine 'warp'"
            raise ValueError(unknown_name(what, name, fields))
    return changes


def _finite(size: int, trees: PyTree) -> Array:
    """Tells which simulations of trees [B, ...] have only finite numbers, [B] bool."""
    leaves = [jnp.isfinite(x).reshape(size, -1).all(axis=1) for x in jax.tree.leaves(trees)]
    return jnp.stack(leaves).all(axis=0)


def _lose(lost: Array, state: PyTree) -> PyTree:
    """Makes the state of one simulation NaN if it is `lost` [] bool."""
    return jax.tree.map(lambda x: jnp.where(lost, jnp.nan, x), state)


def _changed(model: mjx.Model, changes: dict[str, Array]) -> mjx.Model:
    """Sets fields of the model; MJX-Warp keeps some in another shape ([n, 2, 3] for [n, 6])."""
    return model.tree_replace({n: v.reshape(getattr(model, n).shape) for n, v in changes.items()})


def _place_static_geoms(model: mjx.Model, data: mjx.Data, changes: dict[str, Array]) -> mjx.Data:
    """Puts geoms that no joint moves where `changes` say: MJX-Warp takes their place from data."""
    if not set(changes) & {"geom_pos", "geom_quat", "body_pos", "body_quat"}:
        return data
    body_pos, body_quat = (changes.get(n, getattr(model, n)) for n in ("body_pos", "body_quat"))
    mocap = model.body_mocapid[model.body_rootid] >= 0
    still = ((model.body_weldid == 0) & ~mocap)[model.geom_bodyid]
    pos, quat = (changes.get(n, getattr(model, n)) for n in ("geom_pos", "geom_quat"))
    body = model.geom_bodyid
    while body.any():  # one body out; the world's frame, which is its own parent, changes nothing
        pos = body_pos[body] + jax.vmap(mjx_math.rotate)(pos, body_quat[body])
        quat = jax.vmap(mjx_math.quat_mul)(body_quat[body], quat)
        body = model.body_parentid[body]
    return data.replace(
        geom_xpos=jnp.where(still[:, None], pos, data.geom_xpos),
        geom_xmat=jnp.where(
            still[:, None, None], jax.vmap(mjx_math.quat_to_mat)(quat), data.geom_xmat
        ),
    )


def _run(
    function: Callable, model: mjx.Model, data: mjx.Data, changes: dict[str, Array]
) -> mjx.Data:
    """Calls a function of MJX-Warp's model and data for a batch [B], whose models may differ."""
    return jax.vmap(lambda d, c: function(_changed(model, c), d))(data, changes)


def _bodies(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Makes what `_OF_BODIES` names current, and no more."""
    return mjx.com_pos(model, mjx.kinematics(model, data))


def _over_batch(function: Callable, axes: int = 0) -> Callable:
    """Makes of a function of trees [B, ...] one of trees with `axes` leading axes.

    `vmap` of what it returns adds an axis, and all of them together are the batch in the end.
    """

    @jax.custom_batching.custom_vmap
    def call(*args: PyTree) -> PyTree:
        lead = args[0].time.shape
        number = math.prod(lead)
        flat = jax.tree.map(lambda x: x.reshape(number, *x.shape[axes:]), args)
        with mjx_defaults():
            out = function(*flat)
        return jax.tree.map(lambda x: x.reshape(*lead, *x.shape[1:]), out)

    @call.def_vmap
    def add_axis(size: int, batched: list, *args: PyTree) -> tuple[PyTree, PyTree]:
        def spread(x: Array, has: bool) -> Array:
            return x if has else jnp.broadcast_to(x, (size, *x.shape))

        args = jax.tree.map(spread, args, tuple(batched))
        out = _over_batch(function, axes + 1)(*args)
        return out, jax.tree.map(lambda _: True, out)

    return call
