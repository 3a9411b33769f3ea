"""Motion becomes a body's: joints by name, another rate, velocities; the oddities are found."""

import mujoco
import numpy as np
import pytest

from purerl import UserError, clips
from purerl.clips import body, examine
from tests.clips import bodies


@pytest.fixture(scope="module")
def model():
    return bodies.model()


def motion(values=None, columns=("root",) * 7 + bodies.JOINTS, rate=bodies.RATE, **more):
    values = np.stack(bodies.tracks((16, 16))) if values is None else values
    number, length, _ = values.shape
    names = tuple(f"Walk_{i}" for i in range(number))
    given = {"bodies": (), "positions": np.zeros((number, length, 0, 3))} | more
    return clips.Motion(columns, values, np.full(number, length), names, rate, **given)


def changed(frame, column, by):
    values = np.stack(bodies.tracks((16, 16)))
    values[1, frame, column] += by
    return values


# --- joints by name ---


def test_columns_find_their_joints_whatever_their_order(model):
    values = np.stack(bodies.tracks((16,)))
    swapped = values[..., [8, *range(7), 7]]
    columns = ("walker/knee", *("free",) * 7, "hip")
    one = clips.fit(motion(values), model, 50.0)
    other = clips.fit(motion(swapped, columns), model, 50.0)
    assert (np.asarray(one.qpos) == np.asarray(other.qpos)).all()


def test_joints_that_only_one_has_are_named(model):
    root, values = ("root",) * 7, np.stack(bodies.tracks((16,)))
    with pytest.raises(UserError, match="lack joints of the body: knee; they have .* tail. Name"):
        clips.fit(motion(values, (*root, "hip", "tail")), model, 50.0)
    fitted = clips.fit(motion(values, (*root, "hip", "tail")), model, 50.0, ("knee", "tail"))
    assert not np.asarray(fitted.qpos[..., 8]).any() and np.asarray(fitted.qpos[..., 7]).any()
    with pytest.raises(UserError, match="lack joints of the body: root"):
        clips.fit(motion(values[..., 7:], bodies.JOINTS), model, 50.0)
    with pytest.raises(UserError, match="have other columns for: knee"):
        clips.fit(motion(values, (*root, "knee", "knee")), model, 50.0, ("hip",))


def test_clips_of_another_body_are_refused(model):
    other = motion(columns=("root",) * 7 + ("femur", "tibia"))
    says = "another body: none of their joints .root, femur, tibia. .* this one's .root, hip, knee"
    with pytest.raises(UserError, match=says):
        clips.fit(other, model, 50.0)


def test_a_body_that_stands_fast_needs_no_root():
    joint = '<body><joint name="elbow"/><geom size="0.1" pos="0 0 1"/></body>'
    arm = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{joint}</worldbody></mujoco>")
    angles = np.linspace(0, 1, 5)[None, :, None]
    fitted = clips.fit(motion(angles, ("elbow",)), arm, 50.0)
    np.testing.assert_allclose(fitted.qvel[0, :, 0], 0.25 * 50.0, rtol=1e-5)


# --- rates and velocities ---


def test_between_frames_positions_are_on_a_line_and_turns_on_the_arc(model):
    """A quarter turn about z; the halves are eighths, and one quaternion has the other sign."""
    half = np.sqrt(0.5)
    qpos = np.tile(model.qpos0, (3, 1))
    qpos[:, 3:7] = [[1, 0, 0, 0], [-half, 0, 0, -half], [0, 0, 0, 1]]
    qpos[:, 0], qpos[:, 7] = [0, 1, 4], [0, -0.2, 0.2]
    found = body.resample(model, qpos, 50.0, 100.0)
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 1, 2.5, 4], atol=1e-12)
    np.testing.assert_allclose(found[:, 7], [0, -0.1, -0.2, 0, 0.2], atol=1e-12)
    angles = np.deg2rad([0, 45, 90, 135, 180]) / 2
    np.testing.assert_allclose(np.abs(found[:, 3]), np.cos(angles), atol=1e-12)
    np.testing.assert_allclose(np.abs(found[:, 6]), np.sin(angles), atol=1e-12)
    assert (body.resample(model, qpos, 50.0, 50.0) == qpos).all()
    assert (body.resample(model, qpos, 50.0, 25.0) == qpos[::2]).all()


