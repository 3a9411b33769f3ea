"""Imitation: frames are whole numbers, ends, starts, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

pytest.importorskip("h5py", reason="pip install -e '.[clips]'")

from purerl import UserError, clips
from purerl.envs import body_parts, imitation, recordings, run
from purerl.envs.tracking import Reward
from tests import quick
from tests.clips import bodies

MOTORS = "".join(f'<motor joint="walker/{n}" ctrlrange="-1 1"/>' for n in bodies.JOINTS)
XML = bodies.XML.replace("</mujoco>", f"<actuator>{MOTORS}</actuator></mujoco>")
LENGTHS = (26, 16)  # frames at 50 Hz


def turned(track: np.ndarray, degrees: float, by) -> np.ndarray:
    """Returns a track [L, nq] that is turned about z, and shifted [m]."""
    half, found = np.deg2rad(degrees) / 2, track.copy()
    axis = np.array([np.cos(half), 0, 0, np.sin(half)])
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, axis)
    found[:, :3] = track[:, :3] @ matrix.reshape(3, 3).T + by
    for row, old in zip(found, track, strict=True):
        mujoco.mju_mulQuat(row[3:7], axis, old[3:7])
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a body, clips of it, and the same clips elsewhere, heading another way."""
    folder = tmp_path_factory.mktemp("imitation")
    (folder / "body.xml").write_text(XML)
    model = mujoco.MjModel.from_xml_string(XML)
    tracks = [np.tile(model.qpos0, (n, 1)) for n in LENGTHS]
    for whole, x in zip(tracks, bodies.tracks(LENGTHS), strict=True):
        whole[:, :9] = x
    # It hangs in the air, so that no contact makes a difference.
    tracks = [track + 2.0 * (np.arange(model.nq) == 2) for track in tracks]
    names = ("Walk_1", "Rear_2")
    files = {"motion": tracks} | {
        f"turned{d}": [turned(x, d, [3.0, -2.0, 0.0]) for x in tracks] for d in (45, 90, 180)
    }
    for name, each in files.items():
        clips.write(folder / f"{name}.h5", clips.pack(model, each, names, 50.0), model)
    return folder


def options(place, **more):
    chosen = {
        "body": str(place / "body.xml"),
        "clips": str(place / "motion.h5"),
        "end_effectors": ("walker/foot",),
        "start_noise": 0.0,
        "reward": Reward(height=(0.0, 9.0)),
        "farthest_joints": 0.5,
    }
    return imitation.Options(**chosen | more)


@pytest.fixture(scope="module")
def env(place):
    return imitation.build(options(place), "c")


@pytest.fixture(scope="module")
def step(env):
    return quick.jit(env.step)


def begin(env, clip, frame):
    """Returns a state in a frame of a clip, as `reset` makes it."""
    fixed = dataclasses.replace(env)
    object.__setattr__(fixed, "draw_start", lambda key: (jnp.int32(clip), jnp.int32(frame)))
    return fixed.reset(jax.random.key(0))


def put(env, state, clip, frame):
    """Returns a state whose body is where a clip has it in a frame."""
    qpos, qvel = env.recording.qpos[clip, frame], env.recording.qvel[clip, frame]
    return state.replace(physics=state.physics.replace(qpos=qpos, qvel=qvel))


# --- observation ---


def test_the_parts_of_an_observation_have_their_sizes(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    # 3 bodies, 2 joints, of 8 degrees of freedom those of the free joint too, and no sensor.
    assert state.observation["reference"].shape == (5 * (3 + 4 + 2 + 3 * 3),)
    assert state.observation["proprioception"].shape == (2 + 2 + 8 + 1 + 3 + 3 + 6 + 2,)


@pytest.mark.parametrize(
    ("body", "set_", "sizes"),
    [("rodent", "motion", (640, 277)), ("humanoid", "squats", (780, 262))],
)
def test_known_bodies_have_the_sizes_that_others_have(tmp_path, body, set_, sizes):
    if body == "rodent":
        model = body_parts.find("rodent", (), "c", 0.002).model
        set_ = str(tmp_path / "motion.h5")
        still = np.tile(model.qpos0, (20, 1))
        clips.write(set_, clips.pack(model, [still], ["Stand_1"], 50.0), model)
    env = imitation.build(imitation.Options(body=body, clips=set_), "c")
    found = jax.eval_shape(env.reset, jax.random.key(0)).observation
    assert (*(found[n].shape[0] for n in ("reference", "proprioception")),) == sizes
    assert env.control_timestep == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [45, 90, 180])
