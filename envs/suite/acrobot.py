"""Acrobot: swing two links up with a motor at the elbow alone. 10 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from dm_control.suite import acrobot

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, check_task, load_model, make_env
from purerl.envs.suite.rewards import tolerance

MARGINS = {"swingup": 1.0, "swingup_sparse": 0.0}  # of the tip's distance to the target [m]
READINGS = ("xmat", "site_xpos")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "swingup"  # "swingup", or "swingup_sparse": nothing short of the target


@dataclass(frozen=True)
class Acrobot:
    """The domain; `build` makes an environment of it."""

    margin: float  # [m]
    arms: tuple[int, ...]  # bodies, upper and lower
    tip: int  # site
    target: int  # site
    radius: float  # of the target [m]

    def start(self, key: Array) -> Start:
        """Both links at any angle, at rest."""
        qpos = jax.random.uniform(key, (2,), minval=-np.pi, maxval=np.pi)
        return Start(qpos, jnp.zeros(2), {})

    def observe(self, moment: Moment) -> Array:
        """Sine and then cosine of both links, velocities: [6]."""
        arms = moment.readings.xmat[jnp.array(self.arms)]
        return jnp.concatenate([arms[:, 0, 2], arms[:, 2, 2], moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """The tip at the target."""
        sites = moment.readings.site_xpos
        distance = jnp.linalg.norm(sites[self.target] - sites[self.tip])
        reward = tolerance(distance, (0.0, self.radius), self.margin)
        return {"reward": reward, "distance": distance}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, tuple(MARGINS))
    model = load_model(acrobot.Physics, acrobot.get_model_and_assets(), engine)
    target = lookup.find(model, "site", "target")
    arms = tuple(lookup.find(model, "body", name) for name in ("upper_arm", "lower_arm"))
    domain = Acrobot(
        margin=MARGINS[options.task],
        arms=arms,
        tip=lookup.find(model, "site", "tip"),
        target=target,
        radius=float(model.site_size[target, 0]),
    )
    return make_env(domain, model, READINGS, 0.01, engine)
