"""Humanoid: stand, walk at 1 m/s or run at 10 m/s, in any direction. 25 ms a step."""

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np
from dm_control.suite import humanoid

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
from purerl.envs.suite.rewards import tolerance

SPEEDS = {"stand": 0.0, "walk": 1.0, "run": 10.0}  # [m/s]
STAND_HEIGHT = 1.4  # of the head [m]
LIMBS = ("left_hand", "left_foot", "right_hand", "right_foot")
CANDIDATES = 16  # starting poses to draw, to have one in which nothing touches
# A sensor has the velocity too, beside others, of forces, which take a tenth of a control step.
READINGS = ("xpos", "xmat", "subtree_linvel")
# In float32, 256 environments under random actions lost 15 of 76,800 states with 4.
ITERATIONS = 8


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "walk"  # "stand", "walk" or "run"


@dataclass(frozen=True)
class Humanoid:
    """The domain; `build` makes an environment of it."""

    target_speed: float  # [m/s]; 0 to stand
    geoms: Physics  # to see what touches in a starting pose
    torso: int  # body
    head: int  # body
    limbs: tuple[int, ...]  # bodies

    def start(self, key: Array) -> Start:
        """Any pose in which nothing touches, in the air, at rest."""
        model = self.geoms.model
        draw = partial(random_joints, model)
        qpos = draw_apart(draw, self.geoms, touching_pairs(model), key, CANDIDATES)
        return Start(qpos, jnp.zeros(model.nv), {})

    def observe(self, moment: Moment) -> Array:
        """Joints, head height, limbs and vertical as the torso sees them, velocities: [67]."""
        xpos, torso = moment.readings.xpos, moment.readings.xmat[self.torso]
        limbs = (xpos[jnp.array(self.limbs)] - xpos[self.torso]) @ torso
        parts = (moment.physics.qpos[7:], xpos[self.head, 2:], limbs.ravel(), torso[2])
        velocity = moment.readings.subtree_linvel[self.torso]
        return jnp.concatenate([*parts, velocity, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Standing upright with little force, and still or at speed: the product."""
        height = moment.readings.xpos[self.head, 2]
        standing = tolerance(height, (STAND_HEIGHT, np.inf), STAND_HEIGHT / 4)
        up = moment.readings.xmat[self.torso, 2, 2]
        upright = tolerance(up, (0.9, np.inf), 1.9, value_at_margin=0, sigmoid="linear")
        force = tolerance(moment.ctrl, margin=1, value_at_margin=0, sigmoid="quadratic")
        velocity = moment.readings.subtree_linvel[self.torso, :2]
        reward = standing * upright * (4 + force.mean()) / 5 * self._moving(velocity)
        return {"reward": reward, "height": height, "speed": jnp.linalg.norm(velocity)}

    def _moving(self, velocity: Array) -> Array:
        if not self.target_speed:
            return tolerance(velocity, margin=2).mean()
        speed, target = jnp.linalg.norm(velocity), self.target_speed
        fast = tolerance(speed, (target, np.inf), target, value_at_margin=0, sigmoid="linear")
        return (5 * fast + 1) / 6


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, tuple(SPEEDS))
    model = load_model(humanoid.Physics, humanoid.get_model_and_assets(), engine, ITERATIONS)
    domain = Humanoid(
        target_speed=SPEEDS[options.task],
        geoms=Physics(model, ("geom_xpos", "geom_xmat"), 1, engine),
        torso=lookup.find(model, "body", "torso"),
        head=lookup.find(model, "body", "head"),
        limbs=tuple(lookup.find(model, "body", name) for name in LIMBS),
    )
    return make_env(domain, model, READINGS, 0.025, engine)