def test_nothing_tells_where_it_is_or_which_way_it_heads(env, place, degrees):
    other = imitation.build(options(place, clips=str(place / f"turned{degrees}.h5")), "c")
    one, same = begin(env, 0, 4), begin(other, 0, 4)
    assert float(jnp.abs(one.physics.qpos[:2] - same.physics.qpos[:2]).max()) > 1.0
    for action in (None, jnp.array([0.3, -0.5])):
        if action is not None:
            one, same = env.step(one, action), other.step(same, action)
        for name, told in one.observation.items():
            np.testing.assert_allclose(told, same.observation[name], atol=1e-4, err_msg=name)
        np.testing.assert_allclose(one.reward, same.reward, atol=1e-4)


# --- frames ---


def test_frames_are_counted_over_a_whole_clip(env, place, step):
    """Control at 100 Hz, clips at 50 Hz: each second frame is the file's own, to the bit."""
    file = np.asarray(clips.fit(clips.read(place / "motion.h5"), env.parts.model, 50.0).qpos)
    held = np.asarray(env.recording.qpos)
    assert env.recording.lengths.tolist() == [51, 31] and env.stride == 2
    assert (held[0, ::2] == file[0]).all() and (held[1, :31:2] == file[1, :16]).all()
    state = begin(env, 0, 0)
    for count in range(1, 41):
        assert not state.truncated
        state = step(put(env, state, 0, count - 1), jnp.zeros(2))
        assert int(state.task["frame"]) == count and state.task["frame"].dtype == jnp.int32
        # What is told: the joints of frames 2, 4, ... 10 from here on.
        told = np.asarray(state.observation["reference"]).reshape(5, -1)[:, 7:9]
        coming = held[0, count + 2 * np.arange(1, 6), 7:9]
        np.testing.assert_allclose(told, coming - np.asarray(state.physics.qpos[7:9]), atol=1e-5)
    # The window now ends with the clip: the motion would go on, so this is no end of the task.
    assert state.truncated and not state.terminated


@pytest.mark.parametrize("rate", [50, 150])
def test_a_frame_of_the_clip_is_one_step_or_three(place, rate):
    env = imitation.build(options(place, control_rate=rate, substeps=4), "c")
    assert env.stride == rate // 50 and env.control_timestep == pytest.approx(1 / rate)
    assert env.recording.lengths.tolist() == [25 * env.stride + 1, 15 * env.stride + 1]
    first, room = env.starts()
    assert first == 0 and room.tolist() == [20 * env.stride, 10 * env.stride]


def test_each_frame_with_a_window_and_a_step_is_a_start_as_often_as_any(env, place):
    first, room = env.starts()
    assert first == 0 and room.tolist() == [40, 20]
    draw = quick.jit(jax.vmap(env.draw_start))
    clip, frame = map(np.asarray, draw(jax.random.split(jax.random.key(1), 6000)))
    counts = [np.bincount(frame[clip == i], minlength=int(room[i])) for i in range(2)]
    assert [len(x) for x in counts] == [40, 20]
    both = np.concatenate(counts)
    assert both.min() > 60 and both.max() < 145  # of 100, which deviates by 10
    few = dataclasses.replace(env, options=options(place, start_frames=(2, 3)))
    clip, frame = map(np.asarray, few.draw_start(jax.random.key(0)))
    assert few.starts()[0] == 4 and few.starts()[1].tolist() == [3, 3]


# --- reward, ends, metrics ---


def test_who_is_where_the_recording_is_has_the_whole_reward(env):
    state = begin(env, 1, 3)
    assert float(state.reward) == pytest.approx(5.0, abs=1e-4)
    for name in ("root_error", "angle_error", "joint_error", "body_error"):
        assert float(state.metrics[name]) < 1e-3, name
    assert not {"reward_joint_velocities", "reward_body_positions"} & state.metrics.keys()


@pytest.mark.parametrize(
    ("change", "over"),
    [
        ({}, False),
        ({0: 0.09}, False),
        ({0: 0.12}, True),
        ({"turn": 110.0}, False),
        ({"turn": 130.0}, True),
        ({7: 0.3, 8: -0.3}, False),
        ({7: 0.4, 8: -0.4}, True),
    ],
)
def test_an_episode_ends_where_it_is_too_far_turned_or_bent(env, step, change, over):
    state = put(env, begin(env, 0, 5), 0, 5)
    qpos = np.array(state.physics.qpos, np.float64)
    for place, by in change.items():
        if place == "turn":
            qpos = turned(qpos[None], by, np.zeros(3))[0]
            qpos[:2] = state.physics.qpos[:2]
        else:
            qpos[place] += by
    after = step(state.replace(physics=state.physics.replace(qpos=jnp.float32(qpos))), jnp.zeros(2))
    assert bool(after.terminated) is over and not after.truncated
    if "turn" in change:
        assert float(after.metrics["angle_error"]) == pytest.approx(change["turn"], abs=3.0)
    assert float(after.metrics["success_count"]) == 1.0 - over


