"""Fields of a model that differ between simulations: which may, what follows, what cannot act.

Constants that MuJoCo derives from fields are computed anew where those have changed: `derive`. A
model that was edited after its Physics was built, and rotations of zeros, are mistakes that no
engine would tell.
"""

import contextlib
import copy
import functools
import operator
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from purerl.core.errors import unknown_name
from purerl.core.records import Array
from purerl.physics import host_calls, lookup, reasons
from purerl.physics.left_out import LEFT_OUT

# Floats of MjModel that are of no one simulation (of meshes, of users), or that MJX does not trace.
_ONE_FOR_ALL = re.compile(
    "(bvh|efm0|flex|flexedge|hfield|key|mesh|numeric|oct|sensor|skin|tuple|wrap)_.*|.*_user|"
    "actuator_(armature|damping|dampingpoly|delay|length0)|body_margin|cam_(ipd|sensorsize)|"
    "dof_length|geom_(adhesion|fluid|surfacevel)|light_(bulbradius|intensity|range|softness)|"
    "mat_(metallic|reflectance|roughness|texrepeat)|pair_adhesion|site_(rgba|size)|"
    "tendon_(rgba|width)"
)
_NO_MODEL = mujoco.MjModel.from_xml_string("<mujoco/>")
# Fields that may differ between environments, on every engine: a test compares them with those that
# MJX traces, so that the `c` engine need not import MJX, which takes seconds.
CHANGEABLE_FIELDS = tuple(
    name
    for name in dir(_NO_MODEL)
    if getattr(getattr(_NO_MODEL, name), "dtype", int) in (np.float32, np.float64)
    and not _ONE_FOR_ALL.fullmatch(name)
)

# Those of them that mj_setConst derives from others, and those that the compiler alone does.
_DERIVED = [name for name in mujoco.MjModel._setconst_outputs if name != "geom_size"]
CONSTANTS = [name for name in _DERIVED if name in CHANGEABLE_FIELDS]
_COMPILED = ("tendon_lengthspring", "actuator_lengthrange")
# Ends of names, and of the field without which those do nothing: jnt_range, jnt_limited.
_SWITCHES = {r"(range|margin|solref|solimp)(_lim)?$": "limited", r"(dyn|bias)prm$": r"\1type"}
_TRACKING = [int(getattr(mujoco.mjtCamLight, f"mjCAMLIGHT_{x}")) for x in ("TRACK", "TRACKCOM")]
_DRAWN = ("light_", "cam_", "mat_", "geom_rgba")  # what one edits to draw
ZERO_ROTATION = (
    "A simulation starts with a quaternion of zeros, in qpos of a free or ball joint or in "
    "body_quat, which is no rotation: write 1 0 0 0 for none, as model.qpos0 has it."
)
Follows = Callable[[str], dict[str, np.ndarray]]  # `consequences` of a field, kept


def numbers(model: mujoco.MjModel, fields: Iterable[str]) -> dict[str, Any]:
    """Returns copies of all options and of those `fields` that are not only drawn."""
    names = [f"opt.{name}" for name in dir(model.opt) if not name.startswith("_")]
    names += [name for name in fields if not name.startswith(_DRAWN)]
    return {name: np.copy(operator.attrgetter(name)(model)) for name in names}


def check_unedited(model: mujoco.MjModel, built: dict[str, Any]) -> None:
    """Raises ValueError for a model whose `numbers` are no more those that an engine has."""
    for name, value in built.items():
        if not np.array_equal(value, operator.attrgetter(name)(model)):
            raise ValueError(
                f"The model's {name} was edited after its Physics was built, which has no effect: "
                "edit the model before, or build another Physics of a copy (copy.copy(model)); "
                "what differs between simulations goes into changes=."
            )


def refuse_zero_rotations(model: mujoco.MjModel, qpos: Array, changes: dict[str, Array]) -> Array:
    """Raises ValueError for quaternions of zeros; returns qpos [nq].

    Where only a program will know them, it is NaN then. MuJoCo takes them for no rotation, MJX for
    NaN, MJX-Warp for half a turn.
    """
    given: Any = qpos if isinstance(qpos, jax.core.Tracer) else np.asarray(qpos)
    zero = has_zero_rotation(model, given, changes)
    if isinstance(zero, jax.core.Tracer):
        return jnp.where(zero, jnp.nan, qpos)
    if zero:
        raise ValueError(ZERO_ROTATION)
    return qpos


