"""Makes bodies and clips of flies that other packages hold, for `fly_legs` and `fly_muscles`.

    python -m pip download --no-deps flygym==2.1.1 --python-version 3.12 --only-binary :all:
    python -m purerl.experiments.benchmarks.flies flygym-2.1.1-py3-none-any.whl

It writes, here, fly.xml and fly.h5: dm_control's fly on a tether, of which the legs alone are
driven (42 servos), and a second of a real fly's legs on a ball, at 100 Hz. And leg.xml and leg.h5:
a front leg with 15 muscles (FlyMimic's), and 0.45 s of a real one at 500 Hz. In neither does one
part touch another. Lengths are cm in the first, mm in the second.
"""

import argparse
import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from dm_control.locomotion.walkers import fruitfly_v2

from purerl.clips import body, files

FLY = Path(fruitfly_v2.__file__).parent / "assets" / "fruitfly_v2" / "fruitfly.xml"
LEG = "flygym/assets/model/musculoskeletal/best_combined_arm_damping_stiff_cvt3.xml"
FLY_CLIP = "flygym_demo/ball_flybody_data/assets/ball_flybody_clip.npz"
LEG_CLIP = "flygym_demo/muscle_imitation/assets/mocap/qpos/0002.npy"
LEG_RATE = 500.0  # [Hz] of its clip, which does not say it
LEG_JOINTS = [f"joint_LFCoxa_{axis}" for axis in ("yaw", "pitch", "roll")]
LEG_JOINTS += [f"joint_LFTrochanter_{axis}" for axis in ("yaw", "pitch", "roll")]
LEG_JOINTS += ["joint_LFTibia_pitch"]
# What flygym calls the joints: the part that turns, and its axis.
FLY_JOINTS = {
    ("coxa", "pitch"): "coxa",
    ("coxa", "roll"): "coxa_twist",
    ("coxa", "yaw"): "coxa_abduct",
    ("trochanterfemur", "pitch"): "femur",
    ("trochanterfemur", "roll"): "femur_twist",
    ("tibia", "pitch"): "tibia",
    ("tarsus1", "pitch"): "tarsus",
}
SIDES = {"l": "left", "r": "right"}
PAIRS = {"f": 1, "m": 2, "h": 3}


def fly_joint(leg: str, part: str, axis: str) -> str:
    """Returns dm_control's name of a joint of flygym's.

    >>> fly_joint("lm", "coxa", "yaw")
    'coxa_abduct_T2_left'
    """
    return f"{FLY_JOINTS[part, axis]}_T{PAIRS[leg[1]]}_{SIDES[leg[0]]}"


def tethered(spec: mujoco.MjSpec, joints: Sequence[str], kept: Sequence[str]) -> str:
    """Returns MJCF of a body that moves in these joints alone, and meets nothing.

    Args:
      spec: the body.
      joints: names of the joints that stay.
      kept: names of the actuators that stay, as do the tendons that they pull.
    """
    pulled = {x.target for x in spec.actuators if x.name in kept}
    gone = [*spec.sensors, *spec.keys, *spec.equalities, *spec.excludes]
    gone += [x for x in spec.actuators if x.name not in kept]
    gone += [x for x in spec.tendons if x.name not in pulled]
    for one in [*gone, *(x for x in spec.joints if x.name not in joints)]:
        spec.delete(one)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.noslip_iterations = 0
    spec.compile()
    return spec.to_xml()


def fly() -> str:
    """Returns MJCF of dm_control's fly on a tether."""
    joints = [
        fly_joint(side + pair, *dof) for side in SIDES for pair in PAIRS for dof in FLY_JOINTS
    ]
    spec = mujoco.MjSpec.from_file(str(FLY))
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [1, 1, 0.1], "pos": [0, 0, -0.3]}
    spec.worldbody.add_geom(name="floor", **floor)
    text = tethered(spec, joints, joints)
    return text.replace("<compiler ", f'<compiler meshdir="{FLY.parent}" ', 1)


def leg(text: str) -> str:
    """Returns MJCF of the leg without its meshes: its package lacks them, and they have no mass."""
    text = re.sub(r'<geom [^>]*mesh="[^>]*/>|<mesh [^>]*/>', "", text)
    spec = mujoco.MjSpec.from_string(text)
    muscles = [x.name for x in spec.actuators if x.trntype == mujoco.mjtTrn.mjTRN_TENDON]
    return tethered(spec, LEG_JOINTS, muscles)


def write(name: str, text: str, joints: Sequence[str], angles: np.ndarray, rate: float) -> None:
    """Writes a body, and a clip of its joints [T, J] at a rate [Hz]."""
    Path(f"{name}.xml").write_text(text)
    model = mujoco.MjModel.from_xml_path(f"{name}.xml")
    qpos = np.zeros((len(angles), model.nq))
    qpos[:, [model.joint(joint).qposadr[0] for joint in joints]] = angles
    packed = body.pack(model, [qpos], [f"{name.capitalize()}_1"], rate)
    files.write(Path(f"{name}.h5"), packed, model)


def main() -> None:
    """Writes the four files."""
    parser = argparse.ArgumentParser(
        prog="python -m purerl.experiments.benchmarks.flies", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("wheel", type=Path, help="flygym's wheel")
    with zipfile.ZipFile(parser.parse_args().wheel) as wheel:
        clip = np.load(io.BytesIO(wheel.read(FLY_CLIP)), allow_pickle=True)
        steps = np.load(io.BytesIO(wheel.read(LEG_CLIP)))
        muscles = leg(wheel.read(LEG).decode())
    given = [fly_joint(leg, *dof[1:]) for leg in clip["legs"] for dof in clip["dofs_per_leg"]]
    angles = clip["joint_angles"].reshape(len(clip["joint_angles"]), -1)
    write("fly", fly(), given, angles, float(clip["data_fps"]))
    write("leg", muscles, LEG_JOINTS, steps, LEG_RATE)


if __name__ == "__main__":
    main()
