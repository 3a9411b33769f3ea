"""Steps models drawn at random on an engine and in plain MuJoCo: do they move and read the same?

    python -m tests.long.models --number 3000             # engine c, some minutes
    python -m tests.long.models --engine jax --number 40  # compiles each: half an hour
    python -m tests.long.models --files robot.xml hand.xml [--engine jax]

Each model is refused in one line, or stepped from states that are drawn, with drawn controls. Then
fields of it are changed, and the same is asked of a model that MuJoCo compiles with those values.
Prints each difference with its seed, then what was refused, and how often. Exit code 1 if any.

Tolerances. Engine `c` without changes: none, a control step from an equal state has equal bits.
With changes: `CHANGED` of each array's largest number, since constants are rounded to float32, and
contacts are found in another order. Engine `jax`: `JAX`, its solver computing in float32.
"""

import argparse
import collections
import contextlib
import copy
import functools
import itertools
import re
import sys
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from purerl.core.errors import UserError
from purerl.physics import host_calls
from purerl.physics.changes import CHANGEABLE_FIELDS, CONSTANTS
from purerl.physics.interface import _ACCELERATION, _NEEDS_SENSOR, READINGS, Physics
from tests import quick
from tests.long.draw import Rng, draw

CHANGED, JAX = 1e-4, 5e-3
# MJX has no such: in most models something else is drawn.
INSTEAD = {'"discrete"': '"Euler"', '"implicit"': '"implicitfast"', '"PGS"': '"CG"'}
INTEGRATED = ("qpos", "qvel", "act", "time", "qacc_warmstart", "mocap_pos", "mocap_quat")
FULL = mujoco.mjtState.mjSTATE_INTEGRATION
LOST = [
    getattr(mujoco.mjtWarning, f"mjWARN_{x}")
    for x in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL", "CONTACTFULL", "CNSTRFULL")
]

Found = dict[str, np.ndarray]
Load = Callable[[], mujoco.MjSpec]
Tally = collections.Counter[str]


class Difference(Exception):  # noqa: N818
    """An engine and MuJoCo do not agree."""


class Vain(Exception):  # noqa: N818
    """A model is not fit to be compared."""


# --- plain MuJoCo ---


def plain(model: mujoco.MjModel, state: Any, ctrl: np.ndarray, substeps: int) -> Found | None:
    """Returns the state after a control step, and all readings; None where MuJoCo gives up."""
    data = mujoco.MjData(model)
    for name in INTEGRATED:
        setattr(data, name, np.asarray(getattr(state, name)))
    data.ctrl = ctrl
    try:
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        late = copy.copy(data)
        vector = np.zeros(mujoco.mj_stateSize(model, FULL))
        mujoco.mj_getState(model, late, vector, FULL)
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, vector, FULL)
        mujoco.mj_forward(model, data)
    except mujoco.FatalError:
        return None
    late = late if substeps else data
    if not max(np.abs(x).max(initial=0) for x in (late.qpos, late.qvel)) <= mujoco.mjMAXVAL:
        return None  # which the next step would find
    if any(late.warning[int(kind)].number for kind in LOST):
        return None
    of_late = np.repeat(model.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC, model.sensor_dim)
    found = {n: getattr(late if n in _ACCELERATION else data, n) for n in READINGS}
    found["sensordata"] = np.where(of_late, late.sensordata, data.sensordata)
    return {**{n: getattr(late, n) for n in INTEGRATED}, **found}


# --- an engine ---


