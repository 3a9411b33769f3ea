"""The joystick task: which commands are drawn and when, and what is near to them."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.checks.check_env import check_env
from purerl.envs import joystick
from tests import quick

HOLD = 0.1  # 5 control steps
# Speed [m/s], size of the rate of turning [rad/s], height of the head [m]: from, to.
RANGES = {
    "run": ((0.4, 0.0, 0.07), (1.2, 0.0, 0.07)),
    "turn": ((0.1, 1.0, 0.07), (0.5, 2.5, 0.07)),
    "rear": ((0.0, 0.0, 0.11), (0.0, 0.0, 0.13)),
    "stop": ((0.0, 0.0, 0.07), (0.0, 0.0, 0.07)),
}


@functools.cache
def build(**chosen):
    return joystick.build(joystick.Options(hold=HOLD, **chosen), "c")


@pytest.fixture(scope="module")
def episode():
    """An episode: states [T, B], their first among them, and the actions [T, B, A] before them."""
    env = build()
    start = quick.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(3), 4))
    shape = (12, 4, env.action_size)
    actions = jax.random.uniform(jax.random.key(4), shape, minval=-1.0, maxval=1.0)

    def step(state, action):
        after = jax.vmap(env.step)(state, action)
        return after, after

    states = quick.jit(lambda s, a: jax.lax.scan(step, s, a)[1])(start, actions)
    both = jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), start, states)
    return both, np.concatenate([np.zeros((1, *shape[1:])), actions])


def turned(axis, angle):
    """Returns the matrix of a rotation about an axis [rad]."""
    quat, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quat, np.array(axis, float), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


# --- commands ---


@pytest.mark.parametrize("kind", [*RANGES, "any"])
def test_a_command_is_within_the_range_of_its_kind(kind):
    draw = quick.jit(jax.vmap(functools.partial(joystick.draw_command, kind=kind)))
    told = np.asarray(draw(jax.random.split(jax.random.key(0), 4000)))
    if kind == "any":
        still, rears = (told[:, :2] == 0).all(1), told[:, 2] > 0.1
        kinds = np.stack([told[:, 0] > 0.5, told[:, 1] != 0, rears, still & ~rears])
        assert (kinds.mean(1) > 0.2).all() and kinds.any(0).mean() > 0.95
        return
    low, high = map(np.float32, RANGES[kind])
    size = np.abs(told)
    assert (size >= low - 1e-6).all() and (size <= high + 1e-6).all()
    # They reach from end to end, and turns are to the left as often as to the right.
    np.testing.assert_allclose(size.min(0), low, atol=0.01)
    np.testing.assert_allclose(size.max(0), high, atol=0.01)
    assert (told[:, [0, 2]] >= 0).all()
    if kind == "turn":
        assert 0.45 < (told[:, 1] > 0).mean() < 0.55


def test_a_command_holds_for_its_time_and_is_of_the_episodes_key(episode):
    states, _ = episode
    told = np.asarray(states.task["command"])
    changes = (told[1:] != told[:-1]).any(-1)  # [T, B]
    assert np.flatnonzero(changes.any(1)).tolist() == [4, 9]  # after 0.1 s and 0.2 s
    assert changes[4].all()
    again = quick.jit(jax.vmap(build().reset))(jax.random.split(jax.random.key(3), 4))
    assert (np.asarray(again.task["command"]) == told[0]).all()
    assert len(np.unique(told[0], axis=0)) == 4


@pytest.mark.parametrize("kind", RANGES)
def test_one_kind_alone_is_told_when_it_is_asked_for(kind):
    env = build(command=kind)
    draw = quick.jit(jax.vmap(lambda key, time: env._command(key, time)))
    keys, times = jax.random.split(jax.random.key(1), 200), jnp.linspace(0.0, 20.0, 200)
    told = np.abs(np.asarray(draw(keys, times)))
    low, high = map(np.float32, RANGES[kind])
    assert (told >= low - 1e-6).all() and (told <= high + 1e-6).all()


def test_a_command_that_holds_for_no_time_is_refused():
    with pytest.raises(ValueError, match=r"hold is 0.0; it must be above 0 \[s\]"):
        joystick.Options(hold=0.0)


# --- reward ---


def test_nearness_is_one_where_a_command_is_met_and_falls_in_lines():
    command = jnp.array([0.5, -1.0, 0.1])

    def near(ahead=0.0, turning=0.0, head=0.0, aside=0.0):
        moved = command + jnp.array([ahead, turning, head])
        return np.asarray(joystick.nearness(moved, jnp.float32(aside), command))

    np.testing.assert_allclose(near(), [1.0, 1.0, 1.0])
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(near(ahead=0.25 * sign), [0.75, 1.0, 1.0], atol=1e-6)
        np.testing.assert_allclose(near(turning=sign), [1.0, 0.75, 1.0], atol=1e-6)
        np.testing.assert_allclose(near(head=0.02 * sign), [1.0, 1.0, 0.6], atol=1e-5)
        # Going sideways is no way to be fast, and costs as much as that much too slow.
        np.testing.assert_allclose(near(aside=0.3 * sign), [0.7, 1.0, 1.0], atol=1e-6)
        np.testing.assert_allclose(near(ahead=0.25, aside=0.3 * sign)[0], 0.45, atol=1e-6)
    np.testing.assert_array_equal(near(9.0, -9.0, 9.0), [0.0, 0.0, 0.0])


@pytest.mark.parametrize("degrees", [0, 90, -45, 180])
@pytest.mark.parametrize("pitch", [0.0, 1.0])
def test_speed_is_along_the_heading_seen_from_above(degrees, pitch):
    yaw = np.deg2rad(degrees)
    axes = turned([0, 0, 1], yaw) @ turned([0, 1, 0], pitch)
    velocity = turned([0, 0, 1], yaw) @ [0.7, -0.2, 5.0]  # ahead, to the right, and up
    ahead, aside = joystick.along_heading(jnp.float32(axes), jnp.float32(velocity))
    np.testing.assert_allclose([ahead, aside], [0.7, -0.2], atol=1e-5)


def test_a_torso_that_points_straight_up_heads_nowhere():
    axes = jnp.float32([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    ahead, aside = joystick.along_heading(axes, jnp.float32([0.7, -0.2, 0.0]))
    assert float(ahead) == float(aside) == 0.0


@pytest.mark.parametrize("pitch", [0.0, 1.2])
def test_turning_is_about_the_worlds_up_however_the_torso_is_pitched(pitch):
    env = build()
    model, quat = env.physics.model, np.zeros(4)
    axes = turned([0, 0, 1], 0.4) @ turned([0, 1, 0], pitch)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    qpos = model.qpos0.copy()
    qpos[2], qpos[3:7] = 0.3, quat
    qvel = np.zeros(model.nv)
    qvel[3:6] = axes.T @ [0.0, 0.0, 1.5]  # MuJoCo has it in the body's frame
    physics, readings = env.physics.init(jnp.float32(qpos), jnp.float32(qvel))
    task = {"commands": jax.random.key(0), "command": jnp.zeros(3)}
    state = env._state(physics, readings, task, jnp.zeros(env.action_size))
    assert float(state.metrics["turning"]) == pytest.approx(1.5, abs=1e-4)
    assert float(state.metrics["near_turning"]) == pytest.approx(1.0 - 1.5 / 4.0, abs=1e-4)


def test_a_command_just_told_is_not_yet_asked_for(episode):
    """A step is rewarded by the command that its action was chosen under."""
    states, actions = episode
    metrics = jax.tree.map(np.asarray, states.metrics)
    told = np.asarray(states.task["command"])
    under = np.concatenate([told[:1], told[:-1]])
    off = np.abs(metrics["turning"] - under[..., 1]) / joystick.WIDTHS[1]
    np.testing.assert_allclose(metrics["near_turning"], np.clip(1 - off, 0, 1), atol=1e-5)
    near = np.stack([metrics[f"near_{name}"] for name in ("speed", "turning", "head")], -1)
    assert (near >= 0).all() and (near <= 1).all()
    earned = near @ joystick.SHARES - 0.01 * np.square(actions).sum(-1)
    np.testing.assert_allclose(states.reward, earned, atol=1e-5)
    assert np.asarray(states.reward).max() <= 1.0
    np.testing.assert_allclose(sum(joystick.SHARES), 1.0)


# --- the environment ---


def test_the_command_is_what_an_observation_ends_with(episode):
    states, actions = episode
    seen = np.asarray(states.observation)
    assert (seen[..., -3:] == np.asarray(states.task["command"])).all()
    np.testing.assert_array_equal(seen[..., -41:-3], np.float32(actions))


def test_resets_of_one_key_have_equal_bits_alone_and_among_others(episode):
    reset = quick.jit(build().reset)
    one, again = (reset(jax.random.split(jax.random.key(3), 4)[2]) for _ in range(2))
    np.testing.assert_array_equal(one.observation, again.observation)
    np.testing.assert_array_equal(one.physics.qvel, again.physics.qvel)
    among = jax.tree.map(lambda x: x[0, 2], episode[0])
    np.testing.assert_allclose(one.observation, among.observation, atol=1e-4)
    np.testing.assert_array_equal(one.physics.qpos, among.physics.qpos)
    assert (one.task["command"] == among.task["command"]).all()


def test_it_starts_standing_as_a_command_to_stop_would_have_it():
    env = build(command="stop")
    states = quick.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
    assert np.asarray(states.reward).min() > 0.9 and not np.asarray(states.terminated).any()


def test_who_is_thrown_up_has_failed():
    env = build()
    step = quick.jit(env.step)
    state = quick.jit(env.reset)(jax.random.key(0))
    for height, over in ((0.06, False), (1.0, True)):
        qpos = state.physics.qpos.at[2].set(height)
        after = step(state.replace(physics=state.physics.replace(qpos=qpos)), jnp.zeros(38))
        assert bool(after.terminated) is over and not after.truncated


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_contract():
    check_env(build(), num_envs=2, num_steps=2)
