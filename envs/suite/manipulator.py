"""Manipulator: a planar arm with a hand brings a ball to a target in the air. 10 ms a step.

Target and ball are elsewhere in each episode, the target by model fields of that environment.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import manipulator

from purerl import Array, Physics, lookup
from purerl.envs.suite.base import (
    Moment,
    Start,
    SuiteEnv,
    first_apart,
    least_gap,
    load_model,
    make_env,
    touching_pairs,
)
from purerl.envs.suite.rewards import tolerance

CLOSE = 0.01  # of the ball to the target [m]
IN_HAND, IN_TARGET = 0.1, 0.1  # chances that the ball starts there; else it is anywhere
SPEED = 5.0  # of a ball that starts anywhere, along x, either way [m/s]
ARM = ("arm_root", "arm_shoulder", "arm_elbow", "arm_wrist")
HAND = ("finger", "fingertip", "thumb", "thumbtip")
BALL = ("ball_x", "ball_z", "ball_y")  # two slides, and the hinge
TOUCH = ("palm", "finger", "thumb", "fingertip", "thumbtip")
CANDIDATES = 16  # starts to draw, to have one in which nothing touches: two of five do
READINGS = ("xpos", "xquat", "site_xpos", "sensordata")


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class Manipulator:
    """The domain; `build` makes an environment of it."""

    geoms: Physics  # to see what touches at the start, and where the hand is
    arm: tuple[int, ...]  # arm's and hand's joints in qpos, and in qvel
    ball: tuple[int, ...]  # its joints in qpos, and in qvel
    bodies: tuple[int, ...]  # hand, ball, target
    sites: tuple[int, ...]  # grasp, ball, target
    ball_geom: int
    touch: tuple[int, ...]  # in sensordata

    def start(self, key: Array) -> Start:
        """Any pose and target; the ball in the hand, in the target or anywhere, and then moving.

        dm_control draws until nothing touches, and a speed drawn on the way stays, whatever is
        drawn after it. So the speed is that of the last candidate that had one.
        """
        arms, target, balls, speed, gap = jax.vmap(self._draw)(jax.random.split(key, CANDIDATES))
        chosen, order = first_apart(gap), jnp.arange(CANDIDATES)
        moved = jnp.max(jnp.where((speed != 0) & (order <= chosen), order, -1))
        model, ball = self.geoms.model, jnp.array(self.ball)
        qvel = jnp.zeros(model.nv).at[ball[0]].set(jnp.where(moved < 0, 0.0, speed[moved]))
        x, z, angle = target[chosen]
        turned, body = angle / 2, self.bodies[2]
        pos = jnp.float32(model.body_pos).at[body, jnp.array([0, 2])].set(jnp.stack([x, z]))
        quat = jnp.stack([jnp.cos(turned), jnp.sin(turned)])
        quat = jnp.float32(model.body_quat).at[body, jnp.array([0, 2])].set(quat)
        qpos = arms[chosen].at[ball].set(balls[chosen])
        return Start(qpos, qvel, {"body_pos": pos, "body_quat": quat})

    def _draw(self, key: Array) -> tuple[Array, Array, Array, Array, Array]:
        """One candidate: qpos but for the ball, target [3], ball [3], its speed, the least gap."""
        arm_key, target_key, ball_key, speed_key, kind_key = jax.random.split(key, 5)
        qpos = self._draw_arm(arm_key)
        readings = self.geoms.init(qpos, jnp.zeros(self.geoms.model.nv))[1]
        target = _uniform(target_key, (-0.4, 0.1, -np.pi), (0.4, 0.4, np.pi))
        anywhere = _uniform(ball_key, (-0.5, 0.0, 0.0), (0.5, 0.7, 2 * np.pi))
        grasp, turned = (r[self.sites[0]] for r in (readings.site_xpos, readings.site_xmat))
        angle = np.pi - jnp.arctan2(turned[2, 0], turned[0, 0])
        held = jnp.stack([grasp[0], grasp[2], angle])
        kind = jax.random.uniform(kind_key)
        free = kind >= IN_HAND + IN_TARGET
        ball = jnp.where(free, anywhere, jnp.where(kind < IN_HAND, held, target))
        speed = jnp.where(free, jax.random.uniform(speed_key, minval=-SPEED, maxval=SPEED), 0.0)
        place = jnp.stack([ball[0], 0.0, ball[1]])
        places = readings.geom_xpos.at[self.ball_geom].set(place)
        model = self.geoms.model
        gap = least_gap(model, touching_pairs(model), places, readings.geom_xmat)
        return qpos, target, ball, speed, gap

    def _draw_arm(self, key: Array) -> Array:
        """Any pose, finger and thumb alike; the ball where the model has it: [nq]."""
        limits = _arm_limits(self.geoms.model)
        angles = jax.random.uniform(key, (len(limits),), minval=limits[:, 0], maxval=limits[:, 1])
        finger, thumb = (len(ARM) + HAND.index(name) for name in ("finger", "thumb"))
        angles = angles.at[finger].set(angles[thumb])
        return jnp.float32(self.geoms.model.qpos0).at[jnp.array(self.arm)].set(angles)

    def observe(self, moment: Moment) -> Array:
        """Sine and cosine of arm and hand, velocities, touch, poses, ball's velocities: [44]."""
        arm, ball = jnp.array(self.arm), jnp.array(self.ball)
        angles, velocities = moment.physics.qpos[arm], moment.physics.qvel
        waves = jnp.stack([jnp.sin(angles), jnp.cos(angles)], axis=1).ravel()
        touch = jnp.log1p(moment.readings.sensordata[jnp.array(self.touch)])
        hand, thing, target = (_pose(moment, body) for body in self.bodies)
        parts = [waves, velocities[arm], touch, hand, thing, velocities[ball], target]
        return jnp.concatenate(parts)

    def reward(self, moment: Moment) -> dict[str, Array]:
        """The ball at the target."""
        _, ball, target = self.sites
        places = moment.readings.site_xpos
        distance = jnp.linalg.norm(places[ball] - places[target])
        return {"reward": tolerance(distance, (0.0, CLOSE), 2 * CLOSE), "distance": distance}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    xml = manipulator.make_model(use_peg=False, insert=False)
    model = load_model(manipulator.Physics, xml, engine)
    readings = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat")
    bodies = tuple(lookup.find(model, "body", n) for n in ("hand", "ball", "target_ball"))
    sites = tuple(lookup.find(model, "site", n) for n in ("grasp", "ball", "target_ball"))
    domain = Manipulator(
        geoms=Physics(model, readings, 1, engine),
        arm=tuple(lookup.qpos_indices(model, ARM + HAND).tolist()),
        ball=tuple(lookup.qpos_indices(model, BALL).tolist()),
        bodies=bodies,
        sites=sites,
        ball_geom=lookup.find(model, "geom", "ball"),
        touch=tuple(lookup.sensor_slice(model, f"{n}_touch").start for n in TOUCH),
    )
    return make_env(domain, model, READINGS, 0.01, engine)


def _arm_limits(model: mujoco.MjModel) -> np.ndarray:
    """Least and greatest angle of the arm's and the hand's joints, in their order: [8, 2] rad."""
    joints = [lookup.find(model, "joint", name) for name in ARM + HAND]
    around = np.array([-np.pi, np.pi])
    return np.where(model.jnt_limited[joints][:, None], model.jnt_range[joints], around)


def _uniform(key: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Array:
    return jax.random.uniform(key, (len(low),), minval=jnp.array(low), maxval=jnp.array(high))


def _pose(moment: Moment, body: int) -> Array:
    """Place and turn of a body in the plane: x, z [m], two numbers of its quaternion."""
    plane = jnp.array([0, 2])
    readings = moment.readings
    return jnp.concatenate([readings.xpos[body, plane], readings.xquat[body, plane]])