def without_xla(name: str, host: Callable, given: Any, shapes: Any) -> list[np.ndarray]:
    """In place of `host_calls.run`: no compiling; and another simulation is stepped before it."""
    row = np.concatenate([np.ravel(x).astype(np.float32) for x in given])
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = np.split(host(np.stack([0.9 * row + 0.01, row]))[1], ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


@contextlib.contextmanager
def quickly() -> Iterator[None]:
    """Engine `c` is called without XLA, one simulation after the other."""
    kept = host_calls.run, host_calls.usable_cores
    host_calls.run, host_calls.usable_cores = without_xla, lambda: 1  # type: ignore[assignment]
    try:
        yield
    finally:
        host_calls.run, host_calls.usable_cores = kept


def programs(physics: Physics) -> tuple[Callable, Callable]:
    """Returns `init` and `step`, compiled in little time where they are."""
    if physics.engine == "c":
        return physics.init, physics.step
    physics._engine._exact_init = physics._engine.plain_init
    physics._engine._exact_step = physics._engine.plain_step
    return quick.jit(physics.init), quick.jit(physics.step)


def is_vain(model: mujoco.MjModel, state: Any) -> bool:
    """Tells whether forces in float32 are any number, or MJX's collisions are its own.

    So it is where a constraint moves nothing, and where ellipsoids, boxes, meshes, ... touch.
    """
    data = mujoco.MjData(model)
    for name in INTEGRATED:
        setattr(data, name, np.asarray(getattr(state, name)))
    mujoco.mj_forward(model, data)
    if (model.geom_type[data.contact.geom] >= int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)).any():
        return True
    rows = np.zeros((data.nefc, model.nv))
    if data.nefc and mujoco.mj_isSparse(model):
        mujoco.mju_sparse2dense(
            rows, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind
        )
    elif data.nefc:
        rows = data.efc_J.reshape(rows.shape)
    return bool((np.linalg.norm(rows, axis=1) < 1e-5).any())


def some_readings(model: mujoco.MjModel, rng: Rng) -> tuple[str, ...]:
    """Returns all readings that apply, or a few."""
    disabled = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR
    names = [n for n in READINGS if n not in _NEEDS_SENSOR and n != "sensordata"]
    if not disabled:
        names.append("sensordata")
        for name, kinds in _NEEDS_SENSOR.items():
            types = [getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}") for kind in kinds]
            names += [name] * bool(np.isin(model.sensor_type, types).any())
    number = rng.choice([len(names), 1, 2])
    return tuple(names[i] for i in sorted(rng.permutation(len(names))[:number]))


def start(model: mujoco.MjModel, rng: Rng) -> tuple[np.ndarray, ...]:
    """Returns a state near the model's own: qpos, qvel, act, ctrl."""
    qpos = np.array(model.qpos0)
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), rng.choice([0.0, 0.1, 0.5]))
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1, 1]).T
    ctrl = rng.uniform(low - 0.2, high + 0.2) if model.nu else np.zeros(0)
    speed = rng.choice([0.0, 1.0]) * rng.normal(size=model.nv)
    act = rng.uniform(0, 1, model.na) * rng.integers(2)
    return tuple(np.float32(x) for x in (qpos, speed, act, ctrl))


# --- both ---


def compare(found: Found, right: Found | None, tolerance: float, what: str, near: Callable) -> None:
    """Raises Difference where numbers are not MuJoCo's; one that MuJoCo gives up is NaN.

    `near` computes what MuJoCo has for models and states that are as near as float32 is.
    """
    for name, value in found.items():
        value = np.ravel(value)
        if right is None:
            if value.size and not np.isnan(value).all() and (not tolerance or near() == [None] * 4):
                raise Difference(f"{what}: MuJoCo gave up, and {name} is a number")
            continue
        wanted = np.float32(np.ravel(right[name]))
        scale = max(1.0, np.abs(wanted).max(initial=0.0)) if tolerance else 1.0
        bad = ~np.isclose(value, wanted, 0.0, tolerance * scale, equal_nan=True)
        if bad.any() and tolerance:
            others = near()
            if None in others:
                return
            far = max(distance(other, right) for other in others)
            bad &= ~(np.abs(value - wanted) < 10 * scale * far)
        if bad.any():
            i = int(np.argmax(np.where(bad, np.nan_to_num(np.abs(value - wanted), nan=np.inf), -1)))
            both = f"{value[i]:.9g}, {wanted[i]:.9g} in MuJoCo"
            raise Difference(f"{what}: {name}[{i}] of {len(value)} is {both}")


def distance(one: Found, other: Found) -> float:
    """Returns the largest difference of any array, in units of its largest number or 1."""
    pairs = [(np.ravel(one[n]), np.ravel(other[n])) for n in other if np.size(other[n])]
    return max(np.abs(x - y).max() / max(1.0, np.abs(y).max()) for x, y in pairs)


