"""What all domains of the suite share: the environment around a domain, and how episodes start."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import (
    Array,
    Physics,
    PhysicsState,
    State,
    choose_engine,
    lookup,
    overflow_metric,
    overflow_reading,
)

_JOINT = mujoco.mjtJoint
_GEOM = mujoco.mjtGeom
_KNOWN = [int(g) for g in (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE)]
EPISODE_STEPS = 1000  # of every task: its time limit over its control time step


class Start(NamedTuple):
    """How an episode starts."""

    qpos: Array  # [nq]
    qvel: Array  # [nv]
    changes: dict[str, Array]  # this episode's model fields, such as where the target is


class Moment(NamedTuple):
    """What an observation and a reward are functions of."""

    physics: PhysicsState
    readings: Any  # the domain's READINGS
    ctrl: Array  # [nu] the action that led here


class Domain(Protocol):
    """One task of one domain: three pure functions over names looked up at construction."""

    def start(self, key: Array) -> Start:
        """Draws the start of an episode."""
        ...

    def observe(self, moment: Moment) -> Array:
        """Returns the observation [O]."""
        ...

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Returns the reward's parts, [] each, reported as metrics, and itself as "reward"."""
        ...


@dataclass(frozen=True)
class SuiteEnv:
    """A domain as an environment."""

    domain: Domain
    physics: Physics
    action_size: int

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts where dm_control's task would."""
        start = self.domain.start(key)
        physics, readings = self.physics.init(start.qpos, start.qvel, start.changes)
        return self.state(physics, readings, jnp.zeros(self.action_size), start.changes)

    def step(self, state: State, action: Array) -> State:
        """Advances one control step; action [A] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl, self.model_changes(state))
        return self.state(physics, readings, ctrl, state.task)

    def model_changes(self, state: State) -> dict[str, Array]:
        """Returns this episode's model fields, such as where a target is (for a video too)."""
        return state.task

    def state(self, physics: PhysicsState, readings, ctrl: Array, changes: dict) -> State:
        """Observes and rewards a moment."""
        moment = Moment(physics, readings, ctrl)
        parts = {k: jnp.float32(v) for k, v in self.domain.reward(moment).items()}
        parts |= overflow_metric(readings)
        return State(
            physics=physics,
            observation=self.domain.observe(moment).astype(jnp.float32),
            reward=parts.pop("reward"),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            metrics=parts,
            task=changes,
        )


def load_model(
    physics: Any, xml: tuple[str, dict[str, bytes]], engine: str, iterations: int = 4
) -> mujoco.MjModel:
    """Compiles a domain's own MJCF, given its dm_control Physics class, XML and assets.

    `iterations` bound Newton's method, with 8 steps of line search each, for MJX only. By XLA the
    whole batch pays for each iteration that any environment needs, and the models ask for up to
    200. C stops each simulation when it has converged.
    """
    model = physics.from_xml_string(*xml).model.ptr
    disable_energy(model)
    mask_disabled_contacts(model)
    if choose_engine(engine) == "jax":
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        model.opt.iterations, model.opt.ls_iterations = iterations, 8
    return model


def disable_energy(model: mujoco.MjModel) -> None:
    """Stops the computation of the total energy: nothing reads it, and MJX does not have it."""
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)


def mask_disabled_contacts(model: mujoco.MjModel) -> None:
    """Masks all geoms of a model whose contacts, or all constraints, are disabled.

    It changes nothing, but MJX refuses a pair of shapes that it could not collide, even there.
    """
    without = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if model.opt.disableflags & without:
        model.geom_contype[:] = model.geom_conaffinity[:] = 0


def make_env(
    domain: Domain,
    model: mujoco.MjModel,
    readings: tuple[str, ...],
    control_timestep: float,
    engine: str,
) -> SuiteEnv:
    """Puts a domain on an engine; `control_timestep` [s] must be a multiple of the model's."""
    substeps = round(control_timestep / model.opt.timestep)
    readings += overflow_reading(engine)
    return SuiteEnv(domain, Physics(model, readings, substeps, engine), model.nu)


def check_task(task: str, tasks: tuple[str, ...]) -> None:
    """Raises for a task that the domain does not have."""
    if task not in tasks:
        raise ValueError(lookup.unknown_name("task", task, tasks))


def random_joints(model: mujoco.MjModel, key: Array) -> Array:
    """Draws qpos [nq] as dm_control does: limited joints within their range, hinges all around.

    A free joint gets an orientation with all four numbers of its quaternion positive (dm_control
    keeps this for the sake of old results), and stays where it is; so do unlimited slides.
    """
    low, high = np.array(model.qpos0), np.array(model.qpos0)
    free = []
    for kind, start, limited, limits in zip(
        model.jnt_type, model.jnt_qposadr, model.jnt_limited, model.jnt_range, strict=True
    ):
        if kind == _JOINT.mjJNT_BALL:
            raise ValueError("random_joints has no ball joints: no task of the suite needs them.")
        if kind == _JOINT.mjJNT_FREE:
            free.append(int(start) + 3)
            low[start + 3 : start + 7], high[start + 3 : start + 7] = 0.0, 1.0
        elif limited:
            low[start], high[start] = limits
        elif kind == _JOINT.mjJNT_HINGE:
            low[start], high[start] = -np.pi, np.pi
    qpos = low + (high - low) * jax.random.uniform(key, (model.nq,), jnp.float32)
    for at in free:
        quat = jax.lax.dynamic_slice(qpos, (at,), (4,))
        qpos = jax.lax.dynamic_update_slice(qpos, quat / jnp.linalg.norm(quat), (at,))
    return qpos


