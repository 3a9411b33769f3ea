"""Finger: spin a free body on a hinge, at 15 rad/s or more. 20 ms a step."""

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
from dm_control.suite import finger

from envs.suite.base import (
    Moment,
    Start,
    SuiteEnv,
    draw_apart,
    load_model,
    make_env,
    random_joints,
    touching_pairs,
)
from purerl import Array, Physics, lookup

SPIN = 15.0  # [rad/s], in the negative direction
SPINNER_DAMPING = 0.03  # dm_control lowers the hinge's for this task [N m s/rad]
CANDIDATES = 16  # starting poses to draw, to have one in which nothing touches
READINGS = ("sensordata",)
_IN_OBSERVATION = ("proximal_velocity", "distal_velocity", "hinge_velocity")


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class Finger:
    """The domain; `build` makes an environment of it."""

    geoms: Physics  # to see what touches in a starting pose
    angles: tuple[int, ...]  # all of these in sensordata
    velocities: tuple[int, ...]
    touch: tuple[int, ...]
    tip: slice
    spinner: slice

    def start(self, key: Array) -> Start:
        """Any pose in which nothing touches, at rest."""
        model = self.geoms.model
        draw = partial(random_joints, model)
        qpos = draw_apart(draw, self.geoms, touching_pairs(model), key, CANDIDATES)
        return Start(qpos, jnp.zeros(model.nv), {})

    def observe(self, moment: Moment) -> Array:
        """Finger's angles, tip of the spinner, velocities, log(1 + force [N]): [9]."""
        sensors = moment.readings.sensordata
        tip = (sensors[self.tip] - sensors[self.spinner])[jnp.array([0, 2])]
        touch = jnp.log1p(sensors[jnp.array(self.touch)])
        angles, velocities = jnp.array(self.angles), jnp.array(self.velocities)
        return jnp.concatenate([sensors[angles], tip, sensors[velocities], touch])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """1 while spinning fast."""
        velocity = moment.readings.sensordata[self.velocities[2]]
        return {"reward": (velocity <= -SPIN).astype(jnp.float32), "spin": -velocity}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model(finger.Physics, finger.get_model_and_assets(), engine)
    model.dof_damping[lookup.qvel_indices(model, ["hinge"])] = SPINNER_DAMPING
    domain = Finger(
        geoms=Physics(model, ("geom_xpos", "geom_xmat"), 1, engine),
        angles=_places(model, ("proximal", "distal")),
        velocities=_places(model, _IN_OBSERVATION),
        touch=_places(model, ("touchtop", "touchbottom")),
        tip=lookup.sensor_slice(model, "tip"),
        spinner=lookup.sensor_slice(model, "spinner"),
    )
    return make_env(domain, model, READINGS, 0.02, engine)


def _places(model, names: tuple[str, ...]) -> tuple[int, ...]:
    """Where one-number sensors stand in sensordata."""
    return tuple(lookup.sensor_slice(model, name).start for name in names)
