"""The environments: the contract on every engine, engines against each other, what rewards read."""

import functools
import hashlib
import importlib.util
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl.checks.check_env import check_env
from purerl.envs import arenas, cartpole_swingup, randomization, run
from purerl.envs.bodies import ANT, RODENT
from purerl.experiments.peers import brax_env
from purerl.physics.interface import PhysicsState
from tests import quick

BUILDERS = {"ant": run.build, "cartpole": cartpole_swingup.build}
NUMBER, STEPS = 4, 20
# Of qpos over 20 control steps. Where MJX's few solver iterations do not suffice in one step, the
# simulations part there (with 20 and 50 iterations they do not).
USUAL, WORST = {"ant": 1e-4, "cartpole": 1e-4}, {"ant": 0.02, "cartpole": 1e-4}


@functools.cache
def build(name, engine):
    return BUILDERS[name](engine=engine)


@functools.cache
def rodent():
    return run.build(run.Options(body="rodent"), "c")


@functools.cache
def trajectory(name, engine, height=0.0):
    """Returns the states [T, B] of an open loop from the same starts on every engine.

    `height` [m] lifts qpos[2] of the start.
    """
    env = build(name, engine)
    start = quick.jit(jax.vmap(build(name, "c").reset))(jax.random.split(jax.random.key(3), NUMBER))
    if height:
        qpos = start.physics.qpos.at[:, 2].add(height)
        start = start.replace(physics=start.physics.replace(qpos=qpos))
    shape = (STEPS, NUMBER, env.action_size)
    actions = jax.random.uniform(jax.random.key(4), shape, minval=-1.0, maxval=1.0)

    def step(state, action):
        state = jax.vmap(env.step)(state, action)
        return state, state

    return quick.jit(lambda s, a: jax.lax.scan(step, s, a)[1])(start, actions)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["c", "jax"])
@pytest.mark.parametrize("name", BUILDERS)
@pytest.mark.usefixtures("compiled_quickly")
def test_contract(name, engine):
    check_env(build(name, engine), num_envs=NUMBER)


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_engines_agree(name):
    c, mjx = trajectory(name, "c"), trajectory(name, "jax")
    error = jnp.abs(c.physics.qpos - mjx.physics.qpos).max((0, 2))  # of each simulation
    assert jnp.median(error) < USUAL[name] and error.max() < WORST[name], error
    np.testing.assert_allclose(c.observation[0], mjx.observation[0], atol=1e-3)
    assert float(jnp.abs(c.physics.qpos[-1] - c.physics.qpos[0]).max()) > 0.1  # something moved


@pytest.mark.slow
def test_engines_agree_closely_without_contacts():
    """Joint limits, actuators, damping and gravity of a falling ant."""
    c, mjx = trajectory("ant", "c", 5.0), trajectory("ant", "jax", 5.0)
    np.testing.assert_allclose(c.physics.qpos, mjx.physics.qpos, atol=1e-3)
    np.testing.assert_allclose(c.physics.qpos[0], mjx.physics.qpos[0], atol=2e-5)


def test_the_ants_speed_is_that_of_its_own_centre_of_mass():
    """Against MuJoCo's own momentum over total mass, averaged over the control step."""
    env = build("ant", "c")
    model, data = env.physics.model, mujoco.MjData(env.physics.model)
    states = trajectory("ant", "c")
    data.qpos, data.qvel = states.physics.qpos[4, 0], states.physics.qvel[4, 0]
    data.qacc_warmstart = states.physics.qacc_warmstart[4, 0]
    shape = (STEPS, NUMBER, env.action_size)
    actions = jax.random.uniform(jax.random.key(4), shape, minval=-1.0, maxval=1.0)
    data.ctrl = actions[5, 0]
    speeds = []
    for _ in range(env.physics.substeps):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        speeds.append(data.subtree_linvel[env.parts.torso, 0])
    assert abs(np.mean(speeds)) > 0.05
    np.testing.assert_allclose(
        states.metrics["forward_velocity"][5, 0], np.mean(speeds), rtol=0.02, atol=2e-3
    )