def has_zero_rotation(model: mujoco.MjModel, qpos: Array, changes: dict[str, Array]) -> Any:
    """Tells whether qpos [nq], or a changed body_quat, has a quaternion of zeros, [] bool."""
    kinds = (mujoco.mjtJoint.mjJNT_FREE, 3), (mujoco.mjtJoint.mjJNT_BALL, 0)
    starts = [i + skip for kind, skip in kinds for i in model.jnt_qposadr[model.jnt_type == kind]]
    quats = [*(qpos[i : i + 4] for i in starts), *changes.get("body_quat", ())]
    return sum((quat == 0).all() for quat in quats) > 0


def check_fields(model: mujoco.MjModel, engine: str, changes: dict[str, Any]) -> None:
    """Raises ValueError for changes that are unknown, of another shape, or without effect."""
    for name, value in changes.items():
        if name not in CHANGEABLE_FIELDS:
            raise ValueError(unknown_name("model field that can change", name, CHANGEABLE_FIELDS))
        check_shape(f"changes[{name!r}]", value, getattr(model, name).shape)
        idle = idle_rows(model, engine, name)
        if idle.size and idle.all():
            raise ValueError(
                f"changes[{name!r}] would do nothing on engine {engine!r}: it is heeded only where "
                "the model was compiled with such a limit, with an actuator of that kind, or with "
                f"{name} above 0 (frictionloss, tendon_armature on 'jax': everywhere)."
            )


def check_whole(
    model: mujoco.MjModel, changes: dict[str, Any], follows: Follows
) -> dict[str, Array]:
    """Returns changes in float32; ValueError for those without what follows from them.

    Places (`..._pos`, `..._quat`) may change in rows from which nothing follows, such as a goal's.
    Where only a program will know in which they have changed, the others are NaN if they have.
    """
    found = {}
    for name, value in changes.items():
        own, traced = np.float32(getattr(model, name)), isinstance(value, jax.core.Tracer)
        value = value if traced else np.asarray(value, np.float32)
        place = traced and name.endswith(("_pos", "_quat"))
        for rows, reason in _refusals(model, name, changes, follows):
            differs = (value != own) & rows.reshape(-1, *[1] * (own.ndim - 1))
            if not place and rows.any() and (traced or differs.any()):
                raise ValueError(f"changes[{name!r}] {reason}")
            value = jnp.where(differs, jnp.nan, value) if place and rows.any() else value
        found[name] = jnp.asarray(value, jnp.float32)
    return found


def consequences(model: mujoco.MjModel, name: str) -> dict[str, np.ndarray]:
    """Returns the constants that follow from a field, and from which of its rows, [n] bool each.

    MuJoCo is asked: it sets the constants of a model in which one row is another. A mocap body is
    where the state says, and a muscle alone heeds `actuator_acc0`.
    """
    model, rows = copy.copy(model), np.arange(len(getattr(model, name)))
    if name in ("body_pos", "body_quat"):
        rows = np.flatnonzero(model.body_mocapid < 0)
    found: dict[str, np.ndarray] = {}
    data, field = mujoco.MjData(model), getattr(model, name)
    own, base = field.copy(), _set_constants(model, data)
    for row in rows if name not in CONSTANTS else ():
        field[row] = 1.1 * own[row] + 0.01
        field[row] /= np.linalg.norm(field[row]) if name.endswith("quat") else 1.0
        with contextlib.suppress(mujoco.FatalError):  # of simple bodies: `_refusals` tells
            for constant, value in _set_constants(model, data).items():
                if not np.allclose(value, base[constant], 1e-7, 1e-12):
                    found.setdefault(constant, np.zeros(len(own), bool))[row] = True
        field[row] = own[row]
    muscles = (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_MUSCLE)).any()
    muscles |= (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE)).any()
    if "tendon_length0" in found and model.tendon_stiffness.any():
        found["tendon_lengthspring"] = found["tendon_length0"]
    if "actuator_acc0" in found and muscles:
        found["actuator_lengthrange"] = found["actuator_acc0"]
    return {n: x for n, x in found.items() if n != "actuator_acc0" or muscles}


def idle_rows(model: mujoco.MjModel, engine: str, name: str) -> np.ndarray:
    """Tells which rows of a field, [n] bool, an engine never heeds."""
    value = getattr(model, name)
    all_idle = name in LEFT_OUT[engine] or (name == "body_gravcomp" and not value.any())
    all_idle |= engine == "jax" and name.endswith(("loss", "tendon_armature")) and not value.all()
    idle = np.full(len(value), all_idle)
    for end, other in _SWITCHES.items():
        switch = re.sub(end, other, name)
        if switch != name and hasattr(model, switch):
            idle |= getattr(model, switch) == 0
    return idle


