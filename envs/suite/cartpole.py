"""Cart-pole: keep the pole up (balance), or swing it up first (swingup). 10 ms a step.

The sparse tasks reward only a pole that stands with the cart in the middle.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from dm_control.suite import cartpole

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, check_task, load_model, make_env
from purerl.envs.suite.rewards import tolerance

TASKS = ("balance", "balance_sparse", "swingup", "swingup_sparse")
CART_LIMIT = 0.25  # how far from the middle a sparse task still rewards [m]
UPRIGHT = 0.995  # cosine of the angle within which it does
READINGS = ("xmat",)


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "swingup"  # one of TASKS


@dataclass(frozen=True)
class Cartpole:
    """The domain; `build` makes an environment of it."""

    task: str
    slider: int  # in qpos
    hinge: int  # in qpos, and in qvel
    pole: int  # body

    def start(self, key: Array) -> Start:
        """Hanging, or standing, with a little noise."""
        place_key, speed_key = jax.random.split(key)
        if self.task.startswith("swingup"):
            place = jnp.array([0.0, np.pi]) + 0.01 * jax.random.normal(place_key, (2,))
        else:
            limit = jnp.array([0.1, 0.034])
            place = jax.random.uniform(place_key, (2,), minval=-limit, maxval=limit)
        qpos = jnp.zeros(2).at[jnp.array([self.slider, self.hinge])].set(place)
        return Start(qpos, 0.01 * jax.random.normal(speed_key, (2,)), {})

    def observe(self, moment: Moment) -> Array:
        """Position, cosine and sine of the angle, velocities: [5]."""
        pole = moment.readings.xmat[self.pole]
        position = jnp.stack([moment.physics.qpos[self.slider], pole[2, 2], pole[0, 2]])
        return jnp.concatenate([position, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Upright, in the middle, with little force and slowly: the product."""
        cosine, place = moment.readings.xmat[self.pole, 2, 2], moment.physics.qpos[self.slider]
        upright, centered = (cosine + 1) / 2, (1 + tolerance(place, margin=2)) / 2
        if self.task.endswith("sparse"):
            reward = tolerance(place, (-CART_LIMIT, CART_LIMIT)) * tolerance(cosine, (UPRIGHT, 1))
            return {"reward": reward, "upright": upright, "centered": centered}
        force = tolerance(moment.ctrl[0], margin=1, value_at_margin=0, sigmoid="quadratic")
        slow = (1 + tolerance(moment.physics.qvel[self.hinge], margin=5)) / 2
        reward = upright * (4 + force) / 5 * slow * centered
        return {"reward": reward, "upright": upright, "centered": centered}


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, TASKS)
    model = load_model(cartpole.Physics, cartpole.get_model_and_assets(), engine)
    domain = Cartpole(
        task=options.task,
        slider=int(lookup.qpos_indices(model, ["slider"])[0]),
        hinge=int(lookup.qpos_indices(model, ["hinge_1"])[0]),
        pole=lookup.find(model, "body", "pole_1"),
    )
    return make_env(domain, model, READINGS, 0.01, engine)
