"""Where clips of recorded motion come from: a file, a set that comes with purerl, dm_control's."""

from pathlib import Path

import numpy as np

from purerl import UserError, clips

CLIPS = Path(__file__).parent.parent / "assets" / "clips"
CMU = "cmu"  # the name of dm_control's two recordings of a person


def read(name: str) -> clips.Motion:
    """Reads recorded motion.

    Args:
      name: the path of an HDF5 file, the name of a set in `assets/clips`, or `cmu`.

    Raises:
      UserError: there is no such set, or no such file, or it cannot be read.
    """
    if name == CMU:
        return cmu()
    if "/" in name or name.endswith((".h5", ".hdf5")):
        return clips.read(name)
    sets = sorted(path.stem for path in CLIPS.glob("*.h5"))
    if name not in sets:
        there = ", ".join([CMU, *sets])
        raise UserError(f"clips is {name!r}: give the path of an HDF5 file, or one of {there}.")
    return clips.read(CLIPS / f"{name}.h5")


def cmu() -> clips.Motion:
    """Returns what dm_control ships of the CMU's: two clips of a humanoid, 0.45 s each."""
    import h5py
    from dm_control.locomotion import mocap
    from dm_control.locomotion.walkers import cmu_humanoid

    walker = cmu_humanoid.CMUHumanoid()
    joints = tuple(joint.name for joint in walker.mocap_joints)
    bodies = tuple(body.name for body in walker.mocap_tracking_bodies)
    with h5py.File(Path(mocap.__file__).parent / "test_trajectories.h5") as file:
        names, people = tuple(file), [file[name]["walkers/walker_0"] for name in file]
        parts = [[person[key] for key in ("position", "quaternion", "joints")] for person in people]
        values = np.stack([np.vstack(part).T for part in parts])  # a file's are [numbers, T]
        number, frames, _ = values.shape
        told = np.stack([person["body_positions"][()].T for person in people])
        rate = 1.0 / float(file[names[0]].attrs["dt"])
    columns, lengths = ("root",) * 7 + joints, np.full(number, frames)
    places = told.reshape(number, frames, -1, 3)
    return clips.Motion(columns, values, lengths, names, rate, bodies, places)