@pytest.mark.parametrize(("old", "new", "frames"), [(50, 100, 499), (50, 60, 299), (330, 100, 76)])
def test_another_rate_lasts_as_long_and_no_longer(model, old, new, frames):
    qpos = np.tile(model.qpos0, (250, 1))
    qpos[:, 0] = np.arange(250) / old  # [s]
    found = body.resample(model, qpos, old, new)
    assert len(found) == frames
    np.testing.assert_allclose(found[:, 0], np.arange(frames) / new, atol=1e-9)


def test_velocities_are_those_from_a_frame_to_the_next_in_the_bodys_own_frame(model):
    """Yawed by 90 degrees, it rolls about its own x at 2 rad/s: about the world's y."""
    t = np.arange(6) / 50.0
    qpos, roll, yawed = np.tile(model.qpos0, (6, 1)), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(yawed, np.array([0.0, 0, 1]), np.pi / 2)
    for row, second in zip(qpos, t, strict=True):
        mujoco.mju_axisAngle2Quat(roll, np.array([1.0, 0, 0]), 2 * second)
        mujoco.mju_mulQuat(row[3:7], yawed, roll)
    qpos[:, 1], qpos[:, 8] = 0.3 * t, -0.5 * t
    qvel = body.velocities(model, qpos, 50.0)
    assert qvel.shape == (6, model.nv)
    np.testing.assert_allclose(qvel[:, :3], [[0, 0.3, 0]] * 6, atol=1e-9)
    np.testing.assert_allclose(qvel[:, 3:6], [[2, 0, 0]] * 6, atol=1e-9)
    np.testing.assert_allclose(qvel[:, 7], -0.5, atol=1e-9)
    # And they lead there.
    there = qpos[0].copy()
    mujoco.mj_integratePos(model, there, qvel[0], 1 / 50)
    np.testing.assert_allclose(there, qpos[1], atol=1e-12)


def test_a_clip_of_one_frame_stands_still(model):
    fitted = clips.fit(motion(np.stack(bodies.tracks((1,)))), model, 100.0)
    assert fitted.qpos.shape == (1, 1, 16) and not np.asarray(fitted.qvel).any()


def test_quaternions_that_are_none_are_refused_and_others_are_normalized(model):
    with pytest.raises(UserError, match="'Walk_1', frame 3: a quaternion is not of norm 1"):
        clips.fit(motion(changed(3, 3, 0.5)), model, 50.0)
    fitted = clips.fit(motion(changed(3, 3, 0.005)), model, 50.0)
    assert abs(np.linalg.norm(fitted.qpos[1, 3, 3:7]) - 1) < 1e-6


# --- what no body does, and what is odd ---


def test_millimetres_are_refused(model):
    values = np.stack(bodies.tracks((16, 16)))
    values[..., :3] *= 1000
    with pytest.raises(UserError, match="'Walk_0' is 300 m high or moves at 400 m/s, .* millimetr"):
        clips.fit(motion(values), model, 50.0)
    still = values[:, :1].repeat(16, axis=1)
    with pytest.raises(UserError, match="300 m high or moves at 0 m/s"):
        clips.fit(motion(still), model, 50.0)
    with pytest.raises(UserError, match="moves at 5,000 m/s"):
        clips.fit(motion(changed(3, 0, 100.0)), model, 50.0)


def test_degrees_are_refused_and_a_frame_that_jumps_is_not(model):
    values = np.stack(bodies.tracks((16, 16)))
    values[..., 7:] = np.rad2deg(values[..., 7:])
    with pytest.raises(UserError, match=r"'Walk_0' has hip 1,\d\d\d deg beyond .* Give radians\.$"):
        clips.fit(motion(values), model, 50.0)
    clips.fit(motion(changed(3, 7, 20.0)), model, 50.0)