def test_success_and_the_share_that_was_tracked_are_sums_over_an_episode(env, step):
    state, success, share = begin(env, 1, 10), 0.0, 0.0
    for count in range(11, 21):
        state = step(put(env, state, 1, count - 1), jnp.zeros(2))
        success += float(state.metrics["success_count"])
        share += float(state.metrics["tracked_count"])
    assert state.truncated and success == 1.0 and share == pytest.approx(1.0)
    far = state.physics.replace(qpos=state.physics.qpos.at[0].add(1.0))
    failed = step(state.replace(physics=far), jnp.zeros(2))
    assert float(failed.metrics["success_count"]) == -1.0


def test_the_cost_of_a_change_is_of_the_action_before(env, step):
    state = begin(env, 0, 0)
    one = step(state, jnp.array([1.0, 0.0]))
    two = step(one, jnp.array([1.0, 0.5]))
    assert float(one.metrics["reward_change"]) == pytest.approx(-0.02)
    assert float(two.metrics["reward_change"]) == pytest.approx(-0.02 * 0.25)
    assert np.asarray(two.observation["proprioception"][-2:]).tolist() == [1.0, 0.5]


def test_a_start_has_noise_in_its_joints_alone(place):
    noisy = imitation.build(options(place, start_noise=0.1), "c")
    state = noisy.reset(jax.random.key(2))
    exact = noisy.recording.qpos[state.task["clip"], state.task["frame"]]
    away = np.abs(np.asarray(state.physics.qpos - exact))
    assert (away[7:9] > 0).all() and (away[7:9] <= 0.1).all() and not away[:7].any()
    assert (np.asarray(noisy.ghost(state)) == np.asarray(exact)).all()


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_engines_agree_on_a_start(place):
    made = [imitation.build(options(place, start_noise=0.1), engine) for engine in ("c", "jax")]
    one, other = (jax.jit(env.reset)(jax.random.key(5)) for env in made)
    for name, told in one.observation.items():
        np.testing.assert_allclose(told, other.observation[name], atol=1e-5, err_msg=name)
    np.testing.assert_allclose(one.reward, other.reward, atol=1e-5)


# --- sets, and what is refused ---


def test_a_set_is_a_side_a_behaviour_or_a_clip(place):
    names = {s: imitation.build(options(place, clip_set=s), "c").names for s in ("Rear", "Walk_1")}
    assert names == {"Rear": ("Rear_2",), "Walk_1": ("Walk_1",)}
    sides = [
        imitation.build(options(place, clip_set=side, held_out=0.5), "c").names
        for side in ("train", "test")
    ]
    assert sorted(sum(sides, ())) == ["Rear_2", "Walk_1"] and all(sides)


def test_bodies_without_a_name_are_compared_with_their_own_places(place, env):
    unnamed = XML.replace('<body name="walker/torso"', "<body").replace(
        '<body name="walker/leg"', "<body"
    )
    (place / "unnamed.xml").write_text(unnamed)
    found = imitation.build(options(place, body=str(place / "unnamed.xml")), "c").recording
    assert np.array_equal(found.bodies, env.recording.bodies)
    assert np.array_equal(found.torso, env.recording.torso)


