"""What is odd about clips, in numbers: under the floor, beyond a range, apart from kinematics."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from purerl.clips import body
from purerl.clips.records import Motion, behaviour_of

# Numbers [L, n] of a track's frames, and the n names that they are of.
Measure = tuple[np.ndarray, list[str]]


def about(motion: Motion, clip: int) -> str:
    """Returns a clip's name, behaviour, length and rate."""
    name, frames = motion.names[clip], int(motion.lengths[clip])
    seconds = (frames - 1) / motion.rate
    return f"{name}: {behaviour_of(name)}, {seconds:.2f} s, {frames} frames at {motion.rate:g} Hz"


def examine(motion: Motion, model: mujoco.MjModel, allow: Sequence[str] = ()) -> Iterator[str]:
    """Yields a line about each clip with what is most odd in it; see `body.fit` for `allow`."""
    for i, qpos in enumerate(body.poses(motion, model, allow)):
        fast = body.speeds(model, qpos, motion.rate)[:, None]
        said = [about(motion, i), worst(fast, ["root"], "m/s")]
        said += [worst(*below_floor(model, qpos), "mm below the floor")]
        said += [worst(*beyond_ranges(model, qpos), "deg beyond the range")]
        said += [worst(*from_positions(motion, i, model, qpos), "mm from the file's positions")]
        yield "; ".join(said)


def worst(values: np.ndarray, names: list[str], what: str) -> str:
    """Returns the largest of numbers [L, n] in words: what it measures, of what, in which frame."""
    if not values.size:
        return f"unknown {what}"
    frame, number = np.unravel_index(values.argmax(), values.shape)
    largest = max(0.0, float(values.max()))
    return f"{largest:.2f} {what}" + f" ({names[number]}, frame {frame})" * (largest > 0)


def floor(model: mujoco.MjModel) -> np.ndarray:
    """Returns which geoms stand still and can be touched, [ngeom] bool."""
    touched = (model.geom_contype | model.geom_conaffinity) != 0
    return touched & (model.body_weldid[model.geom_bodyid] == 0)


def below_floor(model: mujoco.MjModel, qpos: np.ndarray) -> Measure:
    """Returns how deep each geom is in what stands still [mm]."""
    still, deep = floor(model), np.zeros((len(qpos), model.ngeom))
    for row, data in zip(deep, body.posed(model, qpos), strict=True):
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom
        touching = still[pairs].sum(axis=1) == 1
        for geom in pairs[touching].T:
            np.maximum.at(row, geom, -1e3 * data.contact.dist[touching])
    own = np.flatnonzero(~still & still.any())
    return deep[:, own], [body.bare(model.geom(i).name) for i in own]


def beyond_ranges(model: mujoco.MjModel, qpos: np.ndarray) -> Measure:
    """Returns how far each limited hinge is beyond its range [deg]."""
    hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    limited = np.flatnonzero(hinge & (model.jnt_limited != 0))
    (low, high), angles = model.jnt_range[limited].T, qpos[:, model.jnt_qposadr[limited]]
    beyond = np.rad2deg(np.maximum(low - angles, angles - high))
    return beyond, [body.bare(model.joint(i).name) for i in limited]


def from_positions(motion: Motion, clip: int, model: mujoco.MjModel, qpos: np.ndarray) -> Measure:
    """Returns how far bodies are from where the file says, by kinematics of its own joints [mm]."""
    own, places = body.kinematics(model, qpos)
    theirs = [body.bare(name) for name in motion.bodies]
    shared = [name for name in own if name in theirs]
    told = motion.positions[clip, : len(qpos)][:, [theirs.index(name) for name in shared]]
    apart = told - places[:, [own.index(name) for name in shared], :3]
    return 1e3 * np.linalg.norm(apart, axis=-1), shared
