"""A small body on a floor, motion of it, and files of that motion in both layouts."""

import mujoco
import numpy as np

XML = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <body name="walker/torso" pos="0 0 0.3">
      <freejoint name="walker/"/>
      <geom name="walker/trunk" type="capsule" fromto="-0.1 0 0 0.1 0 0" size="0.05"/>
      <body name="walker/leg" pos="0.1 0 0">
        <joint name="walker/hip" axis="0 1 0" range="-60 60" limited="true"/>
        <geom name="walker/thigh" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.02"/>
        <body name="walker/foot" pos="0 0 -0.1">
          <joint name="walker/knee" axis="0 1 0" range="-120 10" limited="true"/>
          <geom name="walker/toe" type="sphere" pos="0 0 -0.1" size="0.02"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="1 0 0.1"><freejoint/><geom name="ball" size="0.1" contype="0"/></body>
  </worldbody>
</mujoco>
"""
JOINTS = ("hip", "knee")
RATE = 50.0


def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


def tracks(lengths=(26, 11, 16)) -> list[np.ndarray]:
    """Returns root and joints [L, 9] of clips: ahead, turning about z, legs swinging."""
    found = []
    for i, length in enumerate(lengths):
        t = np.arange(length) / RATE
        turn = (i + 1) * t
        root = [0.4 * t, 0 * t, 0.3 + 0 * t, np.cos(turn / 2), 0 * t, 0 * t, np.sin(turn / 2)]
        found.append(np.stack([*root, 0.5 * np.sin(5 * t), -0.5 + 0.3 * np.cos(5 * t)], 1))
    return found


def places(values: np.ndarray) -> tuple[list[str], np.ndarray]:
    """Returns the names and positions [..., 4, 3] of bodies, by MuJoCo alone; the world first."""
    body, found = model(), np.zeros((*values.shape[:-1], 4, 3))
    data = mujoco.MjData(body)
    for index in np.ndindex(*values.shape[:-1]):
        data.qpos[:9] = values[index]
        mujoco.mj_kinematics(body, data)
        found[index] = data.xpos[:4]
    return ["world", "torso", "leg", "foot"], found


def texts(words) -> np.ndarray:
    return np.array([word.encode() for word in words], "S")


def flat_arrays(clips=2, frames=16, config=True) -> dict:
    """Returns the datasets of a flat file: so many clips of `frames` frames."""
    values = np.concatenate(tracks((frames,) * clips))
    names, xpos = places(values)
    snips = "".join(f"    - {name}\n" for name in ("Walk_12.p", "Rear_3.p", "Walk_7.p")[:clips])
    about = {"config": np.bytes_(f"model:\n  SCALE_FACTOR: 0.9\n  snips_order:\n{snips}")}
    return {
        "qpos": values.astype(np.float32),
        "names_qpos": texts(["root"] * 7 + list(JOINTS)),
        "xpos": xpos.astype(np.float32),
        "names_xpos": texts(names),
    } | (about if config else {})


def named_arrays(clips=3, frames=16) -> dict:
    """Returns the datasets of a named file."""
    values = np.stack(tracks((frames,) * clips))
    names, xpos = places(values)
    return {
        "all_clips/position": values[..., :3],
        "all_clips/quaternion": values[..., 3:7],
        "all_clips/joints": values[..., 7:],
        "all_clips/body_positions": xpos,
        "metadata/joint_names": texts(JOINTS),
        "metadata/body_names": texts(names),
    }


def write(path, arrays: dict) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, x in arrays.items():
            file[name] = x