def test_quaternions_with_w_last_are_refused_where_the_file_has_positions(model):
    values = np.stack(bodies.tracks((16, 16)))
    names, places = bodies.places(values)
    values[..., 3:7] = np.roll(values[..., 3:7], -1, axis=-1)
    told = motion(values, bodies=tuple(names), positions=places)
    with pytest.raises(
        UserError, match=r"'Walk_0' is \d+.\d mm .*, and 0.0 if w is last in .* first\.$"
    ):
        clips.fit(told, model, 50.0)
    apart = motion(bodies=tuple(names), positions=places + 0.1)  # for another reason
    clips.fit(apart, model, 50.0)
    clips.fit(motion(values), model, 50.0)


@pytest.mark.parametrize("rate", [0.02, 0.0, -50.0, np.nan, np.inf])
def test_seconds_are_no_rate(model, rate):
    with pytest.raises(
        UserError, match="rate is .*; give frames a second, 2 Hz or more: 0.02 s are 50"
    ):
        clips.fit(motion(), model, rate)
    with pytest.raises(UserError, match="give frames a second"):
        clips.pack(model, [np.zeros((5, model.nq))], ["a"], rate)


def test_a_body_of_one_part_has_a_size():
    ball = '<body><freejoint/><geom size="0.1"/></body>'
    drone = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    values = np.tile(drone.qpos0, (1, 9, 1))
    values[0, :, 2] = 0.2 * np.arange(9)  # 10 m/s
    columns = ("root",) * 7
    assert clips.fit(motion(values, columns), drone, 50.0).qpos.shape == (1, 9, 7)
    with pytest.raises(UserError, match="its body 0.2 m long: are these millimetres"):
        clips.fit(motion(values * [1, 1, 1e3, 1, 1, 1, 1], columns), drone, 50.0)


def test_each_oddity_is_measured_and_placed(model):
    names, places = bodies.places(np.stack(bodies.tracks((16, 16))))
    places[1, 5, 3, 0] += 0.004  # of the foot
    values = changed(7, 8, 0.9)  # knee: -0.2 there, so 0.7 rad, and its range ends at 10 deg
    values[1, 9, 2] = 0.2
    given = motion(values, bodies=tuple(names), positions=places)
    first, second = examine.examine(given, model)
    assert first.startswith("Walk_0: Walk, 0.30 s, 16 frames at 50 Hz; 0.40 m/s (root, frame ")
    assert "; 0.00 mm below the floor; 0.00 deg beyond the range; 0.00 mm from" in first
    knee = np.rad2deg(values[1, 7, 8]) - 10
    assert f"{knee:.2f} deg beyond the range (knee, frame 7)" in second
    foot = places[1, 9] * 0
    data = mujoco.MjData(model)
    data.qpos[:9] = values[1, 9]
    mujoco.mj_kinematics(model, data)
    foot = data.geom("walker/toe").xpos[2] - 0.02
    assert foot < 0 and f"{-1e3 * foot:.2f} mm below the floor (toe, frame 9)" in second
    assert "mm from the file's positions (" in second
    low = motion(np.stack(bodies.tracks((16, 16))), bodies=tuple(names), positions=places)
    assert (
        "4.00 mm from the file's positions (foot, frame 5)" in list(examine.examine(low, model))[1]
    )


def test_what_cannot_be_compared_is_left_out():
    bare = bodies.XML.replace('<geom name="floor" type="plane" size="5 5 1"/>', "")
    _, line = examine.examine(motion(), mujoco.MjModel.from_xml_string(bare))
    assert "floor" not in line and "positions" not in line and "; 0.00 deg beyond" in line


@pytest.mark.parametrize(
    ("shapes", "names", "says"),
    [
        ([2, 2], ["a"], "2 tracks have 1 names, 1 of them different"),
        ([2, 2], ["a", "a"], "2 tracks have 2 names, 1 of them different"),
        ([2, 1], ["a", "b"], r"A track is of shape \(5, 1\); it must be \[L, 2\]"),
    ],
)
def test_tracks_have_names_and_the_bodys_columns(shapes, names, says):
    joints = "".join(f"<joint name='j{i}'/>" for i in range(2))
    body_of_two = f"<body>{joints}<geom size='.1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body_of_two}</worldbody></mujoco>")
    tracks = [np.zeros((5, n)) for n in shapes]
    with pytest.raises(UserError, match=says):
        clips.pack(model, tracks, names, 50.0)
