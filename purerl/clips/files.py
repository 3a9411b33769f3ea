"""Files of recorded motion, in HDF5: two layouts are read, the named one is written.

named   all_clips/joints [C, T, J], /position [C, T, 3], /quaternion [C, T, 4] and, to be compared
        with, /body_positions [C, T, B, 3]; metadata/joint_names, /body_names. purerl adds
        metadata/clip_names, /clip_lengths and the attribute `rate` of all_clips [Hz].
flat    qpos [N, K], names_qpos [K] (a free joint is seven columns of one name), xpos [N, B, 3],
        names_xpos [B], config (YAML): all clips one after the other, of one length.
"""

import contextlib
import functools
import io
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from purerl.clips import body
from purerl.clips.records import Clips, Motion, check_rate
from purerl.core.errors import UserError, reason, some
from purerl.machine import files
from purerl.machine.command_errors import check_installed

SIGNATURE = b"\x89HDF\r\n\x1a\n"  # at the beginning, or after a block of up to 2048 bytes


def read(path: Path | str, rate: float = 0.0, frames: int = 0) -> Motion:
    """Reads a file of clips.

    Args:
      path: an HDF5 file of either layout.
      rate: at which it was recorded [Hz], where the file does not say so.
      frames: of each clip of a flat file, where it does not say so.

    Raises:
      UserError: the file is not one, or cut short, or lacks something, or holds what is no number;
        or `rate` is neither here nor there, or another, or none.
    """
    check_installed("h5py", "clips")
    import h5py

    path = Path(path)
    try:
        with files.open_file(path) as opened:
            begin = opened.read(4096)
            if SIGNATURE not in begin:
                raise UserError(f"{path} is no HDF5 file: it begins with {begin[:8]!r}.")
            with h5py.File(opened, "r") as file:
                named = "all_clips" in file
                motion = _read_named(path, file) if named else _read_flat(path, file, frames)
    except (OSError, RuntimeError) as error:
        broken = "cannot be read" if getattr(error, "errno", None) else "is cut short or broken"
        here = "" if path.is_absolute() else f" (in {Path.cwd()})"
        raise UserError(f"{path} {broken}: {reason(error)}{here}.") from error
    _check_values(path, motion)
    if not (motion.rate or rate) > 0.0:
        raise UserError(
            f"{path} does not say its rate: give it, as rate=50 [Hz]. `python -m purerl.clips "
            f"{path} --rate 50 --body BODY -o NEW.h5` writes a file that says it."
        )
    if motion.rate and rate and motion.rate != rate:
        raise UserError(f"{path} is of {motion.rate:g} Hz, not {rate:g}: leave the rate out.")
    check_rate(motion.rate or rate)
    return motion._replace(rate=motion.rate or float(rate))


def _array(
    path: Path, file: Any, name: str, dims: int, begin: tuple[int, ...] = (), other: Any = None
) -> Any:
    """Returns a dataset of so many dimensions, the first ones `begin`; texts as str.

    Where there is none it is `other`, and a UserError if that is None.
    """
    if name not in file and other is not None:
        return other
    if name not in file:
        there: list[str] = []
        if "episodes" in file:
            raise UserError(f"{path} has episodes of `record`, no clips: record with --clips.")
        file.visit(there.append)
        raise UserError(f"{path} lacks {name}; there are: {some(there, 30) or 'none'}.")
    found = np.asarray(file[name])
    if found.ndim != dims or found.shape[: len(begin)] != begin:
        must = f"have {dims} dimensions" + f", the first {list(begin)}" * bool(begin)
        raise UserError(f"{path}: {name} is of shape {list(found.shape)}; it must {must}.")
    if found.dtype.kind not in "SO":
        return found
    return tuple(x.decode() if isinstance(x, bytes) else str(x) for x in found)


def _read_named(path: Path, file: Any) -> Motion:
    get = functools.partial(_array, path, file)
    values = get("all_clips/joints", 3)
    clips, width = values.shape[:2], values.shape[2:]
    columns = get("metadata/joint_names", 1, width)
    if "all_clips/position" in file or "all_clips/quaternion" in file:
        root = [get(f"all_clips/{name}", 3, clips) for name in ("position", "quaternion")]
        if (widths := [x.shape[-1] for x in root]) != [3, 4]:
            raise UserError(f"{path}: position and quaternion have {widths} columns, not [3, 4].")
        columns, values = (body.ROOT,) * 7 + columns, np.concatenate([*root, values], -1)
    names = get("metadata/clip_names", 1, clips[:1], _numbered(clips[0]))
    lengths = get("metadata/clip_lengths", 1, clips[:1], np.full(*clips))
    positions = get("all_clips/body_positions", 4, clips, np.zeros((*clips, 0, 3)))
    bodies = get("metadata/body_names", 1, positions.shape[2:3]) if positions.size else ()
    try:
        rate = float(said := file["all_clips"].attrs.get("rate", 0.0))
    except (TypeError, ValueError):
        raise UserError(f"{path}: rate is {said!r}; it must be a number [Hz].") from None
    return Motion(columns, values, lengths, names, rate, bodies, positions)


