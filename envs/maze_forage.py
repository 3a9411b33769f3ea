"""dm_control's maze: a rodent finds treats in a maze that differs in every episode.

Physics has the four walls nearest to the body, eyes see all of them. A treat is found when a part
of the body touches it, and is gone then; when all are found, the episode ends.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from purerl import Array, Physics, PhysicsState, State, eyes as seeing, lookup
from purerl.envs import mazes, sight
from purerl.envs.arenas import TARGET, TREAT
from purerl.envs.bodies import RODENT
from purerl.envs.compose import PREFIX, Composed, compose
from purerl.envs.feeling import READINGS, felt
from purerl.envs.mazes import Maze
from purerl.envs.touch import touched

REWARD, HEIGHT = 50.0, 0.125  # of a treat; its place above the ground [m]
GONE = -5.0  # below the ground, where found treats are [m]


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    eyes: sight.Sight = sight.Sight(number=1)
    """Without eyes it is told where the nearest treat is."""
    reward: float = REWARD
    """For each treat."""
    forward_weight: float = 0.0
    """Reward for each step of an upright body that runs ahead of itself at `target_speed` or more:
    without that condition it pushes itself along on its back."""
    target_speed: float = 0.5
    """Speed that earns all of it [m/s]."""
    rooms: int = 4
    """In a maze, with three treats each."""
    substeps: int = 5
    """Physics steps in one control step."""


@dataclasses.dataclass(frozen=True)
class Forage:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Composed
    maze: Maze
    touching: tuple[int, ...]  # geom ids, ellipsoids: what finds
    action_size: int
    eyes: seeing.Eyes | None

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    def reset(self, key: Array) -> State:
        """Starts standing in a room, turned anyhow."""
        maze_key, turn_key, eyes_key = jax.random.split(key, 3)
        drawn = mazes.draw_maze(maze_key, self.maze)
        half = jnp.pi * jax.random.uniform(turn_key)
        rest = jnp.asarray(self.physics.model.qpos0, jnp.float32)
        qpos = rest.at[:2].set(drawn.start).at[3].set(jnp.cos(half)).at[6].set(jnp.sin(half))
        targets = jnp.pad(drawn.targets, ((0, 0), (0, 1)), constant_values=HEIGHT)
        task: dict[str, Any] = {"free": drawn.free, "targets": targets}
        task |= {"found": jnp.zeros(len(targets), bool)}
        task |= {"eyes": sight.draw(eyes_key, self.options.eyes)}
        changes = self._walls(task, qpos)
        place = jnp.asarray(self.physics.model.body_pos, jnp.float32)
        changes["body_pos"] = place.at[jnp.array(self._bodies())].set(targets)
        physics, readings = self.physics.init(qpos, jnp.zeros(self.physics.model.nv), changes)
        return self._state(physics, readings, task, jnp.zeros(self.action_size))

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]."""
        task = state.task
        gone = task["targets"].at[:, 2].set(GONE)
        place = jnp.where(task["found"][:, None], gone, task["targets"])
        ctrl = lookup.scale_action(self.physics.model, action)
        before = state.physics.replace(mocap_pos=place)
        physics, readings = self.physics.step(before, ctrl, self._walls(task, before.qpos))
        return self._state(physics, readings, task, action)

    def model_changes(self, state: State) -> dict[str, Array]:
        """Returns this episode's walls where the body is now (a video needs them too)."""
        return self._walls(state.task, state.physics.qpos)

    def scenery(self, state: State) -> tuple[Array, Array]:
        """Returns all walls as boxes: centers and half sizes, [N * N, 3] each [m]."""
        return mazes.all_walls(self.maze, state.task["free"])

    def _bodies(self) -> list[int]:
        model = self.physics.model
        return [lookup.find(model, "body", f"{TARGET}_{i}") for i in range(self.maze.targets)]

    def _walls(self, task: dict, qpos: Array) -> dict[str, Array]:
        near = mazes.walls_near(self.maze, task["free"], qpos[:2])
        fields = self.parts.boxes
        return {"geom_pos": fields.geom_pos.at[jnp.array(fields.boxes)].set(near)}

    def _state(self, physics: PhysicsState, readings: Any, task: dict, action: Array) -> State:
        new = touched(self.parts.looks, self.touching, readings, task["targets"], TREAT)
        new &= ~task["found"]
        found = task["found"] | new
        torso = self.parts.torso
        away = task["targets"] - readings.xpos[torso]
        far = jnp.where(found, jnp.inf, jnp.sqrt(jnp.square(away).sum(1)))
        nearest = jnp.where(found.all(), 0.0, readings.xmat[torso].T @ away[jnp.argmin(far)])
        parts = felt(self.parts, physics, readings, action)
        told = jnp.append(nearest, found.mean(dtype=jnp.float32))
        if self.eyes is None:
            observation: Any = jnp.concatenate([*parts, told])
        else:
            walls = mazes.all_walls(self.maze, task["free"])
            given = readings, task["eyes"], physics.time, self.options.eyes
            pictures = sight.look(self.eyes, *given, boxes=walls)
            observation = {"policy": jnp.concatenate(parts), "eyes": pictures, "privileged": told}
        number = new.sum(dtype=jnp.float32)
        up, ahead = readings.xmat[torso, 2, 2], readings.xmat[torso, :, 0] @ physics.qvel[:3]
        forward = jnp.clip(up, 0, 1) * jnp.clip(ahead / self.options.target_speed, 0, 1)
        return State(
            physics=physics,
            observation=observation,
            reward=self.options.reward * number + self.options.forward_weight * forward,
            terminated=found.all(),
            truncated=jnp.zeros((), bool),
            metrics={"treats_count": number, "up": up, "forward_velocity": ahead},
            task=task | {"found": found},
        )  # fmt: skip


def build(options: Options = Options(), engine: str = "auto") -> Forage:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`."""
    maze = Maze(rooms=options.rooms)
    parts = compose(RODENT, maze, engine)
    own = [i for i, n in enumerate(lookup.names(parts.looks, "geom")) if n.startswith(PREFIX)]
    round_ = parts.looks.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID
    eye = seeing.of_camera(parts.looks, PREFIX + RODENT.camera)
    window = tuple(lookup.names(parts.model, "geom")[i] for i in parts.boxes.boxes)
    return Forage(
        options=options,
        physics=Physics(parts.model, READINGS, options.substeps, engine),
        parts=parts,
        maze=maze,
        touching=tuple(i for i in own if round_[i]),
        action_size=parts.model.nu,
        eyes=sight.build(parts.looks, eye, RODENT.eye_distance, options.eyes, window),
    )