def test_the_torsos_subtree_is_the_ant_and_only_the_ant():
    model = build("ant", "c").physics.model
    torso = build("ant", "c").parts.torso
    assert model.body(torso).name == "walker/torso"
    bodies = [i for i in range(1, model.nbody) if model.body(i).name != "walker/"]
    np.testing.assert_allclose(model.body_subtreemass[torso], model.body_mass[bodies].sum())


@pytest.mark.parametrize(
    ("height", "up", "healthy"), [(0.5, 1.0, True), (0.1, 1.0, False), (0.5, -0.5, False)]
)
def test_an_ant_on_its_back_is_not_healthy(height, up, healthy):
    height, up, turn = jnp.float32(height), jnp.float32(up), jnp.float32(3.0)
    assert bool(run.is_healthy(ANT, run.Options(), height, up, turn)) is healthy


@pytest.mark.parametrize(("limit", "healthy"), [(None, False), (3.2, True), (1.9, False)])
def test_how_far_a_body_may_turn_is_its_own_limit_or_the_options(limit, healthy):
    height, up, turn = jnp.float32(0.06), jnp.float32(1.0), jnp.float32(2.0)
    options = run.Options(healthy_turn=limit)
    assert bool(run.is_healthy(RODENT, options, height, up, turn)) is healthy


def test_an_overturned_ant_ends_its_episode():
    env = build("ant", "c")
    state = env.reset(jax.random.key(0))
    assert not state.terminated
    over = state.physics.qpos.at[3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))
    after = env.step(state.replace(physics=state.physics.replace(qpos=over)), jnp.zeros(8))
    assert after.terminated and after.metrics["reward_healthy"] == 0.0


@pytest.mark.parametrize(("degrees", "over"), [(0, False), (50, False), (-50, False), (90, True)])
def test_a_rodent_that_turns_from_the_way_ahead_ends_its_episode(degrees, over):
    env = rodent()
    state = env.reset(jax.random.key(0))
    half = np.radians(degrees) / 2
    # Nose down by 20 degrees as well: pitch is no turn.
    yaw, pitch = np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), np.radians(10)
    quaternion = np.zeros(4)
    mujoco.mju_mulQuat(quaternion, yaw, np.array([np.cos(pitch), 0.0, np.sin(pitch), 0.0]))
    physics = state.physics.replace(qpos=state.physics.qpos.at[3:7].set(jnp.array(quaternion)))
    after = env.step(state.replace(physics=physics), jnp.zeros(env.action_size))
    assert bool(after.terminated) is over
    assert float(after.metrics["turn"]) == pytest.approx(np.radians(abs(degrees)), abs=0.1)


def test_the_ants_reward_is_the_sum_of_its_terms():
    options = run.Options(
        forward_weight=2.0, distance_weight=3.0, healthy_reward=0.5, control_weight=0.1
    )
    speed, distance = jnp.float32(3.0), jnp.float32(0.25)
    terms = run.reward_terms(options, speed, distance, jnp.bool_(True), jnp.full(8, 0.5))
    expected = 2.0 * 3.0 + 3.0 * 0.25 + 0.5 - 0.1 * 8 * 0.25
    assert float(sum(terms.values())) == pytest.approx(expected)


@pytest.mark.parametrize(("speed", "reward"), [(-1.0, 0.0), (0.5, 0.25), (2.0, 1.0), (3.0, 1.0)])
def test_target_reward_is_linear_up_to_the_target(speed, reward):
    options = run.Options(reward="target", target_speed=2.0)
    terms = run.reward_terms(options, jnp.float32(speed), None, jnp.bool_(True), jnp.zeros(8))
    assert float(sum(terms.values())) == pytest.approx(reward)


GAPS = run.Options(arena="gaps", randomization=randomization.Randomization(friction=(0.5, 1.5)))


