"""Motion fitted to a body: joints by their names, another rate, velocities, kinematics."""

from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.clips.records import Clips, Motion, check_rate
from purerl.core.errors import UserError, some
from purerl.physics.drawing import root_body

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
WIDTHS = {FREE: 7, int(mujoco.mjtJoint.mjJNT_BALL): 4}  # numbers in qpos; others have one
ROOT = "root"  # what a free joint's seven columns are called, whatever file and body call it
FARTHEST = 100.0  # lengths of its own that no body is high, or goes in a second, as a fly does
FEW = 10  # frames by which quaternions are tried
# Numbers [L, n] of a track's frames, and the n names that they are of.
Measure = tuple[np.ndarray, list[str]]


def bare(name: str) -> str:
    """Returns a name without the scopes that composing gives it: "torso" of "walker/torso"."""
    return name.rpartition("/")[2]


def joint_places(model: mujoco.MjModel) -> dict[str, list[int]]:
    """Returns where each joint of the body stands in qpos, and none of what stands around it."""
    own, found = model.body_rootid[model.jnt_bodyid] == root_body(model), {}
    for i in np.flatnonzero(own).tolist():
        kind, start = int(model.jnt_type[i]), int(model.jnt_qposadr[i])
        name = ROOT if kind == FREE else bare(model.joint(i).name)
        found[name] = list(range(start, start + WIDTHS.get(kind, 1)))
    return found


def poses(motion: Motion, model: mujoco.MjModel, allow: Sequence[str] = ()) -> list[np.ndarray]:
    """Returns qpos [L, nq] float64 of each clip at its own rate; see `fit`."""
    wanted, offered = joint_places(model), dict[str, list[int]]()
    for i, name in enumerate(motion.columns):
        offered.setdefault(ROOT if motion.columns.count(name) == 7 else bare(name), []).append(i)
    _check_joints(offered, wanted, set(allow))
    shared = [n for n in wanted if len(wanted[n]) == len(offered.get(n, ()))]
    places, columns = (sum((of[n] for n in shared), []) for of in (wanted, offered))
    tracks = []
    for name, length, values in zip(motion.names, motion.lengths, motion.values, strict=True):
        qpos = np.tile(model.qpos0, (length, 1))
        qpos[:, places] = values[:length, columns]
        fixed = qpos.copy()
        for row in fixed:
            mujoco.mj_normalizeQuat(model, row)
        if (off := np.abs(fixed - qpos).max(axis=1)).max() > 0.01:
            raise UserError(f"Clip {name!r}, frame {off.argmax()}: a quaternion is not of norm 1.")
        # What float32 rounded, keeps its bits.
        tracks.append(np.where(off[:, None] > 1e-6, fixed, qpos))
    return tracks


def _check_joints(offered: dict[str, list], wanted: dict[str, list], allow: set[str]) -> None:
    shared = wanted.keys() & offered.keys()
    if not shared - {ROOT} and shared != wanted.keys():
        both = f"their joints ({some(offered)}) is one of this one's ({some(wanted)})"
        raise UserError(f"The clips are of another body: none of {both}.")
    sides = {
        "lack joints of the body": [n for n in wanted if n not in offered],
        "have joints that it has not": [n for n in offered if n not in wanted],
        "have other columns for": [n for n in shared if len(wanted[n]) != len(offered[n])],
    }
    odd = {what: [n for n in names if n not in allow] for what, names in sides.items()}
    if said := [f"{what}: {some(names)}" for what, names in odd.items() if names]:
        told = "; they ".join(said)
        raise UserError(f"The clips {told}. Name in `allow` those that only one of them may have.")