def draw_apart(
    draw: Callable[[Array], Array], geoms: Physics, pairs: np.ndarray, key: Array, candidates: int
) -> Array:
    """Draws a qpos in which nothing touches: the first such of several candidates.

    dm_control draws until it finds one; where all candidates touch, this takes the one that
    touches least, which keeps the cost of a reset fixed.

    Args:
      draw: key -> qpos [nq].
      geoms: physics whose readings include geom_xpos and geom_xmat.
      pairs: [n, 2] geom ids that can touch (`touching_pairs`).
      key: typed key [].
      candidates: how many to draw.

    Returns:
      [nq]
    """
    qpos = jax.vmap(draw)(jax.random.split(key, candidates))
    still = jnp.zeros(geoms.model.nv)
    readings = jax.vmap(lambda q: geoms.init(q, still)[1])(qpos)
    gap = jax.vmap(lambda r: least_gap(geoms.model, pairs, r.geom_xpos, r.geom_xmat))(readings)
    return qpos[first_apart(gap)]


def first_apart(gap: Array) -> Array:
    """Returns the first index [] at which nothing touches, by least gaps [n] m, or the best one."""
    # `argmax` takes the first of equals: all that touch nothing count as equal.
    return jnp.argmax(jnp.minimum(gap, 0.0))


def touching_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Lists the pairs of planes, spheres and capsules that can touch: [n, 2] int, planes first.

    By MuJoCo's rules: not of one body nor of a body and its parent, masks match, not excluded.
    The suite's other colliding shapes are the finger's cylinders, which lie within capsules or out
    of reach: nothing touches them first.
    """
    known = np.isin(model.geom_type, _KNOWN)
    weld, parent = model.body_weldid, model.body_parentid
    excluded = {int(s) for s in model.exclude_signature}
    pairs = []
    for i in range(model.ngeom):
        for j in range(i + 1, model.ngeom):
            a, b = sorted((weld[model.geom_bodyid[i]], weld[model.geom_bodyid[j]]))
            masks = model.geom_contype[i] & model.geom_conaffinity[j]
            masks |= model.geom_contype[j] & model.geom_conaffinity[i]
            related = a == b or (a != 0 and weld[parent[b]] == a)
            bodies = sorted((model.geom_bodyid[i], model.geom_bodyid[j]))
            shapes = known[i] and known[j]
            if (
                shapes
                and masks
                and not related
                and (int(bodies[0]) << 16) + int(bodies[1]) not in excluded
            ):
                planes = model.geom_type[j] == _GEOM.mjGEOM_PLANE
                pairs.append((j, i) if planes else (i, j))
    return np.array(pairs, int).reshape(-1, 2)


def least_gap(model: mujoco.MjModel, pairs: np.ndarray, xpos: Array, xmat: Array) -> Array:
    """Returns the least distance between the surfaces of pairs of planes, spheres and capsules.

    Args:
      model: for the sizes.
      pairs: [n, 2] geom ids, planes first.
      xpos: [ngeom, 3] centres [m].
      xmat: [ngeom, 3, 3] orientations; a capsule lies along its z axis, a plane across it.

    Returns:
      [] m; negative where two overlap.
    """
    capsule = model.geom_type == _GEOM.mjGEOM_CAPSULE
    half = jnp.where(capsule, model.geom_size[:, 1], 0.0)[:, None] * xmat[:, :, 2]
    plane = model.geom_type[pairs[:, 0]] == _GEOM.mjGEOM_PLANE
    first, second = pairs[~plane].T
    between = jax.vmap(segment_distance)(xpos[first], half[first], xpos[second], half[second])
    between -= jnp.asarray(model.geom_size[first, 0] + model.geom_size[second, 0])
    floor, above = pairs[plane].T
    normal = xmat[floor, :, 2]
    height = jnp.sum((xpos[above] - xpos[floor]) * normal, axis=1)
    height -= jnp.abs(jnp.sum(half[above] * normal, axis=1)) + jnp.asarray(
        model.geom_size[above, 0]
    )
    return jnp.min(jnp.concatenate([between, height]))


def segment_distance(a: Array, u: Array, b: Array, v: Array) -> Array:
    """Distance [] between the segments a + s u and b + t v, s and t in [-1, 1]; [3] each.

    For a given s the best t is a clipped projection and the other way round; the least distance
    is inside, or at one of four ends (Ericson 2005, Real-Time Collision Detection, 5.1.9).
    """
    r, uu, vv, uv = b - a, u @ u, v @ v, u @ v
    tiny = 1e-12  # [m^4] or [m^2]: a sphere is a segment of no length
    inside = ((r @ u) * vv - (r @ v) * uv) / (uu * vv - uv * uv + tiny)
    s = jnp.clip(jnp.stack([inside, 1.0, -1.0]), -1.0, 1.0)
    t = jnp.clip((s * uv - r @ v) / (vv + tiny), -1.0, 1.0)
    s = jnp.clip((t * uv + r @ u) / (uu + tiny), -1.0, 1.0)
    apart = r + t[:, None] * v - s[:, None] * u
    return jnp.sqrt(jnp.min(jnp.sum(apart**2, axis=1)))