def _read_flat(path: Path, file: Any, frames: int) -> Motion:
    get, config = functools.partial(_array, path, file), _config(file)
    qpos = get("qpos", 2)
    names = tuple(map(str, config.get("model", {}).get("snips_order", ())))
    frames = frames or config.get("stac", {}).get("n_frames_per_clip", 0)
    frames = frames or len(qpos) // max(1, len(names)) * bool(names)
    if not frames:
        raise UserError(f"{path} does not say how long its clips are: give it, as --frames 250.")
    number = len(qpos) // frames
    if number * frames != len(qpos) or len(names) not in (0, number):
        told = f" and the names of {len(names)} clips" * bool(names)
        raise UserError(f"{path} has {len(qpos)} frames{told}: no clips of {frames} frames each.")
    columns, lengths = get("names_qpos", 1, qpos.shape[1:]), np.full(number, frames)
    positions = get("xpos", 3, qpos.shape[:1], np.zeros((len(qpos), 0, 3)))
    bodies = get("names_xpos", 1, positions.shape[1:2]) if positions.size else ()
    values, places = (x.reshape(number, frames, *x.shape[1:]) for x in (qpos, positions))
    return Motion(columns, values, lengths, names or _numbered(number), 0.0, bodies, places)


def _numbered(number: int) -> tuple[str, ...]:
    return tuple(f"clip_{i:04d}" for i in range(number))


def _config(file: Any) -> dict[str, Any]:
    """Returns a flat file's own settings; what cannot be understood is as if it were not there."""
    import yaml

    with contextlib.suppress(KeyError, AttributeError, yaml.YAMLError):
        found = yaml.safe_load(file["config"][()])
        return {name: group for name, group in found.items() if isinstance(group, dict)}
    return {}


def _check_values(path: Path, motion: Motion) -> None:
    """Raises UserError for names that are not different, wrong lengths, and what is no number."""
    most = motion.values.shape[1]
    if not 0 < len(set(motion.names)) == len(motion.names):
        raise UserError(f"{path} has clips of one name, or none: {some(motion.names)}.")
    for name, length, x in zip(motion.names, motion.lengths, motion.values, strict=True):
        if not 1 <= length <= most:
            raise UserError(f"{path}: clip {name!r} has {length} frames; it must be 1 to {most}.")
        if len(wrong := np.argwhere(~np.isfinite(x[:length]))):
            what = f"{motion.columns[wrong[0, 1]]!r} is {x[tuple(wrong[0])]} at frame {wrong[0, 0]}"
            raise UserError(f"{path}: clip {name!r}: {what}.")


def write(path: Path | str, clips: Clips, model: mujoco.MjModel) -> None:
    """Writes clips in the named layout, with velocities and with where the body's parts are.

    Angular velocities are in the body's own frame, as in MuJoCo's qvel.

    Args:
      path: the file, written whole or not at all.
      clips: the clips.
      model: of their body.

    Raises:
      UserError: the file cannot be written, or the body has a ball joint, which this layout has
        not.
    """
    check_installed("h5py", "clips")
    import h5py

    places = body.joint_places(model)
    root = places.pop(body.ROOT, [])[:1]
    if balls := [name for name, place in places.items() if len(place) > 1]:
        raise UserError(f"This layout has no ball joints: {some(balls)}.")
    joints = [start for start, *_ in places.values()]
    dofs = dict(zip(model.jnt_qposadr.tolist(), model.jnt_dofadr.tolist(), strict=True))
    qpos, qvel = np.asarray(clips.qpos), np.asarray(clips.qvel)
    arrays = {"joints": qpos[..., joints], "joints_velocity": qvel[..., [dofs[i] for i in joints]]}
    for i in root:
        arrays |= {"position": qpos[..., i : i + 3], "quaternion": qpos[..., i + 3 : i + 7]}
        speeds = qvel[..., dofs[i] : dofs[i] + 6]
        arrays |= {"velocity": speeds[..., :3], "angular_velocity": speeds[..., 3:]}
    posed = [body.kinematics(model, track) for track in qpos]
    parts = np.stack([x for _, x in posed])
    arrays |= {"body_positions": parts[..., :3], "body_quaternions": parts[..., 3:]}
    texts = {"joint_names": places, "body_names": posed[0][0], "clip_names": clips.names}
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for name, x in arrays.items():
            file.create_dataset(f"all_clips/{name}", data=x.astype(np.float32), compression="gzip")
        for name, words in texts.items():
            file[f"metadata/{name}"] = np.array([word.encode() for word in words], "S")
        file["metadata/clip_lengths"] = np.asarray(clips.lengths)
        file["all_clips"].attrs["rate"] = clips.rate
    files.write_answer(Path(path), content.getvalue())