def rounded(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a model whose fields are rounded to float32, and its contacts in another order."""
    model = copy.copy(model)
    for name in CHANGEABLE_FIELDS:
        getattr(model, name)[...] = np.float32(getattr(model, name))
    model.bvh_aabb[:, 3:] = 1e3  # MuJoCo 3.17 lets some of a camera's rays miss what is there
    model.geom_sameframe[:] = model.site_sameframe[:] = model.body_sameframe[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return model


def solved(model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a model whose solver goes on to the end: where it stops depends on the last bits."""
    model = copy.copy(model)
    model.opt.solver, model.opt.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 1e-14
    model.opt.iterations, model.opt.ls_iterations, model.opt.noslip_iterations = 200, 100, 0
    return model


def follow(
    physics: Physics, right: mujoco.MjModel, changes: dict, rng: Rng, steps: int, tolerance: float
) -> None:
    """Raises Difference where `physics` with changes is not plain MuJoCo with the `right` model."""
    names = physics._engine.record._fields
    qpos, qvel, act, ctrl = start(physics.model, rng)
    init, step = programs(physics)
    state, read = init(qpos, qvel, changes, ctrl, act)
    wanted = plain(right, state, ctrl, 0)
    where = "init" + "".join(f" of {n}" for n in changes if n not in CONSTANTS)
    close = rounded(right) if tolerance else right

    def near(substeps: int) -> list[Found | None]:
        return [plain(close, nudged(state, i), ctrl, substeps) for i in range(4)]

    found = dict(zip(names, map(np.asarray, read), strict=True))
    vain = physics.engine == "jax" and is_vain(right, state)
    if not vain:
        compare(found, wanted, tolerance, where, lambda: near(0))
    for t in range(steps):
        if vain or (physics.engine == "jax" and is_vain(right, state)):
            raise Vain
        ctrl = start(physics.model, rng)[3]
        wanted = plain(right, state, ctrl, physics.substeps)
        after, read = step(state, ctrl, changes)
        got = {
            n: np.asarray(getattr(after, n))
            for n in INTEGRATED
            if n != "qacc_warmstart" or not tolerance
        }
        got |= dict(zip(names, map(np.asarray, read), strict=True))
        compare(got, wanted, tolerance, f"step {t}" + where[4:], lambda: near(physics.substeps))
        if wanted is None:
            return
        state = after


def nudged(state: Any, seed: int) -> Any:
    """Returns a state that is beside by the tolerance of collisions; the 0th as it is."""
    rng = np.random.default_rng(seed)
    beside = {n: np.asarray(getattr(state, n)) for n in ("qpos", "qvel")}
    return state.replace(
        **{n: x + 1e-6 * (seed > 0) * rng.normal(size=x.shape) for n, x in beside.items()}
    )


# --- changes ---

# Where an MJCF has a field: kind of element, attribute. What is not here is set in the model.
WRITTEN = {
    f"{kind}_{name}": (f"{plural}", name)
    for kind, plural, names in (
        ("body", "bodies", "mass inertia ipos iquat pos quat gravcomp"),
        ("geom", "geoms", "size pos quat friction margin gap solref solimp solmix"),
        ("site", "sites", "pos quat size"),
        ("cam", "cameras", "pos quat"),
        ("jnt", "joints", "pos axis range stiffness margin actfrcrange"),
        ("dof", "joints", "armature damping frictionloss"),
        ("tendon", "tendons", "range stiffness damping frictionloss armature margin actfrcrange"),
        (
            "actuator",
            "actuators",
            "gear gainprm biasprm dynprm ctrlrange forcerange actrange cranklength lengthrange",
        ),
        ("eq", "equalities", "solref solimp"),
        ("pair", "pairs", "friction gap margin solref solimp solreffriction"),
    )
    for name in names.split()
}
WRITTEN |= {f"jnt_{x}": ("joints", f"{x}_limit") for x in ("solref", "solimp")}
WRITTEN |= {f"dof_{x}": ("joints", f"{x}_friction") for x in ("solref", "solimp")}
WRITTEN |= {
    f"tendon_{x}_{y[:3]}": ("tendons", f"{x}_{y}")
    for x in ("solref", "solimp")
    for y in ("limit", "friction")
}
BY_HAND = ("tendon_lengthspring", "actuator_lengthrange")
SHAPED = [int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD)]
FREE = int(mujoco.mjtJoint.mjJNT_FREE)


