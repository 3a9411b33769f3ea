"""Imitation of recorded motion: a body is to move as a clip does, from any frame of it.

The clips are arrays of the environment, a frame for each control step. Which clip an episode
follows and where it is in it are whole numbers in `state.task`: no clock is rounded.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from purerl import (
    Array,
    Network,
    Physics,
    PhysicsState,
    PyTree,
    State,
    clips,
    lookup,
    networks,
    overflow_metric,
    overflow_reading,
)
from purerl.envs import body_parts, recordings, tracking
from purerl.envs.body_parts import Parts
from purerl.envs.feeling import proprioception
from purerl.envs.tracking import Effort, Pose


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the task."""

    body: str = "rodent"
    """ant, rodent, humanoid, or the path of an MJCF file: a body with actuators, on its floor."""
    end_effectors: tuple[str, ...] = ()
    """Bodies where limbs end; (): those of a body that is known. An MJCF's own must be named."""
    clips: str = ""
    """Path of an HDF5 file; rodent, ant: a set that comes with purerl; cmu: two of a humanoid, of
    0.45 s; squats: a computed one of it."""
    clip_set: str = "all"
    """all, train, test (by their names), a behaviour, one clip, or of one part: test/Run."""
    held_out: float = 0.2
    """About this share of the clips is `test`."""
    allow: tuple[str, ...] = ()
    """Joints that only one of body and clips has."""
    control_rate: int = 100
    """Control steps a second [Hz]."""
    clip_rate: int = 50
    """At which what is to come is told [Hz]: `control_rate` is it, or a multiple."""
    substeps: int = 5
    """Physics steps in one control step."""
    window: int = 5
    """Frames to come that are told, at `clip_rate`."""
    start_frames: tuple[int, int] | None = None
    """First and last frame, at `clip_rate`, in which episodes begin; None: any."""
    start_noise: float = 0.02
    """Half-width of the noise of each joint at the start [rad]."""
    reward: tracking.Reward = tracking.Reward()
    """Weights and scales of its terms."""
    farthest_place: float = 0.1
    """Of the torso from the recording's, beyond which the episode ends [m]."""
    farthest_turn: float = 120.0
    """The same of the whole angle between them, which is at most 180 [deg]."""
    farthest_joints: float = 4.5
    """The same of the root of the sum of squares over all joints [rad]."""

    def __post_init__(self):
        """Refuses rates, windows and starts that make no sense."""
        if self.clip_rate < 1 or self.control_rate % self.clip_rate:
            raise ValueError(
                f"control_rate is {self.control_rate}, clip_rate {self.clip_rate}: "
                "the first must be a whole multiple of the second."
            )
        if self.window < 1 or self.substeps < 1:
            raise ValueError(f"window is {self.window}, substeps {self.substeps}; give 1 or more.")
        if self.start_frames and not 0 <= self.start_frames[0] <= self.start_frames[1]:
            raise ValueError(f"start_frames is {self.start_frames}; give 0 <= first <= last.")


class Recording(NamedTuple):
    """C clips of at most F frames, one for each control step."""

    qpos: Array  # [C, F, nq]
    qvel: Array  # [C, F, nv]
    torso: Array  # [C, F, 7] where it is [m], and its turn
    bodies: Array  # [C, F, B, 3] [m]
    lengths: Array  # [C] int32


