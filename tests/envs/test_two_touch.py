"""Two-touch against dm_control's own logic, and what the eyes see of its orb."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dm_control.locomotion.props.target_sphere import TargetSphereTwoTouch
from dm_control.locomotion.tasks import reach

from purerl.envs import sight, two_touch
from purerl.envs.touch import distance_to_ellipsoid, touched
from purerl.envs.two_touch import new_orb, outcomes, tapped

DT = 0.021  # no number of steps is 0.2, 0.7, 0.9 or 1.2 s: there rounding would decide


class Theirs:
    """dm_control's task and orb, told at each step whether a hand touches; nothing is simulated."""

    def __init__(self):
        self.now, self.touching, self.hand = 0.0, False, np.zeros(3)
        self.data = SimpleNamespace(contact=[])
        orb = TargetSphereTwoTouch.__new__(TargetSphereTwoTouch)
        orb.__dict__.update(
            _geom="orb", _geom_id=7, _touch_debounce=0.2, _specific_collision_geom_ids={3},
            _material=None, _texture_initial=None, _texture_interval=None, _texture_final=None,
            _touched_once=False, _touched_twice=False,
        )  # fmt: skip
        self.orb, self.task = orb, reach.TwoTouch.__new__(reach.TwoTouch)
        self.task.__dict__.update(
            _aliveness_reward=0.0, _touch_interval=0.8, _interval_tolerance=0.1,
            _failure_timeout=1.2, _reset_delay=0.0, _target_type_rewards=(25.0,),
            _lhand_body="hand", _rhand_body="hand", _targets=[[orb]],
        )  # fmt: skip
        self.renew()

    def renew(self):
        self.orb._touched_once = self.orb._touched_twice = False
        self.task.__dict__.update(
            _state_logic=reach.TwoTouchState.PRE_TOUCH, _first_touch_time=None,
            _second_touch_time=None, _do_time_out=False, _must_randomize_targets=False,
            _target_rewarded_once=[[False]], _target_rewarded_twice=[[False]],
        )  # fmt: skip

    def time(self):
        return self.now

    def bind(self, what):
        return SimpleNamespace(xpos=self.hand if what == "hand" else np.zeros(3), element_id=0)

    def step(self, touching):
        if self.task._must_randomize_targets:
            self.renew()
        self.now += DT
        self.data.contact = [SimpleNamespace(geom1=3, geom2=7)] if touching else []
        self.orb._update_activation(self)
        return self.task.get_reward(self) - 0.25, int(self.task._state_logic)


@pytest.mark.parametrize(
    "share", [0.1, *(pytest.param(x, marks=pytest.mark.slow) for x in (0.02, 0.4))]
)
def test_taps_are_judged_as_in_dm_control(share):
    """3 s each: 4,000 steps of random taps."""
    random, theirs = np.random.default_rng(0), Theirs()
    orb, step, time = new_orb(jax.random.key(0), 1.5), jax.jit(tapped), np.float64(0.0)
    held, outcomes = 0, set()
    for _ in range(4000):
        held = random.integers(1, 8) if held <= 0 and random.random() < share else held - 1
        if orb["over"]:
            orb = new_orb(jax.random.key(1), 1.5)
        time += DT
        orb, earned = step(orb, jnp.asarray(held > 0), jnp.float32(time))
        assert (float(earned), int(orb["logic"])) == pytest.approx(theirs.step(held > 0))
        outcomes.add(int(orb["logic"]))
    late = {two_touch.TOO_LATE} if share < 0.2 else set()
    assert outcomes >= {two_touch.BEFORE, two_touch.ONCE, two_touch.TOO_SOON} | late


def test_a_second_tap_at_the_right_time_is_worth_as_much():
    orb, earned = new_orb(jax.random.key(0), 1.5), []
    counted = {name: set() for name in ("first", "right", "soon", "late")}
    for number in range(1, 120):
        after, reward = tapped(orb, jnp.asarray(number in (5, 43)), jnp.float32(number * DT))
        for name, now in outcomes(orb["logic"], after["logic"]).items():
            counted[name.split("_")[1]] |= {number} if now else set()
        orb = after
        earned.append(float(reward))
    assert earned[4] == earned[42] == 25.0 and sum(earned) == 50.0
    assert counted == {"first": {5}, "right": {43}, "soon": set(), "late": set()}
    assert bool(orb["over"]) and int(orb["logic"]) == two_touch.TWICE


def test_distance_to_an_ellipsoid_is_mujocos():
    """A sphere of the orb's size touches a palm where MuJoCo's own distance is below 0."""
    radii = np.array([0.0065, 0.0037, 0.0022])
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="ellipsoid" size="{" ".join(map(str, radii))}"/>'
        '<body mocap="true"><geom type="sphere" size="0.025"/></body></worldbody></mujoco>'
    )
    data, ours = mujoco.MjData(model), jax.jit(distance_to_ellipsoid)
    for point in 0.02 * np.random.default_rng(0).normal(size=(200, 3)):
        data.mocap_pos[0] = point
        mujoco.mj_forward(model, data)
        right = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + 0.025
        if right > 2e-4:  # where the middle of the sphere is inside, MuJoCo's is another measure
            assert abs(float(ours(jnp.float32(point), radii)) - right) < 1e-4
    assert float(ours(jnp.zeros(3), radii)) == 0.0