def other_values(model: mujoco.MjModel, name: str, rng: Rng) -> np.ndarray:
    """Draws values of a field, as float32 has them, in the rows that a compiler would leave so."""
    own = np.array(getattr(model, name))
    column = (len(own), *[1] * (own.ndim - 1))
    factor = rng.uniform(0.97, 1.0, column) if "solimp" in name else rng.uniform(0.7, 1.4, column)
    value = own * factor
    if name.endswith(("pos", "quat", "axis", "gear")) and own.size:
        value += rng.normal(0, 0.1, own.shape)
    if name.endswith(("armature", "damping", "frictionloss", "stiffness", "margin", "gravcomp")):
        value += rng.uniform(0, 0.2, own.shape) * rng.integers(2)
    if name.endswith(("quat", "axis")):
        value /= np.linalg.norm(value, axis=1, keepdims=True)
    if name == "body_inertia":  # lengths of a triangle
        value = own * factor
    if name.startswith("dof_"):
        value = value[model.jnt_dofadr[model.dof_jntid]]  # one of a joint
    keep = np.zeros(len(own), bool)
    if name == "jnt_axis":
        keep |= model.jnt_type < int(mujoco.mjtJoint.mjJNT_SLIDE)
    if name.startswith("body_"):
        free = model.jnt_bodyid[model.jnt_type == FREE]
        keep[0] = True
        if name in ("body_pos", "body_quat"):  # qpos0 would be another; constants heed no mocap
            keep[free] = True
            keep |= model.body_mocapid >= 0
        if name in ("body_ipos", "body_iquat"):
            keep |= model.body_simple > 0
    if name == "jnt_pos":
        keep |= model.jnt_type == FREE
    if name in ("geom_size", "geom_pos", "geom_quat"):
        keep |= np.isin(model.geom_type, SHAPED)
    value[keep] = own[keep]
    return np.float32(value)


def recompiled(load: Load, model: mujoco.MjModel, changes: dict[str, np.ndarray]) -> mujoco.MjModel:
    """Returns the model that MuJoCo compiles of an MJCF with other values."""
    spec = load()
    spec.compile()  # gives each element its number
    for body in spec.bodies[1:]:
        body.explicitinertial, body.fullinertia = True, [np.nan] * 6
    for element in (*spec.geoms, *spec.sites):
        element.fromto = [np.nan] * 6
    written = {
        n: float(0)
        for n in (
            "body_mass",
            "body_ipos",
            "body_iquat",
            "body_inertia",
            "geom_size",
            "geom_pos",
            "geom_quat",
            "site_pos",
            "site_quat",
            "site_size",
            "dof_damping",
            "jnt_stiffness",
            "geom_solmix",
        )
    }
    spec.compiler.inertiafromgeom = 2  # only where there is no other
    spec.compiler.balanceinertia = spec.compiler.boundmass = spec.compiler.boundinertia = 0
    for joint in spec.joints:
        joint.springdamper = [0, 0]
    for name in {**written, **changes}:
        if name not in WRITTEN:
            continue
        plural, attribute = WRITTEN[name]
        for element in getattr(spec, plural):
            row = model.jnt_dofadr[element.id] if name.startswith("dof") else element.id
            if plural == "bodies" and row == 0:
                continue
            if name in ("geom_size", "geom_pos", "geom_quat") and model.geom_type[row] in SHAPED:
                continue
            value = changes.get(name, getattr(model, name))[row]
            own = getattr(element, attribute)
            if np.ndim(own):
                own = np.array(own)
                own[: np.size(value)] = np.ravel(value)[: len(own)]
            else:
                own = float(value)
            setattr(element, attribute, own)
    right = solved(spec.compile())
    for name, value in changes.items():
        if name not in WRITTEN:
            getattr(right, name)[...] = value
    return right


def change(
    load: Load,
    model: mujoco.MjModel,
    physics: Physics,
    rng: Rng,
    tally: collections.Counter,
) -> None:
    """Changes some fields, and follows; adds up what was refused."""
    names = [n for n in WRITTEN if getattr(model, n).size and n in CHANGEABLE_FIELDS]
    if model.nu != model.nactuator:  # a row for each control
        names = [n for n in names if not n.startswith("actuator_")]
    chosen = [names[i] for i in rng.permutation(len(names))[: rng.choice([1, 1, 2, 3])]]
    changes = {n: other_values(model, n, rng) for n in chosen}
    try:
        right = recompiled(load, model, changes)
    except ValueError as error:
        tally["no such model: " + kind_of(error)] += 1
        return
    for name in BY_HAND:
        if not np.allclose(getattr(right, name), getattr(model, name), 1e-6):
            changes.setdefault(name, np.float32(getattr(right, name)))
    try:
        whole = physics.derive(changes)
    except (ValueError, UserError) as error:
        refusal(error, tally, "changes")
        return
    if not all(np.isfinite(value).all() for value in whole.values()):
        tally["constants beyond float32, of a singular inertia"] += 1
        return
    tally["changed"] += 1
    for name in sorted(set(CONSTANTS) & set(whole)):
        a, b = np.asarray(whole[name]), np.float32(getattr(right, name))
        if name in ("eq_data", "geom_aabb"):
            continue
        if not np.allclose(a, b, 1e-3, 1e-4 * max(1e-3, np.abs(b).max(initial=0))):
            raise Difference(f"derive of {chosen}: {name} is {a.ravel()}, {b.ravel()} compiled")
    try:
        follow(physics, right, whole, rng, 2, CHANGED)
    except Difference:  # where a contact or a tendon jumps, that is no fault: it does so here alone
        tally["a difference from one start"] += 1
        follow(physics, right, whole, rng, 2, CHANGED)


