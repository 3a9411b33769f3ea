"""The environments: the contract on every engine, engines against each other, what rewards read."""

import functools
import hashlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs import ant_run, cartpole_swingup
from purerl.env import check_env
from purerl.physics import PhysicsState

BUILDERS = {"ant": ant_run.build, "cartpole": cartpole_swingup.build}
NUMBER, STEPS = 4, 20
# Of qpos, after 20 control steps. The ant lands on four feet, MJX stops Newton after 4 iterations
# where C converges, and float32 contacts open and close at other times.
TOLERANCE = {"ant": 0.05, "cartpole": 1e-4}


@functools.cache
def build(name, engine):
    return BUILDERS[name](engine=engine)


@functools.cache
def trajectory(name, engine):
    """Returns the states [T, B] of an open loop from the same starts on every engine."""
    env = build(name, engine)
    start = jax.jit(jax.vmap(build(name, "c").reset))(jax.random.split(jax.random.key(3), NUMBER))
    shape = (STEPS, NUMBER, env.action_size)
    actions = jax.random.uniform(jax.random.key(4), shape, minval=-1.0, maxval=1.0)

    def step(state, action):
        state = jax.vmap(env.step)(state, action)
        return state, state

    return jax.jit(lambda s, a: jax.lax.scan(step, s, a)[1])(start, actions)


@pytest.mark.parametrize("engine", ["c", "jax"])
@pytest.mark.parametrize("name", BUILDERS)
def test_contract(name, engine):
    check_env(build(name, engine), num_envs=NUMBER)


@pytest.mark.parametrize("name", BUILDERS)
def test_engines_agree(name):
    c, mjx = trajectory(name, "c"), trajectory(name, "jax")
    np.testing.assert_allclose(c.physics.qpos, mjx.physics.qpos, atol=TOLERANCE[name])
    np.testing.assert_allclose(c.observation[0], mjx.observation[0], atol=0.05)
    assert float(jnp.abs(c.physics.qpos[-1] - c.physics.qpos[0]).max()) > 0.1  # something moved


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
        speeds.append(data.subtree_linvel[env.torso, 0])
    assert abs(np.mean(speeds)) > 0.05
    np.testing.assert_allclose(
        states.metrics["forward_velocity"][5, 0], np.mean(speeds), rtol=0.02, atol=2e-3
    )


def test_the_torsos_subtree_is_the_ant_and_only_the_ant():
    model = build("ant", "c").physics.model
    torso = build("ant", "c").torso
    assert model.body(torso).name == "walker/torso"
    bodies = [i for i in range(1, model.nbody) if model.body(i).name != "walker/"]
    np.testing.assert_allclose(model.body_subtreemass[torso], model.body_mass[bodies].sum())


@pytest.mark.parametrize(
    ("height", "up", "healthy"), [(0.5, 1.0, True), (0.1, 1.0, False), (0.5, -0.5, False)]
)
def test_an_ant_on_its_back_is_not_healthy(height, up, healthy):
    options = ant_run.Options()
    assert bool(ant_run.is_healthy(jnp.float32(height), jnp.float32(up), options)) is healthy


def test_an_overturned_ant_ends_its_episode():
    env = build("ant", "c")
    state = env.reset(jax.random.key(0))
    assert not state.terminated
    over = state.physics.qpos.at[3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))
    after = env.step(state.replace(physics=state.physics.replace(qpos=over)), jnp.zeros(8))
    assert after.terminated and after.metrics["healthy"] == 0.0


def test_the_ants_reward_is_the_sum_of_its_terms():
    options = ant_run.Options(forward_weight=2.0, healthy_reward=0.5, control_weight=0.1)
    terms = ant_run.reward_terms(jnp.float32(3.0), jnp.bool_(True), jnp.full(8, 0.5), options)
    assert float(sum(terms.values())) == pytest.approx(2.0 * 3.0 + 0.5 - 0.1 * 8 * 0.25)


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

    _, upright = jax.jit(lambda s: jax.lax.scan(step, s, None, 300))(env.reset(jax.random.key(1)))
    assert float(upright.max()) > 0.9


DIGEST = """
import sys
import jax
from tests.test_envs import digest
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
