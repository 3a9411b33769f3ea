"""Bodies of flies: which joints and actuators stay (a second in all)."""

import mujoco
import numpy as np

from purerl.experiments.benchmarks import flies

LEG = """
<mujoco>
  <asset><mesh name="hull" file="./lost.stl"/></asset>
  <worldbody>
    <body name="thorax">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <geom name="hull" type="mesh" rgba="1 1 1 1" mesh="hull"/>
      <site name="a"/>
      <body name="leg" pos="0 0 -1">
        <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        <joint name="joint_LFCoxa_yaw" axis="1 0 0"/>
        <joint name="joint_RFCoxa_yaw" axis="0 1 0"/>
        <geom type="capsule" size=".1 .2"/>
        <site name="b" pos="0 .1 0"/>
      </body>
    </body>
  </worldbody>
  <tendon><spatial name="t"><site site="a"/><site site="b"/></spatial></tendon>
  <actuator>
    <muscle name="promotor" tendon="t"/>
    <motor name="motor" joint="joint_LFCoxa_yaw"/>
  </actuator>
</mujoco>
"""


def test_a_tethered_fly_has_its_legs_joints_and_servos_alone():
    model = mujoco.MjModel.from_xml_string(flies.fly())
    assert (model.nq, model.nv, model.nu) == (42, 42, 42)
    assert not (model.geom_contype | model.geom_conaffinity).any()
    np.testing.assert_array_equal(np.sort(model.actuator_trnid[:, 0]), np.arange(42))


def test_a_leg_has_its_muscles_and_joints_without_the_meshes():
    model = mujoco.MjModel.from_xml_string(flies.leg(LEG))
    assert (model.nq, model.nu, model.nmesh) == (1, 1, 0)
    assert model.joint(0).name == "joint_LFCoxa_yaw" and model.actuator(0).name == "promotor"
    assert (model.body_mass[1:] == 1.0).all()
