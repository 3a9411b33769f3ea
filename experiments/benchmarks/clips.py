r"""Makes the clips that come with purerl, of episodes of policies: see `assets/clips`.

    python -m purerl.record RUN --episodes 48 --seed 5 --out commands.npz   # of rodent_joystick
    python -m purerl.record rodent_gaps --episodes 6 --seed 3 --out gaps.npz
    python -m purerl.experiments.benchmarks.clips commands.npz gaps.npz assets/clips/rodent.h5
    python -m purerl.record ant_gaps --episodes 24 --seed 5 --out motion.h5 --clips
    python -m purerl.experiments.benchmarks.clips motion.h5 assets/clips/ant.h5

A clip of the rodent is as long as a command holds; the first of an episode is left out, where the
body still falls onto its feet. One of the ant is an episode. What can be computed from the joints
is not written.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from purerl.clips import body
from purerl.envs import joystick, run

EACH = 4  # clips of a kind
RATE = 50.0  # control steps a second of both
FRAMES = round(joystick.Options().hold * RATE)
MIDDLES = {name: np.mean(ranges, axis=1) for name, ranges in joystick.COMMANDS.items()}


def named(command: np.ndarray) -> str:
    """Returns the kind of a command [3], such as "Run": the nearest, in widths of its reward."""
    off = {n: np.abs((np.abs(command) - x) / joystick.WIDTHS).sum() for n, x in MIDDLES.items()}
    return min(off, key=lambda name: off[name]).capitalize()


def parts(commands: Path, gaps: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yields the kind of each part of the episodes, and its qpos [FRAMES, nq]."""
    told, leaps = np.load(commands), np.load(gaps)
    for start in range(FRAMES, told["physics/qpos"].shape[1] - FRAMES + 1, FRAMES):
        for i in np.flatnonzero(told["length"] >= start + FRAMES):
            track = told["physics/qpos"][i, start : start + FRAMES]
            yield named(told["task/command"][i, start + FRAMES // 2]), track
    for i in np.flatnonzero(leaps["length"] >= 2 * FRAMES):
        yield "Leap", leaps["physics/qpos"][i, FRAMES : 2 * FRAMES]


def of_rodent(commands: Path, gaps: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns arrays [C, FRAMES, ...] and metadata of the first EACH clips of a kind."""
    kinds: dict[str, list[np.ndarray]] = {}
    for kind, track in parts(commands, gaps):
        kinds.setdefault(kind, []).append(track)
    names = [f"{kind}_{i + 1}" for kind, tracks in kinds.items() for i in range(len(tracks[:EACH]))]
    values = np.stack([track for tracks in kinds.values() for track in tracks[:EACH]])
    places = body.joint_places(run.build(run.Options(body="rodent"), "c").physics.model)
    root = places.pop(body.ROOT)
    arrays = {"position": values[..., root[:3]], "quaternion": values[..., root[3:]]}
    arrays["joints"] = values[..., [start for start, *_ in places.values()]]
    texts = {"joint_names": list(places), "clip_names": names}
    return arrays, {name: np.array([x.encode() for x in texts[name]], "S") for name in texts}


def of_episodes(motion: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], float]:
    """Returns arrays, metadata and rate [Hz] of clips, without what follows from the joints."""
    with h5py.File(motion) as file:
        arrays = {
            name: file[f"all_clips/{name}"][()] for name in ("position", "quaternion", "joints")
        }
        words = {name: x[()] for name, x in file["metadata"].items() if name != "body_names"}
        return arrays, words, float(file["all_clips"].attrs["rate"])


def main() -> None:
    """Writes the file."""
    parser = argparse.ArgumentParser(
        prog="python -m purerl.experiments.benchmarks.clips", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument(
        "recorded", type=Path, nargs="+", help="one file of clips, or two of arrays"
    )
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    one = len(given.recorded) == 1
    found = of_episodes(*given.recorded) if one else (*of_rodent(*given.recorded), RATE)
    with h5py.File(given.out, "w-") as file:
        for name, x in found[0].items():
            packed = {"compression": "gzip", "compression_opts": 9, "shuffle": True}
            file.create_dataset(f"all_clips/{name}", data=x.astype(np.float32), **packed)
        for name, x in found[1].items():
            file[f"metadata/{name}"] = x
        file["all_clips"].attrs["rate"] = found[2]
    print(f"{given.out}: {', '.join(x.decode() for x in found[1]['clip_names'])}")


if __name__ == "__main__":
    main()