def test_every_episode_has_a_corridor_and_a_friction_of_its_own():
    env = run.build(GAPS, "c")
    reset = quick.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
    courses, frictions = (
        np.asarray(reset.task["course"]),
        np.asarray(reset.task["factors"]["friction"]),
    )
    assert len(np.unique(courses[:, 3, 0])) == len(np.unique(frictions)) == 16
    gaps, platforms = courses[:, 1:, 0] - courses[:, :-1, 1], np.diff(courses[:, 1:])
    assert gaps.min() >= 0.05 and gaps.max() <= 0.2
    assert platforms.min() + 1e-5 >= 1.5 and platforms.max() <= 2.0 + 1e-5
    assert frictions.min() >= 0.5 and frictions.max() <= 1.5
    changes = jax.vmap(env.model_changes)(reset)
    own = env.physics.model.geom_friction[:, 0]
    np.testing.assert_allclose(
        changes["geom_friction"][..., 0], frictions[:, None] * own, rtol=1e-6
    )
    np.testing.assert_allclose(
        changes["geom_friction"][0, :, 1:], env.physics.model.geom_friction[:, 1:]
    )


def test_a_crossed_gap_is_counted_once_and_a_fall_is_not_a_crossing():
    env = run.build(run.Options(arena="gaps"), "c")
    state = env.reset(jax.random.key(0))
    beyond = state.task["course"][1, 0] + 0.1

    def move(state, x, z):
        qpos = state.physics.qpos.at[0].set(x).at[2].set(z)
        physics = state.physics.replace(qpos=qpos, qvel=jnp.zeros_like(state.physics.qvel))
        return env.step(state.replace(physics=physics), jnp.zeros(8))

    fallen = move(state, beyond, -0.5)
    assert fallen.terminated and fallen.metrics["gaps_crossed_count"] == 0
    across = move(state, beyond, 0.52)
    assert not across.terminated and across.metrics["gaps_crossed_count"] == 1
    assert move(across, beyond, 0.52).metrics["gaps_crossed_count"] == 0
    ran_all = move(across, 40.0, 0.52)
    assert ran_all.truncated and not ran_all.terminated and not across.truncated
    back = move(across, 5.0, 0.52)
    assert move(back, beyond, 0.52).metrics["gaps_crossed_count"] == 0


def test_a_body_that_may_climb_out_of_a_gap_has_crossed_it_when_it_stands():
    env = run.build(run.Options(arena="gaps", least_height=-0.1), "c")
    state = env.reset(jax.random.key(0))
    beyond = state.task["course"][1, 0] + 0.1

    def at(z):
        physics = state.physics.replace(qpos=state.physics.qpos.at[0].set(beyond).at[2].set(z))
        _, readings = env.physics.init(physics.qpos, physics.qvel)
        return env._state(physics, readings, state.task, beyond, jnp.zeros(8))

    hanging, standing, fallen = at(0.1), at(0.52), at(-0.2)
    assert not hanging.terminated and hanging.metrics["gaps_crossed_count"] == 0
    assert not standing.terminated and standing.metrics["gaps_crossed_count"] == 1
    assert fallen.terminated and fallen.metrics["gaps_crossed_count"] == 0


def test_a_trial_at_one_gap_ends_landed_fallen_or_stopped():
    """Each is 1 in its own episode, summed over its steps; a gap may be too wide to cross."""
    env = run.build(run.Options(arena="single_gap", gap_length=(1.5, 1.5)), "c")
    assert env.parts.arena.boxes == 2
    told = jax.eval_shape(run.build(run.Options(arena="gaps"), "c").reset, jax.random.key(0))
    start, step = env.reset(jax.random.key(0)), quick.jit(env.step)
    assert start.observation.shape == told.observation.shape

    def trial(*places):
        """Puts the torso at (x, z) [m], or leaves it, step by step; returns sums and the end."""
        state, total = start, np.zeros(3)
        for place in places:
            if place:
                qpos = start.physics.qpos.at[jnp.array([0, 2])].set(jnp.array(place))
                rest = jnp.zeros_like(start.physics.qvel)
                state = state.replace(physics=state.physics.replace(qpos=qpos, qvel=rest))
            state = step(state, jnp.zeros(8))
            names = ("landed_count", "fell_count", "stopped_count")
            total += [float(state.metrics[name]) for name in names]
        return total.tolist(), bool(state.truncated), bool(state.terminated), state.metrics

    edge, held = 6.0 + 1.5, [None] * 7  # of 0.025 s each
    *landed, metrics = trial(None, (edge + 1.5, 0.522), *held)
    assert landed == [[1, 0, 0], True, False] and float(metrics["gap_length"]) == 1.5
    assert trial((edge + 1.5, 0.522), *held[1:])[:3] == ([0, 0, 1], False, False)  # too short
    # A foot hangs over the gap; below the ground; back over the gap for a step in between.
    assert trial((edge + 0.1, 0.522), *held)[0][0] == 0
    assert trial((edge + 1.5, -0.6))[:3] == ([0, 1, 0], False, True)
    assert trial(*[(edge + 1.5, 0.522)] * 7, (5.0, 0.522), (edge + 1.5, 0.522))[0] == [0, 0, 1]
    assert trial(None, None)[0] == [0, 0, 1]


