"""Ball in cup: swing a ball on a string into the cup. 20 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from dm_control.suite import ball_in_cup

from purerl import Array, Physics, lookup
from purerl.envs.suite.base import (
    Moment,
    Start,
    SuiteEnv,
    draw_apart,
    load_model,
    make_env,
    touching_pairs,
)

CANDIDATES = 8  # starting places to draw, to have one in which the ball touches nothing
READINGS = ("xpos", "site_xpos")


@dataclass(frozen=True)
class Options:
    """Settings of the task: none."""


@dataclass(frozen=True)
class BallInCup:
    """The domain; `build` makes an environment of it."""

    geoms: Physics  # to see what touches at the start
    ball: int  # body
    target: int  # site
    free: tuple[int, int]  # of the ball, x and z in qpos
    room: tuple[float, float]  # how far from the target's centre the ball still is in it [m]

    def start(self, key: Array) -> Start:
        """The ball anywhere below or beside the cup, at rest."""
        pairs = touching_pairs(self.geoms.model)
        qpos = draw_apart(self._place_ball, self.geoms, pairs, key, CANDIDATES)
        return Start(qpos, jnp.zeros(self.geoms.model.nv), {})

    def _place_ball(self, key: Array) -> Array:
        low, high = jnp.array([-0.2, 0.2]), jnp.array([0.2, 0.5])
        place = jax.random.uniform(key, (2,), minval=low, maxval=high)
        qpos0 = jnp.asarray(self.geoms.model.qpos0, jnp.float32)
        return qpos0.at[jnp.array(self.free)].set(place)

    def observe(self, moment: Moment) -> Array:
        """Positions and velocities of cup and ball: [8]."""
        return jnp.concatenate([moment.physics.qpos, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """1 with the ball in the cup."""
        readings, plane = moment.readings, jnp.array([0, 2])
        away = jnp.abs(readings.site_xpos[self.target] - readings.xpos[self.ball])[plane]
        caught = jnp.all(away < jnp.array(self.room))
        return {"reward": caught.astype(jnp.float32), "distance": jnp.linalg.norm(away)}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    model = load_model(ball_in_cup.Physics, ball_in_cup.get_model_and_assets(), engine)
    target = lookup.find(model, "site", "target")
    size = model.site_size[target, [0, 2]] - model.geom_size[lookup.find(model, "geom", "ball"), 0]
    domain = BallInCup(
        geoms=Physics(model, ("geom_xpos", "geom_xmat"), 1, engine),
        ball=lookup.find(model, "body", "ball"),
        target=target,
        free=tuple(lookup.qpos_indices(model, ["ball_x", "ball_z"]).tolist()),
        room=tuple(size.tolist()),
    )
    return make_env(domain, model, READINGS, 0.02, engine)