# --- many ---


def kind_of(error: Exception) -> str:
    """Returns a message without its numbers and names."""
    return re.sub(r"-?\d[\d.e+-]*|'[^']*'", "#", str(error))[:150]


def refusal(error: Exception, tally: collections.Counter, where: str) -> None:
    """Adds a refusal up; raises Difference if it is no single line."""
    if "\n" in str(error).strip():
        raise Difference(f"refused in {len(str(error).splitlines())} lines: {error}")
    tally[f"refused ({where}): {kind_of(error)}"] += 1


def try_model(load: Load, engine: str, rng: Rng, tally: collections.Counter) -> None:
    """Raises Difference, or whatever else is thrown, where an engine is not MuJoCo."""
    try:
        model = load().compile()
    except ValueError as error:
        tally["no such model: " + kind_of(error)] += 1
        return
    if engine == "jax" and (model.eq_type <= int(mujoco.mjtEq.mjEQ_WELD)).any():
        tally["a connect or weld: MJX's own, of which check tells"] += 1
        return
    if engine == "jax":  # CG in float32 stops where it likes
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    try:
        physics = Physics(model, some_readings(model, rng), int(rng.choice([1, 2, 5])), engine)
    except (ValueError, UserError) as error:
        refusal(error, tally, "model")
        return
    try:
        follow(physics, model, {}, rng, 4, 0.0 if engine == "c" else JAX)
    except Vain:
        tally["not compared: a constraint that moves nothing, or a contact of convex shapes"] += 1
        return
    tally["stepped"] += 1
    if engine == "c":
        model = solved(model)
        physics = Physics(model, some_readings(model, rng), physics.substeps, engine)
        for _ in range(3):
            change(load, model, physics, rng, tally)


def main() -> int:
    plain_text = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        "tests.long.models", description=__doc__, formatter_class=plain_text
    )
    parser.add_argument("--engine", default="c")
    parser.add_argument("--number", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--files", nargs="*", default=())
    args = parser.parse_args()
    tally: Tally = collections.Counter()
    todo = drawn(args.engine, args.first) if not args.files else from_files(args.files)
    wrong = 0
    with quickly():
        for name, load, rng in todo:
            before = +tally
            try:
                try_model(load, args.engine, rng, tally)
            except Exception as error:  # noqa: BLE001
                wrong += 1
                print(f"{name}: {type(error).__name__}: {error}"[:400], flush=True)
            if args.files:
                print(name, dict(tally - before), flush=True)
            elif tally["stepped"] + wrong >= args.number:
                break
    for what, number in tally.most_common():
        print(f"{number:6} {what}")
    return int(wrong > 0)


def drawn(engine: str, first: int) -> Iterator[tuple[str, Load, Rng]]:
    """Yields models, each with its name and the numbers that are drawn for it."""
    for seed in itertools.count(first):
        rng = np.random.default_rng(seed)
        text = draw(rng) if engine == "c" else draw(rng, 2, 0.2 * (seed % 3))
        for name, other in INSTEAD.items() if engine == "jax" and seed % 4 else ():
            text = text.replace(name, other)
        yield f"seed {seed}", functools.partial(mujoco.MjSpec.from_string, text), rng


def from_files(paths: list[str]) -> Iterator[tuple[str, Load, Rng]]:
    """Yields the models of MJCF files."""
    for path in paths:
        yield path, functools.partial(mujoco.MjSpec.from_file, path), np.random.default_rng(0)


if __name__ == "__main__":
    sys.exit(main())