BALL = XML.replace('axis="0 1 0" range="-120 10" limited="true"', 'type="ball"')
BALL = BALL.replace('<motor joint="walker/knee" ctrlrange="-1 1"/>', "")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"clips": "waltz"}, "clips is 'waltz': give the path of an HDF5 file, or one of cmu, "),
        ({"clips": "none.h5"}, "none.h5 cannot be read"),
        ({"clips": "cmu"}, "The clips are of another body: none of their joints .root, lfemurrz"),
        ({"clip_set": "Wlak"}, "Did you mean 'Walk'"),
        ({"window": 15}, "1 of 2 clips have fewer than .* 32 frames at 100 Hz: Rear_2 .31"),
        ({"window": 0}, "window is 0, substeps 5; give 1 or more"),
        ({"control_rate": 120}, "control_rate is 120, clip_rate 50: the first must be a whole"),
        ({"start_frames": (5, 2)}, r"start_frames is \(5, 2\); give 0 <= first <= last"),
        ({"start_frames": (14, 20)}, "fewer than the window's 40 frames"),
        ({"body": "cat"}, "body is 'cat': give the path of an MJCF file .*, or ant, humanoid, rod"),
        ({"body": "none.xml"}, "none.xml is no body: "),
        ({"end_effectors": ()}, "Name the bodies of .*body.xml where limbs end: end_effectors"),
        ({"end_effectors": ("walker/fot",)}, "Did you mean 'walker/foot'"),
        ({"body": "BALL"}, "Joint 'walker/knee' is a ball: what is compared are hinges and slides"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(place, wrong, says):
    (place / "ball.xml").write_text(BALL)
    if wrong.get("body") == "BALL":
        wrong = {"body": str(place / "ball.xml")}
    with pytest.raises((UserError, ValueError), match=says) as error:
        imitation.build(options(place, **wrong), "c")
    assert "\n" not in str(error.value)


def test_squats_keep_the_feet_on_the_floor_and_the_weight_above_them():
    model = body_parts.find("humanoid", (), "c", 0.005).model
    held = clips.fit(recordings.read("squats"), model, 10.0)
    data = mujoco.MjData(model)
    for data.qpos[:] in np.asarray(held.qpos[0, ::2]):
        mujoco.mj_fwdPosition(model, data)
        feet = [
            model.geom(f"walker/{side}{name}").id for side in "lr" for name in ("foot", "toes0")
        ]
        floor = model.geom("ground").id
        away = [mujoco.mj_geomDistance(model, data, floor, i, 1.0, None) for i in feet]
        assert abs(min(away)) < 0.01
        behind, ahead = (data.geom_xpos[i, 0] for i in feet[:2])
        assert behind - 0.03 < data.subtree_com[1, 0] < ahead + 0.03


@pytest.mark.slow
def test_a_body_that_runs_feels_what_one_that_imitates_does(tmp_path):
    model = body_parts.find("rodent", (), "c", 0.004).model
    crouched = np.tile(model.qpos0, (20, 1))
    crouched[:, 7:] += np.random.default_rng(0).uniform(-0.2, 0.2, model.nq - 7)
    crouched[:, 3:7] = [np.cos(0.5), 0.0, 0.1, np.sin(0.5)]  # heading elsewhere
    clips.write(tmp_path / "motion.h5", clips.pack(model, [crouched], ["Crouch_1"], 50.0), model)
    chosen = imitation.Options(clips=str(tmp_path / "motion.h5"), control_rate=50)
    imitates = imitation.build(chosen, "c")
    runs, plain = (
        run.build(run.Options(body="rodent", proprioception=felt), "c") for felt in (True, False)
    )
    assert runs.control_timestep == pytest.approx(imitates.control_timestep)
    one, key = begin(imitates, 0, 4), jax.random.key(1)
    action = jnp.float32(np.random.default_rng(1).uniform(-1.0, 1.0, 38))
    step = quick.jit(imitates.step)
    one = step(step(one, action), -action)  # so that all of it moves
    same = quick.jit(runs.reset)(key).replace(physics=one.physics)
    after, also = step(one, action), quick.jit(runs.step)(same, action)
    felt = np.asarray(after.observation["proprioception"])
    assert felt.shape == (277,) and (np.abs(felt) > 1e-6).mean() > 0.9
    np.testing.assert_allclose(also.observation["proprioception"], felt, rtol=1e-6, atol=1e-6)
    bare = quick.jit(plain.step)(
        plain.reset(jax.random.key(1)).replace(physics=one.physics), action
    )
    np.testing.assert_allclose(bare.observation, also.observation["policy"], rtol=1e-5, atol=1e-5)
    assert also.observation.keys() == {"policy", "proprioception"}


def test_a_behaviour_of_one_part_of_the_clips(place):
    held = clips.fit(clips.read(place / "motion.h5"), mujoco.MjModel.from_xml_string(XML), 50.0)
    sides = {}
    for part in ("train", "test"):
        chosen = imitation.Options(clip_set=part, held_out=0.5)
        for name in imitation.choose(chosen, held).names:
            sides[name] = part
    assert set(sides.values()) == {"train", "test"}
    for name, part in sides.items():
        behaviour = name.partition("_")[0]
        one = imitation.Options(clip_set=f"{part}/{behaviour}", held_out=0.5)
        assert imitation.choose(one, held).names == (name,)
        other = {"train": "test", "test": "train"}[part]
        wrong = dataclasses.replace(one, clip_set=f"{other}/{behaviour}")
        with pytest.raises(UserError, match="There is no clip"):
            imitation.choose(wrong, held)
