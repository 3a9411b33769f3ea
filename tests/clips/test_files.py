"""Both layouts are read by their keys; what is wrong with a file is one line."""

import mujoco
import numpy as np
import pytest

pytest.importorskip("h5py", reason="pip install -e '.[clips]'")

from purerl import UserError, clips
from tests.clips import bodies


@pytest.fixture(scope="module")
def model():
    return bodies.model()


@pytest.mark.parametrize("layout", ["flat", "named"])
def test_a_layout_is_read_as_what_was_written(tmp_path, model, layout):
    arrays = {"flat": bodies.flat_arrays, "named": bodies.named_arrays}[layout](2)
    bodies.write(tmp_path / "a.h5", arrays)
    motion = clips.read(tmp_path / "a.h5", rate=50.0)
    names = {"flat": ("Walk_12.p", "Rear_3.p"), "named": ("clip_0000", "clip_0001")}
    assert motion.names == names[layout] and motion.lengths.tolist() == [16, 16]
    assert motion.columns == ("root",) * 7 + bodies.JOINTS
    assert motion.bodies == ("world", "torso", "leg", "foot")
    fitted = clips.fit(motion, model, 50.0)
    assert fitted.qpos.shape == (2, 16, 16) and fitted.qvel.shape == (2, 16, 14)
    np.testing.assert_allclose(fitted.qpos[..., :9], bodies.tracks((16, 16)), atol=1e-6)
    assert (np.asarray(fitted.qpos[..., 9:]) == model.qpos0[9:].astype(np.float32)).all()


def test_clips_of_different_lengths_come_back_with_all_their_bits(tmp_path, model):
    tracks = [np.tile(model.qpos0, (len(x), 1)) for x in bodies.tracks()]
    for whole, x in zip(tracks, bodies.tracks(), strict=True):
        whole[:, :9] = x
        turns = np.random.default_rng(0).normal(size=(len(x), 4)).astype(np.float32)
        whole[:, 3:7] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    packed = clips.pack(model, tracks, ("Walk_1", "Rear_2", "Walk_3"), bodies.RATE)
    clips.write(tmp_path / "a.h5", packed, model)
    motion = clips.read(tmp_path / "a.h5")
    back = clips.fit(motion, model, bodies.RATE)
    assert back.names == packed.names and back.rate == packed.rate
    for one, other in zip(packed[:3], back[:3], strict=True):
        assert one.dtype == other.dtype
    assert np.asarray(back.lengths).tolist() == [26, 11, 16]
    assert (np.asarray(back.qpos) == np.asarray(packed.qpos)).all()
    np.testing.assert_allclose(back.qvel, packed.qvel, atol=1e-4)
    # What is padded stays where it is.
    assert (np.asarray(back.qpos[1, 11:]) == np.asarray(back.qpos[1, 10])).all()
    assert not np.asarray(back.qvel[1, 11:]).any() and np.asarray(back.qvel[1, 10]).any()


def test_what_is_written_has_the_keys_of_the_layout_and_where_the_body_is(tmp_path, model):
    import h5py

    bodies.write(tmp_path / "a.h5", bodies.named_arrays(1))
    fitted = clips.fit(clips.read(tmp_path / "a.h5", rate=50.0), model, 50.0)
    clips.write(tmp_path / "b.h5", fitted, model)
    clips.write(str(tmp_path / "c.h5"), fitted, model)
    assert (tmp_path / "b.h5").read_bytes() == (tmp_path / "c.h5").read_bytes()
    names, xpos = bodies.places(np.stack(bodies.tracks((16,))))
    with h5py.File(tmp_path / "b.h5") as file:
        group = file["all_clips"]
        shapes = {name: x.shape[2:] for name, x in group.items()}
        np.testing.assert_allclose(group["body_positions"], xpos[..., 1:, :], atol=1e-6)
        turning = group["angular_velocity"][0, 3]
        assert [x.decode() for x in file["metadata/body_names"]] == names[1:]
    assert shapes == {
        "position": (3,), "velocity": (3,), "quaternion": (4,), "angular_velocity": (3,),
        "joints": (2,), "joints_velocity": (2,), "body_positions": (3, 3),
        "body_quaternions": (3, 4),
    }  # fmt: skip
    np.testing.assert_allclose(turning, [0, 0, 1], atol=1e-4)


def wrong_named(**changes) -> dict:
    arrays = bodies.named_arrays(2)
    for name, change in changes.items():
        key = next(k for k in (f"all_clips/{name}", f"metadata/{name}") if k in arrays)
        arrays[key] = change(arrays[key].copy())
    return arrays