@pytest.mark.parametrize("body", ["ant", "rodent"])
def test_what_touches_an_orb_is_what_mujoco_says(body):
    """2 s each: 200 places about the limbs, the body posed at random."""
    made = two_touch.build(two_touch.Options(body=body, eyes=sight.Sight(number=0)), "c")
    model, random = made.parts.looks, np.random.default_rng(1)
    data = mujoco.MjData(model)
    orb = model.geom("target").id

    @jax.jit
    def judge(xpos, xmat, place):
        read = SimpleNamespace(xpos=xpos, xmat=xmat)
        return touched(model, made.palms, read, place[None], made.radius)[0]

    said, near = 0, 0.8 * (made.radius + model.geom_rbound[made.palms[0]])
    for number in range(200):
        if number % 20 == 0:
            data.qpos[7:] = model.qpos0[7:] + random.normal(scale=0.3, size=model.nq - 7)
        mujoco.mj_kinematics(model, data)
        middle = data.geom_xpos[random.choice(made.palms)]
        place = middle + random.uniform(-near, near, 3)
        data.mocap_pos[0] = place
        mujoco.mj_forward(model, data)
        away = min(mujoco.mj_geomDistance(model, data, i, orb, 1.0, None) for i in made.palms)
        if abs(away) > 1e-4:  # nearer, rounding decides
            given = data.xpos, data.xmat.reshape(-1, 3, 3), place
            told = judge(*map(jnp.float32, given))
            assert bool(told) == (away < 0), (number, away)
            said += bool(told)
    assert 20 < said < 180


def test_being_near_earns_its_share_and_a_rodent_on_its_back_ends_the_episode():
    """4 s: two builds, a step and a reset of each, compiled."""
    earned, ended = [], []
    for near, least_up in ((0.01, -2.0), (0.002, -0.3)):
        options = two_touch.Options(eyes=sight.Sight(number=0), near=near, least_up=least_up)
        made = two_touch.build(options, "c")
        state, other = map(jax.jit(made.reset), jax.random.split(jax.random.key(0)))
        turned = other.physics.qpos.at[3:7].set(jnp.array([1e-4, 0.6, 0.8, 0.0]))
        fallen = other.replace(physics=other.physics.replace(qpos=turned))
        step = jax.jit(made.step)
        earned.append(float(state.reward))
        ended.append([bool(step(x, jnp.zeros(38)).terminated) for x in (state, fallen)])
    assert earned[0] == pytest.approx(5.0 * earned[1]) and earned[1] > 0.0
    assert ended == [[False, False], [False, True]]


@pytest.fixture(scope="module")
def env():
    """15 s to build and to compile."""
    made = two_touch.build(two_touch.Options(eyes=sight.Sight(number=1, size=24, reach=6.0)), "c")
    return made, jax.jit(made.reset), jax.jit(made.step)


@pytest.mark.slow
def test_an_orb_before_the_eye_is_seen_and_a_palm_in_it_touches(env):
    made, reset, step = env
    state = reset(jax.random.key(0))
    palm = made.palms[0]
    body = made.parts.looks.geom_bodyid[palm]
    data = mujoco.MjData(made.parts.model)
    data.qpos[:] = state.physics.qpos
    mujoco.mj_forward(made.parts.model, data)
    pictures = {}
    for name, place in {
        "ahead": data.body("walker/skull").xpos + 0.2 * data.body("walker/torso").xmat[[0, 3, 6]],
        "behind": data.body("walker/skull").xpos - 0.5 * data.body("walker/torso").xmat[[0, 3, 6]],
        "in the hand": data.xpos[body],
    }.items():
        orb = state.task["orb"] | {"place": jnp.float32(place)}
        task = state.task | {"orb": orb, "key": jax.random.key(len(pictures))}
        after = step(state.replace(task=task), jnp.zeros(made.action_size))
        pictures[name] = np.asarray(after.observation["eyes"], int)
        assert (float(after.metrics["taps_first_count"]) == 1.0) == (name == "in the hand")
        near = np.exp(-3 * np.abs(data.xpos[list(made.hands)] - place).sum(1).min())
        assert float(after.metrics["reward_near"]) == pytest.approx(0.25 * near, rel=0.2)
    # White, as large as its size at its distance says: some 3% of the picture.
    brighter = (np.abs(pictures["ahead"] - pictures["behind"]) > 20).mean()
    assert 0.01 < brighter < 0.1


@pytest.mark.slow
def test_every_episode_has_an_orb_and_a_direction_of_its_own(env):
    _, reset, _ = env
    states = jax.vmap(reset)(jax.random.split(jax.random.key(1), 16))
    place = np.asarray(states.task["orb"]["place"])
    assert np.abs(place[:, :2]).max() <= 1.5 and place[:, :2].std() > 0.5
    assert (place[:, 2] == np.float32(0.14)).all()
    turn = np.arctan2(states.physics.qpos[:, 6], states.physics.qpos[:, 3])
    assert turn.min() < 0.5 and turn.max() > 2.5