@dataclasses.dataclass(frozen=True)
class Imitation:
    """The environment; `build` makes one."""

    options: Options
    physics: Physics
    parts: Parts
    recording: Recording
    names: tuple[str, ...]  # of the clips
    action_size: int

    @property
    def control_timestep(self) -> float:
        """Simulated time of one step [s]."""
        return self.physics.control_timestep

    @property
    def stride(self) -> int:
        """Control steps from one frame that is told to the next."""
        return self.options.control_rate // self.options.clip_rate

    @property
    def ahead(self) -> int:
        """Control steps from a frame to the last that is told with it."""
        return self.stride * self.options.window

    def reset(self, key: Array) -> State:
        """Starts in a frame of a clip, with its velocities; each frame as often."""
        clip_key, noise_key = jax.random.split(key)
        clip, frame = self.draw_start(clip_key)
        noise = self.options.start_noise
        joints = jax.random.uniform(noise_key, (len(self.parts.qpos),), minval=-noise, maxval=noise)
        qpos, qvel = self.recording.qpos[clip, frame], self.recording.qvel[clip, frame]
        # Unique: a sum of terms that might meet would have no fixed order on a GPU.
        qpos = qpos.at[np.array(self.parts.qpos)].add(joints, unique_indices=True)
        physics, readings = self.physics.init(qpos, qvel)
        action = jnp.zeros(self.action_size)
        task = {"clip": clip, "start": frame, "frame": frame, "action": action}
        return self._state(physics, readings, task, action)

    def step(self, state: State, action: Array) -> State:
        """Drives the actuators with action [A] in [-1, 1]; the clip goes on by a frame."""
        ctrl = lookup.scale_action(self.physics.model, action)
        physics, readings = self.physics.step(state.physics, ctrl)
        task = state.task | {"frame": state.task["frame"] + 1}
        return self._state(physics, readings, task, action)

    def ghost(self, state: State) -> Array:
        """Returns where the recording is, as qpos [nq], to be drawn beside the body."""
        return self.recording.qpos[state.task["clip"], state.task["frame"]]

    def draw_start(self, key: Array) -> tuple[Array, Array]:
        """Draws a clip and a frame [] int32, with a window and one step after it."""
        first, room = self.starts()
        # By how many starts a clip has, so that none of them comes more often than another.
        clip, frame = clips.draw(key, room, room, 1)
        return clip, first + frame

    def starts(self) -> tuple[int, Array]:
        """Returns the first frame in which an episode may begin, and how many there are, [C]."""
        first, last = self.options.start_frames or (0, len(self.recording.qpos[0]))
        ends = jnp.minimum(self.recording.lengths - self.ahead - 1, last * self.stride + 1)
        return first * self.stride, ends - first * self.stride

    def _state(self, physics: PhysicsState, readings: Any, task: dict, action: Array) -> State:
        options, parts = self.options, self.parts
        now = body_parts.pose_of(parts, physics, readings)
        clip, frame = task["clip"], task["frame"]
        reference = frames(parts, self.recording, clip, frame)
        apart = tracking.errors(now, reference, np.array(parts.ends))
        effort = Effort(action, task["action"], physics.qvel, readings.qfrc_actuator)
        terms = tracking.reward_terms(options.reward, apart, now.place[2], effort)
        failed = (
            (apart["root_position"] > options.farthest_place)
            | (apart["root_rotation"] > options.farthest_turn)
            | (apart["joints"] > options.farthest_joints)
        )
        # Until here there is a whole window. The motion itself would go on, so what follows has a
        # value, and that of a state like any other is known: it is truncated.
        last = self.recording.lengths[clip] - 1 - self.ahead
        first = (frame == task["start"] + 1).astype(jnp.float32)
        metrics = {f"reward_{name}": term for name, term in terms.items()}
        metrics |= tracking.readable(now, reference)
        metrics |= {
            "success_count": first - failed,  # of a whole episode: 1, or 0
            "tracked_count": 1.0 / jnp.maximum(last - task["start"], 1),  # the share that it lasted
        }
        coming = frame + self.stride * (1 + np.arange(options.window))
        told = tracking.targets(now, frames(parts, self.recording, clip, coming))
        return State(
            physics=physics,
            observation={
                "reference": told,
                "proprioception": proprioception(parts, now, physics, readings, action),
            },
            reward=sum(terms.values(), jnp.zeros(())),
            terminated=failed,
            truncated=~failed & (frame >= last),
            metrics=metrics | overflow_metric(readings),
            task=task | {"action": action},
        )


def record(parts: Parts, held: clips.Clips) -> Recording:
    """Returns clips, a frame for each control step, as an environment holds them."""
    places = [clips.kinematics(parts.model, np.asarray(track))[1] for track in held.qpos]
    # By number: some have no name.
    numbers = np.searchsorted(clips.own_bodies(parts.model), (parts.torso, *parts.bodies))
    where = jnp.asarray(np.stack([place[:, numbers] for place in places]), jnp.float32)
    return Recording(held.qpos, held.qvel, where[:, :, 0], where[:, :, 1:, :3], held.lengths)


def frames(parts: Parts, recording: Recording, clip: Array, frame: Any) -> Pose:
    """Returns some frames [...] of a clip []."""
    torso = recording.torso[clip, frame]
    return Pose(
        place=torso[..., :3],
        turn=torso[..., 3:],
        joints=recording.qpos[clip, frame][..., np.array(parts.qpos)],
        speeds=recording.qvel[clip, frame][..., np.array(parts.qvel)],
        bodies=recording.bodies[clip, frame],
    )


def choose(options: Options, held: clips.Clips) -> clips.Clips:
    """Returns the clips of the set that is asked for."""
    part, _, name = options.clip_set.partition("/")
    if part in ("train", "test"):
        held = clips.split(held, options.held_out)[part == "test"]
    else:
        name = options.clip_set
    return held if name in ("", "all") else clips.choose(held, name)


def joined(observation: dict[str, Array]) -> Array:
    """Returns what a body is to do and what it feels as one array [..., O]."""
    return jnp.concatenate([observation["reference"], observation["proprioception"]], axis=-1)


def mlp(options: networks.MlpOptions, observation: PyTree, action_size: int) -> Network:
    """Builds the default network, whose policy and value function read all of the observation."""
    network = networks.mlp(options, joined(observation), action_size)

    def apply(params: PyTree, observation: PyTree, memory: PyTree) -> tuple:
        return network.apply(params, joined(observation), memory)

    return network._replace(apply=apply)


def build(options: Options = Options(), engine: str = "auto") -> Imitation:  # noqa: B008
    """Builds the environment on an engine of `purerl.physics.interface`; reads its clips once."""
    timestep = 1.0 / (options.control_rate * options.substeps)
    parts = body_parts.find(options.body, options.end_effectors, engine, timestep)
    motion = recordings.read(options.clips)
    held = clips.fit(motion, parts.model, options.control_rate, options.allow)
    held = choose(options, held)
    readings = body_parts.readings(parts) + overflow_reading(engine)
    env = Imitation(
        options=options,
        physics=Physics(parts.model, readings, options.substeps, engine),
        parts=parts,
        recording=record(parts, held),
        names=held.names,
        action_size=parts.model.nu,
    )
    # A window, and a step after it, from the first frame that may begin an episode.
    clips.check_window(held, env.starts()[0] + env.ahead + 2)
    return env