@pytest.mark.parametrize(
    "lengths", [{"platform_length": (1.5, 1.5), "gap_length": (0.2, 0.2)}, {"runway": 34.0}]
)
def test_at_the_end_of_a_corridor_the_platform_underfoot_is_still_the_first(lengths):
    env = run.build(run.Options(arena="gaps", **lengths), "c")
    state = env.reset(jax.random.key(0))
    course = state.task["course"]
    start, end = arenas.distances_to_next_edges(course, jnp.float32(39.9), 6, 4.0)[:2]
    course = np.asarray(course)
    under = course[(course[:, 1] >= 39.9).argmax()]
    np.testing.assert_allclose([start, end], np.clip(under - 39.9, -4.0, 4.0), atol=1e-5)
    qpos = state.physics.qpos.at[0].set(39.9)
    env.step(state.replace(physics=state.physics.replace(qpos=qpos)), jnp.zeros(8))


@pytest.mark.parametrize("words", [{"friction": (0.0, 1.0)}, {"gear": (2.0, 1.0)}])
def test_impossible_factors_are_refused(words):
    with pytest.raises(ValueError, match="give factors"):
        randomization.Randomization(**words)


def cartpole_at(angle, spin=0.0, position=0.0):
    env = build("cartpole", "c")
    state = env.reset(jax.random.key(0))
    physics: PhysicsState = state.physics.replace(
        qpos=jnp.float32([position, angle]), qvel=jnp.float32([0.0, spin])
    )
    return env.step(state.replace(physics=physics), jnp.zeros(1))


def test_the_cartpoles_reward_wants_the_pole_up_slow_and_in_the_middle():
    best = cartpole_at(np.pi).reward
    assert 0.98 < best <= 1.0
    assert cartpole_at(0.0).reward < 0.01
    assert cartpole_at(np.pi, spin=5.0).reward < 0.6 * best
    assert cartpole_at(np.pi, position=1.0).reward < 0.8 * best
    assert cartpole_at(2.0).reward > cartpole_at(1.0).reward > cartpole_at(0.5).reward


def test_the_cartpole_can_be_swung_up_by_pumping():
    """Push with the pole's swing while it hangs low: energy alone brings it up within 6 s."""
    env = build("cartpole", "c")

    def step(state, _):
        position, cos, _, speed, spin = state.observation
        push = jnp.clip(10.0 * spin * cos - 2.0 * position - speed, -1.0, 1.0)
        state = env.step(state, push[None])
        return state, state.metrics["upright"]

    _, upright = quick.jit(lambda s: jax.lax.scan(step, s, None, 300))(env.reset(jax.random.key(1)))
    assert float(upright.max()) > 0.9


DIGEST = """
import sys
import jax
from tests.envs.test_envs import digest
print(digest(sys.argv[1]))
"""


def digest(name):
    """Returns a hash of all states of the open loop on the C engine."""
    bits = hashlib.sha256()
    for leaf in jax.tree.leaves(trajectory(name, "c")):
        bits.update(np.asarray(leaf).tobytes())
    return bits.hexdigest()


@pytest.mark.parametrize("name", BUILDERS)
def test_same_seed_same_bits_in_another_process(name):
    other = subprocess.run(
        [sys.executable, "-c", DIGEST, name],
        capture_output=True,
        text=True,
        check=True,
        timeout=200,
    )
    assert other.stdout.split()[-1] == digest(name)


def test_what_an_environment_of_brax_needs_is_told(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match="'ant' is an environment of brax.*peers"):
        brax_env.build(brax_env.Options(name="ant"))
