"""Swimmer: a chain in a viscous fluid brings its nose to a target. 30 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
from dm_control.suite import swimmer

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, load_model, make_env, random_joints
from purerl.envs.suite.rewards import tolerance

NEAR, FAR, NEAR_CHANCE = 0.3, 2.0, 0.2  # half-width of the target's square [m], and its chance
READINGS = ("geom_xpos", "xmat", "sensordata")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    links: int = 6  # at least 3; dm_control has 6 and 15


@dataclass(frozen=True)
class Swimmer:
    """The domain; `build` makes an environment of it."""

    model: mujoco.MjModel
    head: int  # body
    nose: int  # geom
    target: int  # geom
    velocities: tuple[int, ...]  # x, y and rotation of each link, in sensordata

    def start(self, key: Array) -> Start:
        """Any pose, at rest, and a target that is now and then near."""
        pose_key, near_key, place_key = jax.random.split(key, 3)
        limit = jnp.where(jax.random.uniform(near_key) < NEAR_CHANCE, NEAR, FAR)
        place = limit * jax.random.uniform(place_key, (2,), minval=-1.0, maxval=1.0)
        geom_pos = jnp.float32(self.model.geom_pos).at[self.target, :2].set(place)
        qpos = random_joints(self.model, pose_key)
        return Start(qpos, jnp.zeros(self.model.nv), {"geom_pos": geom_pos})

    def observe(self, moment: Moment) -> Array:
        """Joints, target as the head sees it, velocities of each link: [4 links + 1]."""
        velocities = moment.readings.sensordata[jnp.array(self.velocities)]
        return jnp.concatenate([moment.physics.qpos[3:], self._to_target(moment), velocities])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """The nose at the target."""
        size = float(self.model.geom_size[self.target, 0])
        distance = jnp.linalg.norm(self._to_target(moment))
        reward = tolerance(distance, (0.0, size), margin=5 * size, sigmoid="long_tail")
        return {"reward": reward, "distance": distance}

    def _to_target(self, moment: Moment) -> Array:
        places, head = moment.readings.geom_xpos, moment.readings.xmat[self.head]
        return ((places[self.target] - places[self.nose]) @ head)[:2]


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    xml = swimmer.get_model_and_assets(options.links)
    model = load_model(swimmer.Physics, xml, engine)
    domain = Swimmer(
        model=model,
        head=lookup.find(model, "body", "head"),
        nose=lookup.find(model, "geom", "nose"),
        target=lookup.find(model, "geom", "target"),
        velocities=_velocities(model, options.links),
    )
    return make_env(domain, model, READINGS, 0.03, engine)


def _velocities(model: mujoco.MjModel, links: int) -> tuple[int, ...]:
    """Where each link's x and y velocity and its turning stand in sensordata, head first."""
    places: list[int] = []
    for velocimeter, gyro in [("head_vel", "head_gyro")] + [
        (f"velocimeter_{i}", f"gyro_{i}") for i in range(links - 1)
    ]:
        start = lookup.sensor_slice(model, velocimeter).start
        places += [start, start + 1, lookup.sensor_slice(model, gyro).start + 2]
    return tuple(places)
