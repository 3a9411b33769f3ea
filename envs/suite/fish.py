"""Fish: stay upright, or bring the mouth to a target as well (swim). 40 ms a step."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
from dm_control.suite import fish

from purerl import Array, lookup
from purerl.envs.suite.base import Moment, Start, SuiteEnv, check_task, load_model, make_env
from purerl.envs.suite.rewards import tolerance

TASKS = ("upright", "swim")
JOINTS = ("tail1", "tail_twist", "tail2") + tuple(
    f"fin{side}_{motion}" for side in ("right", "left") for motion in ("roll", "pitch")
)
BEND = 0.2  # of the joints at the start, either way [rad]
NEAREST, FARTHEST = (-0.4, -0.4, 0.1), (0.4, 0.4, 0.3)  # corners of the target's box [m]
READINGS = ("xmat", "geom_xpos", "geom_xmat")


@dataclass(frozen=True)
class Options:
    """Settings of the task."""

    task: str = "swim"  # "upright" or "swim"


@dataclass(frozen=True)
class Fish:
    """The domain; `build` makes an environment of it."""

    task: str
    model: mujoco.MjModel
    joints: tuple[int, ...]  # in qpos
    root: int  # the first number of the torso's quaternion in qpos
    torso: int  # body
    mouth: int  # geom
    target: int  # geom

    def start(self, key: Array) -> Start:
        """Turned anyhow and bent a little, at rest; to swim, the target anywhere in its box."""
        turn_key, bend_key, place_key = jax.random.split(key, 3)
        quat = jax.random.normal(turn_key, (4,))
        bend = jax.random.uniform(bend_key, (len(self.joints),), minval=-BEND, maxval=BEND)
        qpos = jnp.float32(self.model.qpos0).at[jnp.array(self.joints)].set(bend)
        qpos = qpos.at[self.root : self.root + 4].set(quat / jnp.linalg.norm(quat))
        still = jnp.zeros(self.model.nv)
        if self.task == "upright":
            return Start(qpos, still, {})
        low, high = jnp.array(NEAREST), jnp.array(FARTHEST)
        place = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
        geom_pos = jnp.float32(self.model.geom_pos).at[self.target].set(place)
        return Start(qpos, still, {"geom_pos": geom_pos})

    def observe(self, moment: Moment) -> Array:
        """Joints, uprightness, the target as the mouth sees it (swim), velocities: [21 or 24]."""
        joints = moment.physics.qpos[jnp.array(self.joints)]
        parts = [joints, moment.readings.xmat[self.torso, 2, 2:]]
        if self.task == "swim":
            parts.append(self._to_target(moment))
        return jnp.concatenate([*parts, moment.physics.qvel])

    def reward(self, moment: Moment) -> dict[str, Array]:
        """Upright; to swim, an eighth for that, and the rest for the mouth at the target."""
        upright = moment.readings.xmat[self.torso, 2, 2]
        if self.task == "upright":
            return {"reward": tolerance(upright, (1.0, 1.0), margin=1.0), "upright": upright}
        radii = float(self.model.geom_size[[self.mouth, self.target], 0].sum())
        distance = jnp.linalg.norm(self._to_target(moment))
        there = tolerance(distance, (0.0, radii), margin=2 * radii)
        reward = (7 * there + (upright + 1) / 2) / 8
        return {"reward": reward, "upright": upright, "distance": distance}

    def _to_target(self, moment: Moment) -> Array:
        places, mouth = moment.readings.geom_xpos, moment.readings.geom_xmat[self.mouth]
        return (places[self.target] - places[self.mouth]) @ mouth


def build(options: Options = Options(), engine: str = "auto") -> SuiteEnv:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    check_task(options.task, TASKS)
    model = load_model(fish.Physics, fish.get_model_and_assets(), engine)
    domain = Fish(
        task=options.task,
        model=model,
        joints=tuple(lookup.qpos_indices(model, JOINTS).tolist()),
        root=int(lookup.qpos_indices(model, ["root"])[3]),
        torso=lookup.find(model, "body", "torso"),
        mouth=lookup.find(model, "geom", "mouth"),
        target=lookup.find(model, "geom", "target"),
    )
    return make_env(domain, model, READINGS, 0.04, engine)
