"""Puts a body into an arena with dm_control's PyMJCF, and names what came out.

Every difference from what dm_control would compile is one function here, with its reason: first
those made to the MJCF, then those made to the compiled model. They are the same for every engine;
only the solver's settings differ (`set_solver`).
"""

import copy
import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf

from purerl import choose_engine, lookup
from purerl.envs.arenas import (
    GROUND,
    TARGET,
    Arena,
    BoxFields,
    box_fields,
    build_arena,
    check_passable,
)
from purerl.envs.bodies import Body
from purerl.envs.bowls import Bowl, with_planes

PREFIX = "walker/"  # composing puts it before the names of the body's parts
TORSO_VELOCITY = "torso_velocity"  # a sensor of the walker's centre of mass [m/s]
# Newton's (iterations, line-search iterations) in C, which stops when it has converged, and is
# fastest when it may. In MJX the whole batch pays for every iteration: see `Body.mjx_iterations`.
C_ITERATIONS = (100, 50)
_GEOM = mujoco.mjtGeom
_NO_BOX_CONTACT = (_GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_SDF)


@dataclasses.dataclass(frozen=True)
class Composed:
    """A compiled body in its arena, with everything looked up by name once."""

    model: mujoco.MjModel
    body: Body
    arena: Arena
    torso: int  # body id; its subtree is the walker and nothing else
    end_effectors: tuple[int, ...]  # body ids
    joints: tuple[int, ...]  # ids of the walker's own joints, without the free one
    qpos: tuple[int, ...]  # where they stand in qpos
    qvel: tuple[int, ...]  # where they stand in qvel
    boxes: BoxFields  # the corridor's movable boxes; none on a floor
    looks: mujoco.MjModel  # as it was compiled, before it was simplified: what eyes see


def compose(
    body: Body,
    arena: Arena,
    engine: str = "auto",
    timestep: float | None = None,
    self_collision: bool = False,
    sensors: Sequence[str] = (),
) -> Composed:
    """Attaches a body to an arena by a free joint and compiles the result.

    The free joint's position (`qpos[:3]`) is the torso's own. In `qpos0` the body stands at its
    `spawn_height`, at x = 0 on a floor and at `spawn_x` in a corridor.

    Args:
      body: of `purerl.envs.bodies`.
      arena: of `purerl.envs.arenas`.
      engine: as for `purerl.physics.interface.Physics`; decides the solver's settings only.
      timestep: of physics [s]; the body's own if None.
      self_collision: whether parts of the body can touch each other.
      sensors: names of the body's sensors to keep.

    Raises:
      ValueError: the body lacks a part that its record names, cannot pass the corridor, or has
        contacts that MJX lacks.
    """
    check_passable(arena, body)
    root, walker = build_arena(arena), body.build()
    check_parts(walker, body)
    keep_sensors(walker, sensors)
    add_torso_velocity(walker, body)
    attach(root, walker, body, getattr(arena, "spawn_x", 0.0))
    model = mjcf.Physics.from_mjcf_model(root).model.ptr
    looks = copy.copy(model)
    if isinstance(arena, Bowl):
        names = lookup.names(model, "geom")
        touching = [n for n in names if n.startswith(PREFIX) and _touches_ground(model, n, body)]
        model = with_planes(root, GROUND, touching)
    mask_contacts(model, body, self_collision)
    round_ellipsoids(model)
    free_boxes(model)
    set_solver(model, body, choose_engine(engine), timestep or body.timestep)
    check_contacts(model, body)
    return _name_parts(model, looks, body, arena)


def find_part(walker: mjcf.RootElement, kind: str, name: str) -> mjcf.Element:
    """Looks up an element of the body's MJCF; the error lists the names there are."""
    element = walker.find(kind, name)
    if element is None:
        names = [e.name for e in walker.find_all(kind) if e.name]
        raise ValueError(lookup.unknown_name(kind, name, names))
    return element


# Changes to the MJCF.


def check_parts(walker: mjcf.RootElement, body: Body) -> None:
    """Raises unless the MJCF has all parts that the body's record names."""
    for name in (body.torso, *body.end_effectors):
        find_part(walker, "body", name)
    for name in body.ground_geoms:
        find_part(walker, "geom", name)


def keep_sensors(walker: mjcf.RootElement, names: Sequence[str]) -> None:
    """Removes the sensors that nobody asked for.

    The ant carries 54, of which 8 are rays cast against every geom at every physics step.
    """
    kept = [find_part(walker, "sensor", name) for name in names]
    for sensor in walker.find_all("sensor"):
        if sensor not in kept:
            sensor.remove()


def add_torso_velocity(walker: mjcf.RootElement, body: Body) -> None:
    """Adds a sensor of the velocity of the walker's centre of mass, under one name for all.

    MuJoCo computes `subtree_linvel` only for a model with such a sensor.
    """
    walker.sensor.add("subtreelinvel", name=TORSO_VELOCITY, body=body.torso)


def attach(root: mjcf.RootElement, walker: mjcf.RootElement, body: Body, x: float) -> None:
    """Attaches the walker by a free joint whose frame is the torso's.

    dm_control keeps the torso's height (and for the rodent 3 cm of x) inside the body, so that the
    joint's frame is a point below the torso, and what is read from `qpos` is not the torso's.
    """
    walker.model = PREFIX.rstrip("/")
    find_part(walker, "body", body.torso).pos = [0, 0, 0]
    frame = root.attach(walker)
    frame.pos = [x, 0, body.spawn_height]
    frame.add("freejoint")


# Changes to the compiled model.


