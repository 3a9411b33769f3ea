"""dm_control's escape: a rodent climbs out of a bowl of bumps that differ in every episode.

It is paid for how far its head is from the middle, and for being upright; nothing but time ends an
episode. The ground of the physics is planes, one beneath each geom that can touch it, which lie
anew before each control step: see `bowls.py`.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl import (
    Array,
    Physics,
    PhysicsState,
    State,
    eyes as seeing,
    lookup,
    overflow_metric,
    overflow_reading,
)
from purerl.envs import bowls, sight
from purerl.envs.bodies import ANT, RODENT, Body
from purerl.envs.bowls import Bowl
from purerl.envs.compose import PREFIX, Composed, compose
from purerl.envs.feeling import READINGS, felt

BODIES = {"ant": ANT, "rodent": RODENT}
HEAD = {"rodent": "head"}  # the site that has to get out; none: the torso
UPRIGHT = {"ant": ("torso",), "rodent": ("torso", "pelvis")}  # the bodies that are to be
DEVIATION = float(np.cos(np.deg2rad(30.0)))  # least z of an up-axis for the whole reward
_ROUND = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    body: Literal["ant", "rodent"] = "rodent"
    """Which of dm_control's walkers; it has the ant in no bowl."""
    eyes: sight.Sight = sight.Sight()
    """Without eyes it is told how high the ground around it is."""
    substeps: int = 5
    """Physics steps in one control step."""


class Touching(NamedTuple):
    """The G geoms that can touch the ground, all capsules or spheres, and the plane of each."""

    geoms: np.ndarray  # [G] ids
    planes: np.ndarray  # [G] ids
    center: np.ndarray  # [G, 3] at rest, in the torso's frame [m]
    axis: np.ndarray  # [G, 3] from there to a capsule's end [m]
    radius: np.ndarray  # [G] [m]