def fit(motion: Motion, model: mujoco.MjModel, rate: float, allow: Sequence[str] = ()) -> Clips:
    """Makes clips of a body from what a file holds.

    Args:
      motion: as `read` returns it.
      model: the body's, with whatever stands around it. Joints are matched by names without scopes.
      rate: frames a second [Hz], as a rule one for each control step. Positions between the file's
        frames are on a line, quaternions on the shortest arc.
      allow: joints that only one of the two has. Those of the body stay as they are in qpos0, those
        of the file are left out.

    Returns:
      The clips. Velocities are those from a frame to the next, by MuJoCo's own difference.

    Raises:
      UserError: the clips are of another body, or no body moves as they do.
    """
    check_rate(rate)
    tracks = poses(motion, model, allow)
    for clip, qpos in enumerate(tracks):
        if told := _other_units(motion, clip, model, qpos):
            raise UserError(f"Clip {motion.names[clip]!r} {told}")
    tracks = [resample(model, qpos, motion.rate, rate) for qpos in tracks]
    return pack(model, tracks, motion.names, rate)


def _other_units(motion: Motion, clip: int, model: mujoco.MjModel, qpos: np.ndarray) -> str:
    """Returns in which other units a track [L, nq] must be, and by what that shows; else ""."""
    size, high = size_of(model), np.abs(root_places(model, qpos)[:, 2]).max()
    if max(high, fast := speeds(model, qpos, motion.rate).max()) > FARTHEST * size:
        told = f"is {high:,.0f} m high or moves at {fast:,.0f} m/s, its body {size:.2g} m long"
        return f"{told}: are these millimetres? Give metres."
    beyond, names = beyond_ranges(model, qpos)
    if names and np.median(beyond.max(axis=1)) > 180.0:
        told = f"has {names[beyond.max(axis=0).argmax()]} {beyond.max():,.0f} deg beyond its range"
        return f"{told}, and most frames are like that: are these degrees? Give radians."
    rolled, turn = qpos[:FEW].copy(), joint_places(model).get(ROOT, [])[3:]
    rolled[:, turn] = np.roll(rolled[:, turn], 1, axis=1)
    now, then = (from_positions(motion, clip, model, x)[0] for x in (qpos[:FEW], rolled))
    if now.size and now.mean() > max(1.0, 10.0 * then.mean()):
        told = f"is {now.mean():,.1f} mm from the file's positions, and {then.mean():,.1f} if w is"
        return f"{told} last in its quaternions: give it first."
    return ""


def pack(
    model: mujoco.MjModel, tracks: Sequence[np.ndarray], names: Sequence[str], rate: float
) -> Clips:
    """Puts tracks, qpos [L, nq] each at `rate` [Hz], into Clips, with their velocities.

    Raises:
      UserError: there is not one name for each track, or two are the same, or `rate` is none.
    """
    check_rate(rate)
    if len(set(names)) != len(tracks) or len(names) != len(tracks):
        many = f"{len(tracks)} tracks have {len(names)} names, {len(set(names))} of them different"
        raise UserError(f"{many}: give each track one of its own.")
    if wrong := [f"{x.shape}" for x in tracks if x.shape[1:] != (model.nq,)]:
        raise UserError(f"A track is of shape {wrong[0]}; it must be [L, {model.nq}] of this body.")
    lengths = np.array([len(qpos) for qpos in tracks], np.int32)
    padding = [((0, lengths.max() - length), (0, 0)) for length in lengths]
    qpos = [np.pad(x, more, "edge") for x, more in zip(tracks, padding, strict=True)]
    moving = [velocities(model, x, rate) for x in tracks]
    qvel = [np.pad(x, more) for x, more in zip(moving, padding, strict=True)]
    stacked, flowing = (jnp.asarray(np.stack(x), jnp.float32) for x in (qpos, qvel))
    return Clips(stacked, flowing, jnp.asarray(lengths), tuple(names), float(rate))


