"""How near a body is to a recording, against numbers worked out by hand and by SciPy."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from purerl.envs import tracking
from purerl.envs.tracking import Effort, Pose, Reward, Term

RNG = np.random.default_rng(0)


def turn(rotation: Rotation) -> jnp.ndarray:
    return jnp.asarray(rotation.as_quat(scalar_first=True), jnp.float32)


def pose(rotation=None, place=(0.3, -0.2, 0.1), joints=(0.1, -0.4), seed=1) -> Pose:
    rng = np.random.default_rng(seed)
    speeds, bodies = rng.normal(size=2), rng.normal(size=(3, 3))
    quat = turn(rotation or Rotation.identity())
    return Pose(*(jnp.asarray(x, jnp.float32) for x in (place, quat, joints, speeds, bodies)))


def yaw(degrees: float) -> Rotation:
    return Rotation.from_euler("z", degrees, degrees=True)


def moved(one: Pose, rotation: Rotation, by) -> Pose:
    """Returns a pose, seen from a world that is turned and shifted."""
    whole = rotation * Rotation.from_quat(one.turn, scalar_first=True)
    place, bodies = (rotation.apply(x) + by for x in (one.place, one.bodies))
    return Pose(*map(jnp.float32, (place, turn(whole), one.joints, one.speeds, bodies)))


@pytest.mark.parametrize("degrees", [0.0, 5.0, 90.0, 120.0, 179.0, 180.0])
def test_an_angle_is_the_whole_one(degrees):
    base = Rotation.random(rng=RNG)
    axis = RNG.normal(size=3)
    other = base * Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    for sign in (1.0, -1.0):
        found = tracking.angle(turn(base), sign * turn(other))
        np.testing.assert_allclose(found, degrees, atol=0.02)


def test_turns_are_those_of_scipy():
    one, other = Rotation.random(rng=RNG), Rotation.random(rng=RNG)
    both = tracking.product(turn(one), turn(other))
    np.testing.assert_allclose(np.abs(both), np.abs(turn(one * other)), atol=1e-6)
    vector = RNG.normal(size=(4, 3))
    found = tracking.into_frame(turn(one), jnp.float32(vector))
    np.testing.assert_allclose(found, one.inv().apply(vector), atol=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0, 180.0])
def test_what_is_ahead_is_ahead_whichever_way_a_body_heads(degrees):
    """0.1 m ahead is (0.1, 0, 0); turned the wrong way, it would be (0, 0.1, 0) at 45 degrees."""
    now = pose(yaw(degrees))
    ahead = now.place + jnp.float32(yaw(degrees).apply([0.1, 0.0, 0.0]))
    coming = Pose(*(x[None] for x in now._replace(place=ahead)))
    told = np.asarray(tracking.targets(now, coming))
    assert told.shape == (3 + 4 + 2 + 3 * 3,)
    np.testing.assert_allclose(told[:3], [0.1, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(told[3:7], [1.0, 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(told[7:], 0.0, atol=1e-6)


@pytest.mark.parametrize("degrees", [45.0, 90.0, 180.0])
def test_what_is_told_does_not_depend_on_where_or_which_way(degrees):
    now = pose(Rotation.from_euler("xyz", [0.2, -0.3, 0.4]))
    coming = [pose(Rotation.from_euler("xyz", [0.1 * k, 0.2, 0.3]), seed=k) for k in range(4)]
    told, other = (
        tracking.targets(
            see(now), Pose(*(jnp.stack(x) for x in zip(*map(see, coming), strict=True)))
        )
        for see in (lambda x: x, lambda x: moved(x, yaw(degrees), [3.0, -2.0, 0.0]))
    )
    assert told.shape == (4 * 18,)
    np.testing.assert_allclose(told, other, atol=2e-6)
    # Joints are told by how far they are to go.
    np.testing.assert_allclose(told.reshape(4, -1)[:, 7:9], 0.0, atol=1e-6)


def test_a_turn_is_told_by_one_of_its_signs():
    now = pose(yaw(10.0))
    coming = Pose(*(jnp.stack([x, x]) for x in pose(yaw(30.0))))
    coming = coming._replace(turn=coming.turn * jnp.array([[1.0], [-1.0]]))
    one, other = np.asarray(tracking.targets(now, coming)).reshape(2, -1)
    np.testing.assert_allclose(one, other, atol=1e-6)
    np.testing.assert_allclose(one[3:7], turn(yaw(20.0)), atol=1e-6)


EFFORT = Effort(*map(jnp.float32, ([0.5, -1.0], [0.1, 0.0], [0.0, 2.0, -3.0], [9.0, 1.0, 2.0])))


def test_the_terms_of_the_reward_are_those_worked_by_hand():
    now = pose(yaw(0.0), place=(0.0, 0.0, 0.1), joints=(0.3, 0.0))
    reference = now._replace(
        place=jnp.float32([0.03, 0.0, 0.14]),  # 0.05 m
        turn=turn(yaw(40.0)),
        joints=jnp.float32([0.0, 0.4]),  # 0.5 rad
        speeds=now.speeds + jnp.float32([3.0, 4.0]),
        bodies=now.bodies + jnp.float32([[0, 0, 0.3], [0, 0.4, 0], [0, 0, 0]]),
    )
    reward = Reward(
        root_position=Term(2.0, 0.05),
        root_rotation=Term(1.0, 20.0),
        joints=Term(1.0, 1.0),
        joint_velocities=Term(1.0, 5.0),
        body_positions=Term(1.0, 0.5),
        end_effectors=Term(1.0, 0.2),
    )
    apart = tracking.errors(now, reference, np.array([2, 1]))
    found = tracking.reward_terms(reward, apart, now.place[2], EFFORT)
    expected = {
        "root_position": 2.0 * np.exp(-0.5),
        "root_rotation": np.exp(-2.0),
        "joints": np.exp(-0.125),
        "joint_velocities": np.exp(-0.5),
        "body_positions": np.exp(-0.5),
        "end_effectors": np.exp(-2.0),
        "height": 1.0,
        "control": -0.02 * 1.25,
        "change": -0.02 * (0.16 + 1.0),
        "energy": -0.01 * 8.0,
    }
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-4, err_msg=name)
    said = tracking.readable(now, reference)
    told = {"root_error": 50.0, "angle_error": 40.0, "joint_error": np.rad2deg(0.35)}
    for name, value in (told | {"body_error": 700 / 3}).items():
        np.testing.assert_allclose(said[name], value, rtol=1e-4, err_msg=name)


def test_no_error_earns_the_whole_and_what_has_no_weight_is_not_there():
    now, nothing = pose(), jnp.zeros(2)
    apart = tracking.errors(now, now, np.array([0]))
    effort = Effort(nothing, nothing, nothing, nothing)
    found = tracking.reward_terms(Reward(), apart, jnp.float32(0.1), effort)
    whole = ("root_position", "root_rotation", "joints", "end_effectors", "height")
    assert {name for name, x in found.items() if x == 1.0} == set(whole)
    assert found.keys() == {*whole, "control", "change", "energy"}
    lying = tracking.reward_terms(Reward(), apart, jnp.float32(0.03), effort)
    assert lying["height"] == 0.0
    wild = effort._replace(qvel=jnp.full(2, 1e3), forces=jnp.full(2, 1e3))
    assert tracking.reward_terms(Reward(), apart, jnp.float32(0.1), wild)["energy"] == -0.5
    with pytest.raises(ValueError, match="scale is 0.0; give an error above 0"):
        Term(1.0, 0.0)