@dataclasses.dataclass(frozen=True)
class Escape:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Composed
    bowl: Bowl
    touching: Touching
    action_size: int
    eyes: seeing.Eyes | None

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts in the middle, turned anyhow, above the ground."""
        bumps_key, turn_key, eyes_key = jax.random.split(key, 3)
        terrain = bowls.coefficients(self.bowl, bowls.draw_bumps(bumps_key, self.bowl))
        turn = jax.random.normal(turn_key, (4,))
        turn /= jnp.linalg.norm(turn)
        height = highest(self.bowl, terrain, self.parts.body.reach) - lowest(self.touching, turn)
        rest = jnp.asarray(self.physics.model.qpos0, jnp.float32)
        qpos = rest.at[:3].set(jnp.stack([0.0 * height, 0.0 * height, height])).at[3:7].set(turn)
        task = {"terrain": terrain, "eyes": sight.draw(eyes_key, self.options.eyes)}
        task["places"] = jnp.zeros((len(self.touching.geoms), 2))
        nothing = jnp.zeros(self.physics.model.nv)
        physics, readings = self.physics.init(qpos, nothing, self._planes(task))
        return self._state(physics, readings, task, jnp.zeros(self.action_size))

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl, self._planes(state.task))
        return self._state(physics, readings, state.task, action)

    def model_changes(self, state: State) -> dict[str, Array]:
        """Returns where the planes are in the step after this state."""
        return self._planes(state.task)

    def scenery(self, state: State) -> tuple[Array, Array]:
        """Returns the terrain as boxes for a video: centers and half sizes, [P, 3] each [m]."""
        return bowls.columns(self.bowl, state.task["terrain"], state.physics.qpos[:2])

    def _planes(self, task: dict) -> dict[str, Array]:
        place, turn = bowls.planes(self.bowl, task["terrain"], task["places"])
        model, ids = self.physics.model, self.touching.planes
        return {
            "geom_pos": jnp.float32(model.geom_pos).at[ids].set(place, unique_indices=True),
            "geom_quat": jnp.float32(model.geom_quat).at[ids].set(turn, unique_indices=True),
        }

    def _state(self, physics: PhysicsState, readings: Any, task: dict, action: Array) -> State:
        torso, body = self.parts.torso, self.parts.body
        place, axes = readings.xpos[torso], readings.xmat[torso]
        head = place
        if body.name in HEAD:
            site = lookup.find(self.physics.model, "site", PREFIX + HEAD[body.name])
            head = readings.site_xpos[site]
        distance = jnp.sqrt(jnp.square(head).sum())
        bodies = [lookup.find(self.physics.model, "body", PREFIX + n) for n in UPRIGHT[body.name]]
        up = readings.xmat[np.array(bodies), 2, 2].min()
        parts = [*felt(self.parts, physics, readings, action), -place @ axes]
        told = ground_around(self.bowl, task["terrain"], body, place, axes)
        if self.eyes is None:
            observation: Any = jnp.concatenate([*parts, told])
        else:
            heights = bowls.heights(self.bowl, task["terrain"])
            given = readings, task["eyes"], physics.time, self.options.eyes
            pictures = sight.look(self.eyes, *given, heights=heights)
            observation = {"policy": jnp.concatenate(parts), "eyes": pictures, "privileged": told}
        escaped = (distance > self.bowl.half).astype(jnp.float32)
        metrics = {"distance": distance, "up": up, "escaped": escaped}
        return State(
            physics=physics,
            observation=observation,
            reward=reward_of(self.bowl, distance, up),
            terminated=jnp.zeros((), bool),
            truncated=jnp.zeros((), bool),
            metrics=metrics | overflow_metric(readings),
            task=task | {"places": readings.geom_xpos[self.touching.geoms, :2]},
        )


def reward_of(bowl: Bowl, distance: Array, up: Array) -> Array:
    """Returns dm_control's reward [] for a head at `distance` [] from the middle [m].

    `up` is the least z of the up-axes that should be upright, [].
    """
    upright = jnp.clip(1.0 + (up - DEVIATION) / (1.0 + DEVIATION), 0.0, 1.0)
    return upright * jnp.clip(distance / bowl.half, 0.0, 1.0)


def highest(bowl: Bowl, terrain: Array, reach: float) -> Array:
    """Returns how high the ground is at most within `reach` of the middle along x and y, [] [m]."""
    number = int(np.ceil(reach / bowl.cell))
    along = np.arange(-number, number + 1) * bowl.cell
    corners = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    return bowls.ground(bowl, terrain, jnp.float32(corners))[0].max()


def lowest(touching: Touching, turn: Array) -> Array:
    """Returns how high above the torso the body's lowest point is at rest, turned by `turn` [4].

    A body whose lowest point is where the ground is highest touches nothing. dm_control lifts it
    by 1 cm until that is so: it then begins up to 3 cm lower, which is how uneven the middle is.
    """
    w, x, y, z = turn
    up = jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    center, axis = ((v * up).sum(1) for v in (touching.center, touching.axis))
    return (center - jnp.abs(axis) - touching.radius).min()


def ground_around(bowl: Bowl, terrain: Array, body: Body, place: Array, axes: Array) -> Array:
    """Returns how high the ground around a torso is, seen from it, [40] [m].

    Args:
      bowl: its sizes.
      terrain: coefficients [B, B].
      body: from its reach behind to as far ahead as it is told of edges, its reach to both sides.
      place: of the torso [3] [m].
      axes: of the torso [3, 3]; which way is ahead, seen from above.
    """
    ahead = axes[:2, 0] / jnp.maximum(jnp.sqrt(jnp.square(axes[:2, 0]).sum()), 1e-6)
    aside = jnp.stack([-ahead[1], ahead[0]])
    x, y = np.meshgrid(np.linspace(-body.reach, body.sight, 8), body.reach * np.linspace(-1, 1, 5))
    around = place[:2] + x.reshape(-1, 1) * ahead + y.reshape(-1, 1) * aside
    return bowls.ground(bowl, terrain, around)[0] - place[2]


def find_touching(parts: Composed) -> Touching:
    """Looks up the geoms that pairs let touch the ground, each with its plane."""
    model, data = parts.model, mujoco.MjData(parts.model)
    mujoco.mj_kinematics(model, data)
    pairs = np.stack([model.pair_geom1, model.pair_geom2], axis=1)
    flat = model.geom_type[pairs] == mujoco.mjtGeom.mjGEOM_PLANE
    geoms = pairs[~flat]
    assert np.isin(model.geom_type[geoms], _ROUND).all()
    size, axes = model.geom_size[geoms], data.geom_xmat[geoms].reshape(-1, 3, 3)
    away = data.geom_xpos[geoms] - data.xpos[parts.torso]
    return Touching(geoms, pairs[flat], away, axes[:, :, 2] * size[:, 1:2], size[:, 0])


def build(options: Options = Options(), engine: str = "auto") -> Escape:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    body, bowl = BODIES[options.body], Bowl()
    parts = compose(body, bowl, engine)
    readings = (*READINGS, "geom_xpos", "site_xpos", *overflow_reading(engine))
    eye = seeing.of_camera(parts.looks, PREFIX + body.camera)
    return Escape(
        options=options,
        physics=Physics(parts.model, readings, options.substeps, engine),
        parts=parts,
        bowl=bowl,
        touching=find_touching(parts),
        action_size=parts.model.nu,
        eyes=sight.build(parts.looks, eye, body.eye_distance, options.eyes, ()),
    )