def mask_contacts(model: mujoco.MjModel, body: Body, self_collision: bool) -> None:
    """Lets the body's `ground_geoms` touch the ground, and nothing else unless asked.

    MJX computes every candidate pair at every step, and for the rodent even C is twice as fast so
    (measured: 2470 against 1240 control steps/s). It stays stable under random actions.
    """
    for i in range(model.ngeom):
        name = model.geom(i).name
        ground = not name.startswith(PREFIX) and not name.startswith(TARGET)
        chosen = _touches_ground(model, name, body)
        model.geom_contype[i] = 0 if ground else int(chosen)
        # As shipped, a geom with conaffinity 0 touches the ground and not its own kind.
        own = int(chosen and self_collision and model.geom_conaffinity[i] > 0)
        # Where there are pairs, as in a bowl, they alone say what touches the ground.
        model.geom_conaffinity[i] = int(not model.npair) if ground else own


def _touches_ground(model: mujoco.MjModel, name: str, body: Body) -> bool:
    if body.ground_geoms:
        return name.removeprefix(PREFIX) in body.ground_geoms
    return bool(model.geom(name).contype[0] > 0)


def round_ellipsoids(model: mujoco.MjModel) -> None:
    """Makes a capsule of each ellipsoid that can touch something: MJX has no ellipsoid and box.

    The capsule is as long as the ellipsoid, and as thick as its thinnest axis, so it stays within
    all bounding boxes and spheres that MuJoCo compiled. Masses and inertias do not change.
    """
    for i in np.flatnonzero(model.geom_type == _GEOM.mjGEOM_ELLIPSOID):
        if model.geom_contype[i] or model.geom_conaffinity[i]:
            _make_capsule(model, int(i))


# Rotations that turn z, a capsule's axis, onto x, y, z.
_ONTO_AXIS = np.array([[1, 0, 1, 0], [1, -1, 0, 0], [1, 0, 0, 0]]) / np.sqrt([[2], [2], [1]])


def _make_capsule(model: mujoco.MjModel, geom: int) -> None:
    radii, quat = model.geom_size[geom].copy(), model.geom_quat[geom].copy()
    longest, radius = int(np.argmax(radii)), radii.min()
    mujoco.mju_mulQuat(model.geom_quat[geom], quat, _ONTO_AXIS[longest])
    model.geom_type[geom] = _GEOM.mjGEOM_CAPSULE
    model.geom_size[geom] = [radius, radii[longest] - radius, 0]
    model.geom_aabb[geom] = [0, 0, 0, radius, radius, radii[longest]]
    model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def free_boxes(model: mujoco.MjModel) -> None:
    """Makes MuJoCo look for the corridor's boxes where they are, not where they were compiled.

    It marks a geom that is compiled in its body's own frame, and then never looks at `geom_pos`;
    and it skips parts of a body by bounding volumes that are made when the model is compiled
    (midphase): with those, the rodent lost half of its contacts with a box that had moved.
    """
    boxes = [i for i in range(model.ngeom) if model.geom(i).name.startswith(f"{GROUND}_")]
    model.geom_sameframe[boxes] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    if boxes:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)


def set_solver(model: mujoco.MjModel, body: Body, engine: str, timestep: float) -> None:
    """Newton's method, pyramidal cones, no slip solver, `timestep` [s].

    dm_control's arenas have elliptic cones, which cost MJX more for no gain in these tasks, and 5
    iterations that take remaining slip out of contacts, which MJX does not know and leaves out
    without a word: contact forces were 1 to 2% off C's (an ant parted from C by 1 mm in a step; now
    by 0.1 um), and MJX-Warp spent half to four fifths of its time on them.
    Implicit damping (eulerdamp) stays on: without it the rodent is NaN at once. For MJX matrices
    are dense: a body of 60 degrees of freedom and more gets sparse ones by default, which bring
    more sums whose order has to be fixed, and a larger program (rodent: 7.6 MB of HLO, not 5.3).
    """
    model.opt.timestep = timestep
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.opt.noslip_iterations = 0
    model.opt.iterations, model.opt.ls_iterations = C_ITERATIONS
    if engine == "jax":
        model.opt.iterations, model.opt.ls_iterations = body.mjx_iterations
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE


def check_contacts(model: mujoco.MjModel, body: Body) -> None:
    """Raises if a part that can touch the ground has a shape for which MJX lacks the contact."""
    ground = [i for i in range(model.ngeom) if not model.geom(i).name.startswith(PREFIX)]
    boxes = [i for i in ground if model.geom_type[i] == _GEOM.mjGEOM_BOX]
    for i in range(model.ngeom):
        kind = _GEOM(model.geom_type[i])
        if boxes and model.geom_contype[i] and kind in _NO_BOX_CONTACT:
            shape = kind.name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"MJX has no contact of a {shape} ({model.geom(i).name!r}) with a box (the "
                f"corridor's ground): leave it out of the {body.name}'s ground_geoms, or make it "
                "a capsule or a sphere."
            )


def _name_parts(model: mujoco.MjModel, looks: mujoco.MjModel, body: Body, arena: Arena) -> Composed:
    boxes = tuple(
        lookup.find(model, "geom", f"{GROUND}_{i}") for i in range(getattr(arena, "boxes", 0))
    )
    free = mujoco.mjtJoint.mjJNT_FREE
    joints = tuple(i for i in range(model.njnt) if model.jnt_type[i] != free)
    own = [lookup.names(model, "joint")[i] for i in joints]
    return Composed(
        model=model,
        body=body,
        arena=arena,
        torso=lookup.find(model, "body", PREFIX + body.torso),
        end_effectors=tuple(lookup.find(model, "body", PREFIX + n) for n in body.end_effectors),
        joints=joints,
        qpos=tuple(lookup.qpos_indices(model, own).tolist()),
        qvel=tuple(lookup.qvel_indices(model, own).tolist()),
        boxes=box_fields(model, boxes),
        looks=looks,
    )
