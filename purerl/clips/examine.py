"""What is odd about clips, in numbers: under the floor, beyond a range, apart from kinematics."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from purerl.clips import body
from purerl.clips.records import Motion, behaviour_of


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
        said += [worst(*body.beyond_ranges(model, qpos), "deg beyond the range")]
        apart = body.from_positions(motion, i, model, qpos)
        said += [worst(*apart, "mm from the file's positions")]
        yield "; ".join(filter(None, said))


def worst(values: np.ndarray, names: list[str], what: str) -> str:
    """Returns the largest of numbers [L, n] in words: what it measures, of what, in which frame.

    "" where there is none: the body has no floor or no range, the file no positions.
    """
    if not values.size:
        return ""
    frame, number = np.unravel_index(values.argmax(), values.shape)
    largest = max(0.0, float(values.max()))
    return f"{largest:.2f} {what}" + f" ({names[number]}, frame {frame})" * (largest > 0)


def below_floor(model: mujoco.MjModel, qpos: np.ndarray) -> body.Measure:
    """Returns how deep each geom is in what stands still [mm]."""
    still = (model.geom_contype | model.geom_conaffinity) != 0  # what can be touched, of that:
    still &= model.body_weldid[model.geom_bodyid] == 0
    deep = np.zeros((len(qpos), model.ngeom))
    for row, data in zip(deep, body.posed(model, qpos), strict=True):
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom
        touching = still[pairs].sum(axis=1) == 1
        for geom in pairs[touching].T:
            np.maximum.at(row, geom, -1e3 * data.contact.dist[touching])
    own = np.flatnonzero(~still & still.any())
    return deep[:, own], [body.bare(model.geom(i).name) for i in own]
