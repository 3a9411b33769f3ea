"""Which parts of a body are compared with a recording: of dm_control's walkers, or of any MJCF."""

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from purerl import PhysicsState, UserError, lookup
from purerl.envs.arenas import Floor
from purerl.envs.bodies import ANT, HUMANOID, RODENT
from purerl.envs.compose import PREFIX, compose
from purerl.envs.tracking import Pose

BODIES = {"ant": ANT, "rodent": RODENT, "humanoid": HUMANOID}
HEADS = {"rodent": ("skull",), "humanoid": ("head",)}  # limbs too
# The parts that are compared; of other bodies all are. Small bones follow from these.
_LIMBS = ("upper_leg", "lower_leg", "foot", "scapula", "upper_arm", "lower_arm", "finger")
_RODENT = (
    "torso",
    "pelvis",
    "skull",
    "jaw",
    *(f"{name}_{side}" for name in _LIMBS for side in "LR"),
)
COMPARED = {"rodent": _RODENT}
SENSORS = {
    "ant": ("torso_accel", "torso_vel", "torso_gyro"),
    "rodent": ("accelerometer", "velocimeter", "gyro", "palm_L", "palm_R", "sole_L", "sole_R"),
    "humanoid": (
        *(f"sensor_root_{name}" for name in ("accel", "veloc", "gyro")),
        *(f"sensor_touch_{side}{part}" for side in "lr" for part in ("foot", "toes")),
    ),
}
_KIND = mujoco.mjtSensor
_MOTION = (int(_KIND.mjSENS_VELOCIMETER), int(_KIND.mjSENS_GYRO))
FELT = (int(_KIND.mjSENS_ACCELEROMETER), *_MOTION, int(_KIND.mjSENS_TOUCH))
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)


class Parts(NamedTuple):
    """A compiled body, and where what is compared stands in the model's arrays."""

    model: mujoco.MjModel
    torso: int  # body id
    bodies: tuple[int, ...]  # ids of those that are compared, B
    ends: tuple[int, ...]  # which of these are where limbs end
    qpos: tuple[int, ...]  # of its joints, without a free one, J
    qvel: tuple[int, ...]  # of the same
    dofs: tuple[int, ...]  # in qvel, of all its joints
    sensors: tuple[int, ...]  # in sensordata: acceleration, velocity, turning, touch
    free: tuple[int, ...]  # of a free joint in qvel [6], if no sensor tells how the body moves


def find(body: str, ends: tuple[str, ...], engine: str, timestep: float) -> Parts:
    """Compiles a body on its floor, and looks its parts up.

    Args:
      body: ant, rodent, humanoid, or the path of an MJCF file.
      ends: bodies where limbs end; (): those of a body that is known.
      engine: of the physics, which decides the solver's settings of a body that is known.
      timestep: of the physics [s].

    Raises:
      UserError: there is no such body or file, or it is none that can be compared.
    """
    if body in BODIES:
        composed = compose(BODIES[body], Floor(), engine, timestep, sensors=SENSORS[body])
        return of_model(composed.model, body, ends)
    if not body.endswith(".xml"):
        there = ", ".join(sorted(BODIES))
        raise UserError(f"body is {body!r}: give the path of an MJCF file (.xml), or {there}.")
    if not ends:
        raise UserError(f"Name the bodies of {body} where limbs end: end_effectors.")
    model = _compiled(Path(body))
    model.opt.timestep = timestep
    return _parts(model, ends)


def of_model(model: mujoco.MjModel, body: str, ends: tuple[str, ...] = ()) -> Parts:
    """Looks up the parts of a body that is known, composed with its `SENSORS`, in any arena."""
    known, heads = BODIES[body], HEADS.get(body, ())
    limbs = ends or (*known.end_effectors, *heads)
    return _parts(model, limbs, COMPARED.get(body, ()), known.torso, PREFIX)


def readings(parts: Parts) -> tuple[str, ...]:
    """Returns what `pose_of` and `feeling.proprioception` read."""
    return ("xpos", "xquat", "xmat", "qfrc_actuator") + ("sensordata",) * bool(parts.sensors)


def pose_of(parts: Parts, physics: PhysicsState, readings: Any) -> Pose:
    """Returns how the body is."""
    return Pose(
        place=readings.xpos[parts.torso],
        turn=readings.xquat[parts.torso],
        joints=physics.qpos[np.array(parts.qpos)],
        speeds=physics.qvel[np.array(parts.qvel)],
        bodies=readings.xpos[np.array(parts.bodies)],
    )


def _compiled(path: Path) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise UserError(f"{path} is no body: {' '.join(str(error).split())}") from error


def _parts(
    model: mujoco.MjModel, ends: tuple[str, ...], names: tuple[str, ...] = (),
    torso: str = "", prefix: str = "",
) -> Parts:  # fmt: skip
    """Looks up the parts of a body, all of whose names begin with `prefix`."""
    limbs = [_body(model, prefix + name) for name in ends]
    root = int(model.body_rootid[limbs[0]])
    trunk = lookup.find(model, "body", prefix + torso) if torso else root
    own = [i for i in range(trunk, model.nbody) if model.body_rootid[i] == root]
    bodies = list(dict.fromkeys([*([_body(model, prefix + n) for n in names] or own), *limbs]))
    joints = [i for i in range(model.njnt) if model.body_rootid[model.jnt_bodyid[i]] == root]
    if balls := [i for i in joints if model.jnt_type[i] == BALL]:
        name = model.joint(balls[0]).name
        raise UserError(f"Joint {name!r} is a ball: what is compared are hinges and slides.")
    hinges = [i for i in joints if model.jnt_type[i] != FREE]
    dofs = np.flatnonzero(model.body_rootid[model.dof_bodyid] == root)
    sensors, moves = _sensors(model, root)
    return Parts(
        model=model,
        torso=trunk,
        bodies=tuple(bodies),
        ends=tuple(bodies.index(i) for i in limbs),
        qpos=tuple(model.jnt_qposadr[hinges].tolist()),
        qvel=tuple(model.jnt_dofadr[hinges].tolist()),
        dofs=tuple(dofs.tolist()),
        sensors=sensors,
        free=tuple(dofs[:6].tolist()) if len(hinges) < len(joints) and not moves else (),
    )


def _sensors(model: mujoco.MjModel, root: int) -> tuple[tuple[int, ...], bool]:
    """Returns where a body's sensors stand in sensordata, and whether they tell how it moves."""
    places, kinds = list[int](), set[int]()
    for kind in FELT:
        for i in np.flatnonzero(model.sensor_type == kind):
            if model.body_rootid[model.site_bodyid[model.sensor_objid[i]]] == root:
                places += range(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i])
                kinds.add(kind)
    return tuple(places), set(_MOTION) <= kinds


def _body(model: mujoco.MjModel, name: str) -> int:
    try:
        return lookup.find(model, "body", name)
    except ValueError as error:
        raise UserError(f"end_effectors: {error}") from error
