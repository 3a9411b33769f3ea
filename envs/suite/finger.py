"""Finger: spin a free body on a hinge, at 15 rad/s or more, or turn its tip to a target.

20 ms a step. The target is large (turn_easy) or small (turn_hard), and another one in each episode:
a model field of that environment.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import finger

from purerl import Array, Physics, lookup
from purerl.envs.suite.base import (
    Moment,
    Start,
    SuiteEnv,
    check_task,
    draw_apart,
    load_model,
    make_env,
    random_joints,
    touching_pairs,
)

TARGET_SIZES = {"spin": 0.0, "turn_easy": 0.07, "turn_hard": 0.03}  # radius [m]; 0: no target
SPIN = 15.0  # [rad/s], in the negative direction
SPINNER_DAMPING = 0.03  # dm_control lowers the hinge's to spin [N m s/rad]
CANDIDATES = 16  # starting poses to draw, to have one in which nothing touches
READINGS = ("sensordata",)
_IN_OBSERVATION = ("proximal_velocity", "distal_velocity", "hinge_velocity")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "spin"  # "spin", "turn_easy" or "turn_hard"


@dataclass(frozen=True)
class Finger:
    """The domain; `build` makes an environment of it."""

    target_size: float  # radius [m]; 0 to spin
    geoms: Physics  # to see what touches in a starting pose
    angles: tuple[int, ...]  # all of these in sensordata
    velocities: tuple[int, ...]
    touch: tuple[int, ...]
    tip: slice
    spinner: slice
    target: slice
    target_site: int
    circle: tuple[float, float, float]  # that the target is on: x and z of the hinge, radius [m]

    def start(self, key: Array) -> Start:
        """Any pose in which nothing touches, at rest; to turn, a target anywhere on its circle."""
        still = jnp.zeros(self.geoms.model.nv)
        if not self.target_size:
            return Start(self._draw_pose(key), still, {})
        pose_key, target_key = jax.random.split(key)
        return Start(self._draw_pose(pose_key), still, {"site_pos": self._draw_target(target_key)})

    def _draw_pose(self, key: Array) -> Array:
        model = self.geoms.model
        draw = partial(random_joints, model)
        return draw_apart(draw, self.geoms, touching_pairs(model), key, CANDIDATES)

    def _draw_target(self, key: Array) -> Array:
        """All sites' places with the target on its circle: [nsite, 3] m."""
        angle = jax.random.uniform(key, minval=-np.pi, maxval=np.pi)
        x, z, radius = self.circle
        place = jnp.stack([x + radius * jnp.sin(angle), z + radius * jnp.cos(angle)])
        site_pos = jnp.float32(self.geoms.model.site_pos)
        return site_pos.at[self.target_site, jnp.array([0, 2])].set(place)

    def observe(self, moment: Moment) -> Array:
        """Finger's angles, tip of the spinner, velocities, log(1 + force [N]): [9].

        To turn, also the target from the hinge, and how far the tip is from its edge [m]: [12].
        """
        sensors = moment.readings.sensordata
        tip = self._from_hinge(moment, self.tip)
        touch = jnp.log1p(sensors[jnp.array(self.touch)])
        angles, velocities = jnp.array(self.angles), jnp.array(self.velocities)
        parts = [sensors[angles], tip, sensors[velocities], touch]
        if self.target_size:
            parts += [self._from_hinge(moment, self.target), self._to_edge(moment)[None]]
        return jnp.concatenate(parts)

    def reward(self, moment: Moment) -> dict[str, Array]:
        """1 while spinning fast, or with the tip in the target."""
        if self.target_size:
            edge = self._to_edge(moment)
            return {"reward": (edge <= 0).astype(jnp.float32), "distance": edge}
        velocity = moment.readings.sensordata[self.velocities[2]]
        return {"reward": (velocity <= -SPIN).astype(jnp.float32), "spin": -velocity}

    def _from_hinge(self, moment: Moment, sensor: slice) -> Array:
        sensors = moment.readings.sensordata
        return (sensors[sensor] - sensors[self.spinner])[jnp.array([0, 2])]

    def _to_edge(self, moment: Moment) -> Array:
        target, tip = (self._from_hinge(moment, sensor) for sensor in (self.target, self.tip))
        return jnp.linalg.norm(target - tip) - self.target_size


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, tuple(TARGET_SIZES))
    model = load_model(finger.Physics, finger.get_model_and_assets(), engine)
    target = lookup.find(model, "site", "target")
    if options.task == "spin":
        model.dof_damping[lookup.qvel_indices(model, ["hinge"])] = SPINNER_DAMPING
    else:
        model.site_size[target, 0] = TARGET_SIZES[options.task]
    domain = Finger(
        target_size=TARGET_SIZES[options.task],
        geoms=Physics(model, ("geom_xpos", "geom_xmat"), 1, engine),
        angles=_places(model, ("proximal", "distal")),
        velocities=_places(model, _IN_OBSERVATION),
        touch=_places(model, ("touchtop", "touchbottom")),
        tip=lookup.sensor_slice(model, "tip"),
        spinner=lookup.sensor_slice(model, "spinner"),
        target=lookup.sensor_slice(model, "target"),
        target_site=target,
        circle=_circle(model),
    )
    return make_env(domain, model, READINGS, 0.02, engine)


def _places(model, names: tuple[str, ...]) -> tuple[int, ...]:
    """Where one-number sensors stand in sensordata."""
    return tuple(lookup.sensor_slice(model, name).start for name in names)


def _circle(model: mujoco.MjModel) -> tuple[float, float, float]:
    """Where targets lie: around the hinge, at the reach of one half of the spinner [m]."""
    hinge = model.body_pos[lookup.find(model, "body", "spinner")]
    reach = model.geom_size[lookup.find(model, "geom", "cap1")].sum()
    return float(hinge[0]), float(hinge[2]), float(reach)
