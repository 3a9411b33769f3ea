"""Where clips of recorded motion come from: a file, a set that comes with purerl, dm_control's."""

from pathlib import Path

import numpy as np
from dm_control.locomotion import mocap
from dm_control.locomotion.walkers import cmu_humanoid

from purerl import UserError, clips

CLIPS = Path(__file__).parent.parent / "assets" / "clips"
# Names of sets that are no files: two falls of dm_control's humanoid, and squats of it.
CMU, SQUATS = "cmu", "squats"


def read(name: str) -> clips.Motion:
    """Reads recorded motion.

    Args:
      name: the path of an HDF5 file, the name of a set in `assets/clips`, `cmu` or `squats`.

    Raises:
      UserError: there is no such set, or no such file, or it cannot be read.
    """
    if name in (CMU, SQUATS):
        return cmu() if name == CMU else squats()
    if "/" in name or name.endswith((".h5", ".hdf5")):
        return clips.read(name)
    sets = sorted(path.stem for path in CLIPS.glob("*.h5"))
    if name not in sets:
        there = ", ".join([CMU, SQUATS, *sets])
        raise UserError(f"clips is {name!r}: give the path of an HDF5 file, or one of {there}.")
    return clips.read(CLIPS / f"{name}.h5")


def cmu() -> clips.Motion:
    """Returns two clips that dm_control ships, of 0.45 s: a humanoid that falls, and that lies."""
    import h5py

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


def squats() -> clips.Motion:
    """Returns a computed clip of the humanoid that squats five times in 10 s, 50 frames a second.

    Hips and ankles follow from the knees such that the feet stay flat and the centre of mass over
    the middle of them: lines through what was solved for with knees of 0.4, 0.8 and 1.2 rad.
    """
    time = np.arange(501) / 50.0
    knee = 0.8 - 0.4 * np.cos(np.pi * time)  # [rad]
    height = 0.897 - 0.12 * (knee - 0.4) - 0.0844 * (knee - 0.4) * (knee - 0.8)
    bent = {"femur": 0.104 - 0.5415 * knee, "tibia": knee, "foot": -0.163 - 0.536 * knee}
    bent |= {"humerus": 0.5 * np.sin(np.pi * time)}  # its arms swing
    places = [0 * time, 0 * time, height, *([0.5 + 0 * time] * 4)]  # upright, it faces along x
    joints = {joint.name: 0 * time for joint in cmu_humanoid.CMUHumanoid().mocap_joints}
    joints |= {f"{side}{name}rx": x for name, x in bent.items() for side in "lr"}
    values = np.stack([*places, *joints.values()], axis=1)[None]
    nothing = np.zeros((1, len(time), 0, 3))
    columns = ("root",) * 7 + tuple(joints)
    return clips.Motion(columns, values, np.array([501]), ("Squat_1",), 50.0, (), nothing)