def with_nan(x):
    x[1, 4, 1] = np.nan
    return x


REFUSED = {
    "lacks a key": (
        {k: v for k, v in bodies.named_arrays(1).items() if k != "metadata/joint_names"},
        "lacks metadata/joint_names; there are: all_clips, all_clips/body_positions, ",
    ),
    "neither layout": ({"pose": np.zeros(3)}, "lacks qpos; there are: pose."),
    "not a number": (
        wrong_named(joints=with_nan), "clip 'clip_0001': 'knee' is nan at frame 4."
    ),
    "another shape": (
        wrong_named(quaternion=lambda x: x[:, :-1]),
        "quaternion is of shape [2, 15, 4]; it must have 3 dimensions, the first [2, 16].",
    ),
    "a name too few": (
        wrong_named(joint_names=lambda x: x[:1]),
        "metadata/joint_names is of shape [1]; it must have 1 dimensions, the first [2].",
    ),
    "two of a name": (
        wrong_named() | {"metadata/clip_names": bodies.texts(["a", "a"])},
        "has clips of one name, or none: a, a.",
    ),
    "lengths of something else": (
        wrong_named() | {"metadata/clip_lengths": np.array([16, 17])},
        "clip 'clip_0001' has 17 frames; it must be 1 to 16.",
    ),
    "no length": (
        bodies.flat_arrays(config=False), "does not say how long its clips are: give it, as "
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_wrong_file_is_one_line(tmp_path, case):
    arrays, says = REFUSED[case]
    bodies.write(tmp_path / "a.h5", arrays)
    with pytest.raises(UserError) as error:
        clips.read(tmp_path / "a.h5", rate=50.0)
    assert says in str(error.value) and "\n" not in str(error.value)


def test_frames_that_are_no_whole_clips_are_refused(tmp_path):
    bodies.write(tmp_path / "a.h5", bodies.flat_arrays(2))
    with pytest.raises(UserError, match="has 32 frames and the names of 2 clips: no clips of 10 "):
        clips.read(tmp_path / "a.h5", rate=50.0, frames=10)
    bodies.write(tmp_path / "b.h5", bodies.flat_arrays(2, config=False))
    assert len(clips.read(tmp_path / "b.h5", rate=50.0, frames=8).names) == 4


def test_a_file_that_is_cut_short_or_no_hdf5_or_not_there(tmp_path):
    bodies.write(tmp_path / "a.h5", bodies.named_arrays())
    whole = (tmp_path / "a.h5").read_bytes()
    for share in (0.3, 0.9, 0.999):
        (tmp_path / "cut.h5").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(UserError, match="cut.h5 is cut short or broken: .*truncated"):
            clips.read(tmp_path / "cut.h5", rate=50.0)
    (tmp_path / "text.h5").write_text("time,angle\n0,1\n")
    with pytest.raises(UserError, match="text.h5 is no HDF5 file: it begins with b'time,ang'"):
        clips.read(tmp_path / "text.h5")
    with pytest.raises(UserError, match="none.h5 cannot be read: No such file"):
        clips.read(tmp_path / "none.h5")


def test_the_rate_is_the_files_or_given_and_never_both(tmp_path, model):
    bodies.write(tmp_path / "a.h5", bodies.named_arrays())
    with pytest.raises(UserError, match="rate is 0.02; give frames a second"):
        clips.read(tmp_path / "a.h5", rate=0.02)
    with pytest.raises(UserError, match="does not say its rate"):
        clips.read(tmp_path / "a.h5")
    fitted = clips.fit(clips.read(tmp_path / "a.h5", rate=50.0), model, 50.0)
    clips.write(tmp_path / "b.h5", fitted, model)
    assert clips.read(tmp_path / "b.h5", rate=50.0).rate == 50.0
    with pytest.raises(UserError, match="is of 50 Hz, not 100: leave the rate out"):
        clips.read(tmp_path / "b.h5", rate=100.0)


def test_a_ball_joint_has_no_place_in_the_layout(tmp_path):
    body = '<body name="a"><joint name="neck" type="ball"/><geom size="0.1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    packed = clips.pack(model, [np.tile(model.qpos0, (3, 1))], ("nod",), 50.0)
    with pytest.raises(UserError, match="no ball joints: neck"):
        clips.write(tmp_path / "a.h5", packed, model)
