"""The bodies: dm_control's walkers, each behind one small frozen record."""

import dataclasses
import math
from collections.abc import Callable

from dm_control import mjcf
from dm_control.locomotion.walkers import ant as dm_ant, cmu_humanoid, rodent as dm_rodent


@dataclasses.dataclass(frozen=True)
class Body:
    """What an environment needs to know of a body beyond its MJCF.

    Names are those of the body's own MJCF, without the prefix that composing gives them.
    """

    name: str
    build: Callable[[], mjcf.RootElement]  # a new MJCF model at each call
    torso: str  # the outermost body: its subtree is the whole walker
    end_effectors: tuple[str, ...]  # bodies, in dm_control's order
    ground_geoms: tuple[str, ...]  # geoms that can touch the ground; () means all that collide
    spawn_height: float  # torso above the ground at rest [m]
    healthy_height: tuple[float, float]  # torso above the ground, upright and not flying [m]
    healthy_turn: float  # farthest it may turn from the way ahead, seen from above [rad]
    reach: (
        float  # farthest its ground_geoms get from the torso, with one control step of motion [m]
    )
    longest_gap: float  # its own length without the tail: no gap may be wider [m]
    sight: float  # how far ahead it is told of edges [m]
    timestep: float  # of physics [s]
    mjx_iterations: tuple[int, int]  # of Newton's method and of its line search
    camera: str  # its own, from whose place it sees with one eye
    eye_distance: float  # of two eyes beside that place [m]


def _ant_mjcf() -> mjcf.RootElement:
    return dm_ant.Ant().mjcf_model


def _rodent_mjcf() -> mjcf.RootElement:
    return dm_rodent.Rat().mjcf_model


def _humanoid_mjcf() -> mjcf.RootElement:
    return cmu_humanoid.CMUHumanoidPositionControlled().mjcf_model


def _both_sides(*names: str) -> tuple[str, ...]:
    """Replaces the `?` of each name by L and by R."""
    return tuple(name.replace("?", side) for name in names for side in "LR")


ANT = Body(
    name="ant",
    build=_ant_mjcf,
    torso="torso",
    end_effectors=(
        "front_left_foot",
        "front_right_foot",
        "back_right_foot",
        "back_left_foot",
    ),
    ground_geoms=(),
    spawn_height=0.522,
    healthy_height=(0.25, 1.2),
    healthy_turn=math.inf,  # it looks the same from all four sides
    reach=1.25,
    longest_gap=1.0,
    sight=4.0,
    timestep=0.005,
    mjx_iterations=(4, 8),
    camera="egocentric",
    eye_distance=0.1,
)

# Trunk, head and limbs, one capsule or ellipsoid a part: what the animal can stand or lie on.
# Not the tail (30 geoms), the small bones of the neck, the teeth, and doubles inside another.
_RODENT_CORE = (
    "collision_torso",
    "collision_pelvis_gut",
    "vertebra_1_collision",
    "vertebra_3_collision",
    "vertebra_5_collision",
    "vertebra_cervical_3_collision",
    "skull_0_collision",
    "skull_F_collision",
    "jaw_F_collision",
    *_both_sides("collision_pelvis_?", "upper_leg_?0_collision", "lower_leg_?_collision"),
    *_both_sides("foot_?_collision", "toe_?0_collision", "toe_?1_collision", "toe_?2_collision"),
    *_both_sides("humerus_?_collision", "radius_?_collision", "hand_?_collision"),
    *_both_sides("finger_?0_collision", "finger_?1_collision", "finger_?2_collision"),
)

RODENT = Body(
    name="rodent",
    build=_rodent_mjcf,
    torso="torso",
    end_effectors=("lower_arm_R", "lower_arm_L", "foot_R", "foot_L"),
    ground_geoms=_RODENT_CORE,
    spawn_height=0.0650895726,
    healthy_height=(0.03, 0.5),
    # Speed alone is also earned tail first: trained without this, it turned round in 0.3 s.
    healthy_turn=math.pi / 3,
    reach=0.24,
    longest_gap=0.3,
    sight=1.0,
    timestep=0.004,
    # In float32, 256 environments under random full-range actions lost 149 of 102,400 states with
    # (4, 8), none with (6, 12) (H100, jax 0.11.2); at 2 ms, 29 with (4, 8), none with (8, 16).
    mjx_iterations=(6, 12),
    camera="egocentric",
    eye_distance=0.008,
)

# Of the CMU's recordings, with servos: an action is a pose. In qpos0 it lies, its y-axis up.
HUMANOID = Body(
    name="humanoid",
    build=_humanoid_mjcf,
    torso="root",
    end_effectors=("rradius", "lradius", "rfoot", "lfoot"),
    ground_geoms=(),
    spawn_height=0.94,
    healthy_height=(0.5, 1.5),
    healthy_turn=math.inf,
    reach=1.2,
    longest_gap=1.0,
    sight=4.0,
    timestep=0.005,
    mjx_iterations=(4, 8),
    camera="egocentric",
    eye_distance=0.06,
)