def resample(model: mujoco.MjModel, qpos: np.ndarray, old: float, new: float) -> np.ndarray:
    """Returns a track [L, nq] at another rate: both [Hz]; nothing is added after its end."""
    at = np.arange(int((len(qpos) - 1) * new / old + 1e-6) + 1) * (old / new)  # [frames]
    low, step = np.minimum(at + 1e-6, len(qpos) - 1).astype(int), np.zeros(model.nv)
    found = qpos[low]
    for row, frame, part in zip(found, low, at - low, strict=True):
        if part > 1e-6:  # the shortest way: a line, or the arc of a quaternion
            mujoco.mj_differentiatePos(model, step, 1.0, row, qpos[frame + 1])
            mujoco.mj_integratePos(model, row, step, part)
    return found


def velocities(model: mujoco.MjModel, qpos: np.ndarray, rate: float) -> np.ndarray:
    """Returns qvel [L, nv] that leads from each frame to the next; the last is the one before."""
    qvel = np.zeros((len(qpos), model.nv))
    for row, now, then in zip(qvel, qpos, qpos[1:], strict=False):
        mujoco.mj_differentiatePos(model, row, 1.0 / rate, now, then)
    qvel[-1] = qvel[max(0, len(qpos) - 2)]
    return qvel


def posed(model: mujoco.MjModel, qpos: np.ndarray) -> Iterator[mujoco.MjData]:
    """Yields data whose bodies and geoms are where they are in each frame of a track [L, nq]."""
    data = mujoco.MjData(model)
    for data.qpos[:] in qpos:
        mujoco.mj_kinematics(model, data)
        yield data


def own_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Returns the numbers of the body's parts, in the order in which `kinematics` has them."""
    return np.flatnonzero(model.body_rootid == root_body(model))


def kinematics(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Returns the bare names of the body's parts, and of each frame of a track where they are.

    The latter is [L, B, 7]: positions [m], then quaternions.
    """
    own = own_bodies(model)
    found = [np.hstack([data.xpos[own], data.xquat[own]]) for data in posed(model, qpos)]
    return [bare(model.body(i).name) for i in own], np.array(found)


def size_of(model: mujoco.MjModel) -> float:
    """Returns how long the body is in qpos0, more or less [m]."""
    places = kinematics(model, model.qpos0[None])[1][0, :, :3]
    own = model.body_rootid[model.geom_bodyid] == root_body(model)
    return float(np.ptp(places, axis=0).max() + 2.0 * model.geom_rbound[own].max(initial=5e-4))


def root_places(model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Returns where a free body is in each frame [m], [L, 3]; zeros if it is fixed."""
    root = joint_places(model).get(ROOT)
    return qpos[:, root[:3]] if root else np.zeros((len(qpos), 3))


def speeds(model: mujoco.MjModel, qpos: np.ndarray, rate: float) -> np.ndarray:
    """Returns how fast a free body goes from each frame to the next, [L] [m/s], at the end 0."""
    places = root_places(model, qpos)
    return np.linalg.norm(np.diff(places, axis=0, append=places[-1:]), axis=-1) * rate


def beyond_ranges(model: mujoco.MjModel, qpos: np.ndarray) -> Measure:
    """Returns how far each limited hinge is beyond its range [deg]."""
    hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    limited = np.flatnonzero(hinge & (model.jnt_limited != 0))
    (low, high), angles = model.jnt_range[limited].T, qpos[:, model.jnt_qposadr[limited]]
    beyond = np.rad2deg(np.maximum(low - angles, angles - high))
    return beyond, [bare(model.joint(i).name) for i in limited]


def from_positions(motion: Motion, clip: int, model: mujoco.MjModel, qpos: np.ndarray) -> Measure:
    """Returns how far bodies are from where the file says, by kinematics of its own joints [mm]."""
    own, places = kinematics(model, qpos)
    theirs = [bare(name) for name in motion.bodies]
    shared = [name for name in own if name in theirs]
    told = motion.positions[clip, : len(qpos)][:, [theirs.index(name) for name in shared]]
    apart = told - places[:, [own.index(name) for name in shared], :3]
    return 1e3 * np.linalg.norm(apart, axis=-1), shared
