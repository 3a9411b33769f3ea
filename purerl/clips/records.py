"""Clips as a file has them and as an environment does, and sets of these: chosen, held out, cut."""

import hashlib
import re
from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from purerl.core.errors import UserError, some, unknown_name
from purerl.core.records import Array


class Motion(NamedTuple):
    """What a file holds, in its own words: C clips of at most T frames, fitted to no body yet."""

    columns: tuple[str, ...]  # K: the joint that each column is of; a free joint has seven
    values: np.ndarray  # [C, T, K] as MuJoCo's qpos: [m], [rad], quaternions
    lengths: np.ndarray  # [C] int frames
    names: tuple[str, ...]  # C, all different
    rate: float  # frames a second [Hz]
    bodies: tuple[str, ...]  # B
    positions: np.ndarray  # [C, T, B, 3] of the bodies [m]


class Clips(NamedTuple):
    """Recorded motion of one body at one rate: C clips of at most T frames.

    After its last frame a clip stays in it, with velocities of 0.
    """

    qpos: Array  # [C, T, nq] float32, as MuJoCo's: [m], [rad], quaternions
    qvel: Array  # [C, T, nv] float32 from a frame to the next; a free joint's turn in its own frame
    lengths: Array  # [C] int32 frames
    names: tuple[str, ...]  # C, all different
    rate: float  # frames a second [Hz]


def behaviour_of(name: str) -> str:
    """Returns what a clip shows: its name without its number and ending.

    >>> behaviour_of("FastWalk_12.p")
    'FastWalk'
    """
    return re.sub(r"[\s_/-]*\d*(\.[A-Za-z]\w*)?$", "", name) or name


def check_rate(rate: float) -> None:
    """Raises UserError for what is no rate [Hz], but perhaps the seconds from a frame to a next."""
    if not 2.0 <= rate < np.inf:  # nothing is recorded more slowly
        raise UserError(f"rate is {rate:g}; give frames a second, 2 Hz or more: 0.02 s are 50 Hz.")


def choose(clips: Clips, *names: str) -> Clips:
    """Returns the clips of these names or behaviours, in the order in which they are in `clips`.

    Raises:
      UserError: there is no clip and no behaviour of a name; the message has the nearest one.
    """
    known = [{name, behaviour_of(name)} for name in clips.names]
    for name in names:
        if name not in (valid := dict.fromkeys([*map(behaviour_of, clips.names), *clips.names])):
            raise UserError(unknown_name("clip or behaviour", name, valid))
    return _take(clips, [bool(each & set(names)) for each in known])


def split(clips: Clips, held_out: float = 0.2, seed: int = 0) -> tuple[Clips, Clips]:
    """Splits clips into those to train with and those held out, each clip whole.

    On which side a clip is follows from its name and the seed alone: further clips move none.

    Args:
      clips: the clips.
      held_out: about this share is held out, in (0, 1).
      seed: another one splits otherwise.

    Returns:
      The clips to train with, and those held out.

    Raises:
      UserError: that is no share, or one side is empty.
    """
    if not 0.0 < held_out < 1.0:
        raise UserError(f"held_out is {held_out}; it must be a share, above 0 and below 1.")
    hashes = [hashlib.sha256(f"{seed}/{name}".encode()).digest() for name in clips.names]
    out = np.array([int.from_bytes(x[:6], "big") < held_out * 2**48 for x in hashes])
    if out.all() or not out.any():
        raise UserError(
            f"held_out is {held_out}, seed {seed}: {out.sum()} of {len(out)} clips are held out, "
            "and neither side may be empty; give another share or seed, or take all of them."
        )
    return _take(clips, ~out), _take(clips, out)


def _take(clips: Clips, kept: Iterable[bool]) -> Clips:
    """Returns some clips; `kept` has C of them."""
    numbers = np.flatnonzero(np.array(kept))
    qpos, qvel, lengths = (x[numbers] for x in clips[:3])
    return Clips(qpos, qvel, lengths, tuple(clips.names[i] for i in numbers), clips.rate)


def cut(clips: Clips, name: str, start: float = 0.0, end: float | None = None) -> Clips:
    """Returns one clip alone, from `start` to `end` [s], the frames at both among them.

    Raises:
      UserError: there is no such clip, or it does not last from `start` to `end`.
    """
    if name not in clips.names:
        raise UserError(unknown_name("clip", name, clips.names))
    number, rate = clips.names.index(name), clips.rate
    last = int(clips.lengths[number]) - 1
    end = last / rate if end is None else end
    first, end_frame = np.round([start * rate, end * rate])
    if not 0 <= first <= end_frame <= last:
        whole = f"Clip {name!r} lasts from 0 to {last / rate:g} s"
        raise UserError(f"{whole}: {start:g} to {end:g} s is no part of it.")
    qpos, qvel = (x[number : number + 1, int(first) : int(end_frame) + 1] for x in clips[:2])
    return Clips(qpos, qvel, jnp.array([qpos.shape[1]], jnp.int32), (name,), rate)


def check_window(clips: Clips, window: int) -> None:
    """Raises UserError if a clip has fewer frames than `window`, those that are read at once."""
    lengths = zip(clips.names, clips.lengths.tolist(), strict=True)
    if short := [f"{name} ({length})" for name, length in lengths if length < window]:
        clip = f"clips have fewer than the window's {window} frames at {clips.rate:g} Hz"
        raise UserError(f"{len(short)} of {len(clips.names)} {clip}: {some(short)}.")