def _set_constants(model: mujoco.MjModel, data: mujoco.MjData) -> dict[str, np.ndarray]:
    """Sets a model's constants; returns those that are heeded: a camera's only where it tracks.

    A tendon's have the geoms with them that it may bend round, if those move far enough; what it
    weighs at its ends then has its length, too.
    """
    mujoco.mj_setConst(model, data)
    tracks = {n: np.isin(getattr(model, f"{n}_mode"), _TRACKING) for n in ("cam", "light")}
    found = {n: getattr(model, n)[tracks.get(n.split("_")[0], ...)].copy() for n in CONSTANTS}
    round_ = model.wrap_objid[model.wrap_type >= int(mujoco.mjtWrap.mjWRAP_SPHERE)]
    bend = [x[round_].ravel() for x in (data.geom_xpos, data.geom_xmat, model.geom_size)]
    found["tendon_length0"] = np.concatenate([found["tendon_length0"], *bend])
    found["tendon_invweight0"] = np.append(found["tendon_invweight0"], found["tendon_length0"])
    return found


def _refusals(
    model: mujoco.MjModel, name: str, changes: dict[str, Any], follows: Follows
) -> Iterator[tuple[np.ndarray, str]]:
    """Yields rows [n] of a changed field that must be the model's own, and why."""
    if name in ("jnt_pos", "jnt_axis", "body_ipos", "body_iquat"):
        bodies = model.jnt_bodyid if name.startswith("jnt") else np.arange(model.nbody)
        yield (
            (model.body_simple[bodies] > 0) & (model.body_dofnum[bodies] > 0),
            "would not change the inertia of a body that was compiled as a simple one (it is free, "
            'or slides): write simple="false" into its <body>.',
        )
    if name == "geom_size":
        yield model.geom_fluid[:, 0] > 0, "would be unknown to a fluid: remove its fluidshape."
    behind = {n: rows for n, rows in follows(name).items() if n not in changes}
    if behind:
        hand = " and ".join(n for n in behind if n in _COMPILED)
        yield (
            np.any(list(behind.values()), axis=0),
            f"alone is half a change: {', '.join(behind)} would follow from it. Give what "
            "physics.derive(changes) returns, computed once in reset"
            + (f", and {hand} by hand: MuJoCo's compiler alone has it." if hand else "."),
        )


def check_shape(name: str, value: Any, shape: tuple[int, ...]) -> None:
    """Raises ValueError for another shape than that of one simulation."""
    if jnp.shape(value) != shape:
        raise ValueError(
            f"{name} has shape {jnp.shape(value)}; one simulation of this model takes {shape}. "
            "Batches are the caller's vmap."
        )


def derive(
    model: mujoco.MjModel, changes: dict[str, Any], wanted: tuple[str, ...]
) -> dict[str, Array]:
    """Returns the `wanted` constants of a model with changes: by mj_setConst, on the host."""
    names = tuple(sorted(changes))
    name = "-".join(["purerl-derive", lookup.hash_model(model, wanted), *names])
    host = functools.partial(_derive_rows, copy.copy(model), names, wanted)
    shapes = [getattr(model, n).shape for n in wanted]
    found = host_calls.run(name, host, [changes[n] for n in names], shapes)
    return dict(zip(wanted, found, strict=True))


def _derive_rows(
    model: mujoco.MjModel, names: tuple[str, ...], wanted: tuple[str, ...], rows: Any
) -> np.ndarray:
    """Derives packed rows: [..., changes] -> [..., constants]; NaN where MuJoCo refuses."""
    flat = np.asarray(rows).reshape(-1, np.shape(rows)[-1])
    batch = Batch(model, len(flat), nthread=host_calls.usable_cores())
    fields = [batch.expand(name) for name in names]
    host_calls.unpack(fields, flat)
    for name, field in zip(names, fields, strict=True):
        if name in ("body_pos", "body_quat"):  # a mocap body is where the state says
            field[:, model.body_mocapid >= 0] = getattr(model, name)[model.body_mocapid >= 0]
    with contextlib.suppress(SimulationError):  # `status` says which
        batch.set_const()
    for i in np.flatnonzero(batch.status):
        reasons.note(batch.error(int(i)))
    found = [batch.expand(name).reshape(len(flat), -1) for name in wanted]
    out = np.concatenate(found, axis=1, dtype=np.float32)
    out[batch.status != 0] = np.nan
    return out.reshape(*np.shape(rows)[:-1], out.shape[-1])
