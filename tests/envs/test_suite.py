"""The control suite against dm_control's own tasks: the same states, observations and rewards."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dm_control import suite
from dm_control.rl import control
from dm_control.suite.utils import randomizers
from dm_control.utils import rewards

from purerl import run
from purerl.checks.check_env import check_env
from purerl.envs.suite import base, cheetah, hopper, tasks
from purerl.envs.suite.rewards import SIGMOIDS, tolerance
from tests import quick

STATES = 100


@pytest.fixture(params=tasks.TASKS)
def pair(request):
    """Our environment on the C engine, and dm_control's."""
    name = request.param.split("-")
    return ours(request.param), suite.load(*name, task_kwargs={"random": 0})


def ours(name, engine="c"):
    """Builds an environment by its name."""
    return tasks.build(tasks.Options(name), engine)


def flat(observation) -> np.ndarray:
    """dm_control's observation as one vector, in its own order."""
    return np.concatenate([np.ravel(v) for v in observation.values()])


def random_states(env, rng):
    """Starts of our own, moved about: qpos, qvel, ctrl and model changes, 100 of each."""
    keys = jax.random.split(jax.random.key(1), STATES)
    start = jax.device_get(quick.jit(jax.vmap(env.domain.start))(keys))
    model = env.physics.model
    for i in range(STATES):
        qpos, qvel = np.float64(start.qpos[i]), rng.normal(size=model.nv)
        qvel *= rng.choice([0.1, 1.0, 10.0])
        changes = {k: np.array(v[i]) for k, v in start.changes.items()}
        if i % 2:
            qpos = towards_success(env, qpos, changes, rng)
        mujoco.mj_integratePos(model, qpos, qvel, 0.003)
        ctrl = rng.uniform(-1, 1, model.nu)
        yield np.float32(qpos), np.float32(qvel), np.float32(ctrl), changes


def towards_success(env, qpos, changes, rng):
    """Makes a state likely to be rewarded, which a random one seldom is; changes `changes`."""
    model, data = env.physics.model, mujoco.MjData(env.physics.model)
    if changes:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        bring_target(env.domain, data, changes, rng)
        return qpos
    if hasattr(env.domain, "free"):  # into the cup: the ball hangs from 20 cm, the cup from 60
        qpos = np.zeros(4)
        qpos[list(env.domain.free)] = [0.0, 0.35] + rng.normal(size=2) * 0.02
        return qpos
    far = 0.015 if hasattr(env.domain, "mass") else 0.15  # the point mass has a target of 15 mm
    return model.qpos0 + far * rng.normal(size=model.nq)


def bring_target(domain, data, changes, rng):
    """Brings the target to the part that should reach it, or nearly so."""
    name, noise = next(iter(changes)), 0.02 * rng.normal(size=3)
    if name == "geom_pos":
        (part,) = (getattr(domain, p) for p in ("finger", "nose", "mouth") if hasattr(domain, p))
        axes = 3 if hasattr(domain, "mouth") else 2
        changes[name][domain.target, :axes] = (data.geom_xpos[part] + noise)[:axes]
    elif name == "site_pos":
        place = data.site("tip").xpos + 2 * noise
        changes[name][domain.target_site, [0, 2]] = place[[0, 2]]
    else:
        place = data.body("ball").xpos + noise
        changes[name][domain.bodies[2], [0, 2]] = place[[0, 2]]


def observer(env):
    """A jitted function from a state to our observation and reward there."""

    def observe(qpos, qvel, ctrl, changes):
        physics, readings = env.physics.init(qpos, qvel, changes)
        return env.state(physics, readings, ctrl, changes)

    return quick.jit(observe)


def put(dm, qpos, qvel, changes):
    """Puts dm_control's physics into a state, with no control."""
    for name, value in changes.items():
        getattr(dm.physics.model, name)[:] = np.float64(value)
    with dm.physics.reset_context():
        dm.physics.data.qpos[:], dm.physics.data.qvel[:] = qpos, qvel


def compare(observe, dm, state):
    """Differences of observation and of reward at one state, and dm_control's reward."""
    qpos, qvel, ctrl, changes = state
    put(dm, qpos, qvel, changes)
    dm.physics.data.ctrl[:] = ctrl
    expected, reward = flat(dm.task.get_observation(dm.physics)), dm.task.get_reward(dm.physics)
    got = observe(*state)
    return np.abs(got.observation - expected).max(), abs(float(got.reward) - reward), float(reward)


@pytest.mark.slow
def test_observation_and_reward_are_dm_controls(pair, request):
    """`pytest -s` prints the table of the largest differences, observation and reward."""
    env, dm = pair
    dm.reset()
    observe, states = observer(env), random_states(env, np.random.default_rng(0))
    rows = np.array([compare(observe, dm, state) for state in states])
    worst = rows[:, :2].max(axis=0)
    print(f"\n{request.node.callspec.id:24s} {worst[0]:.1e} {worst[1]:.1e}")
    assert len(rows) == STATES
    assert np.ptp(rows[:, 2]) > 0.1, "these states do not tell one reward from another"
    assert worst.max() < 1e-5


@pytest.mark.slow
def test_steps_are_dm_controls(pair):
    """From one state through 3 steps: the same time step, controls and substeps."""
    env, dm = pair
    dm.reset()
    assert env.control_timestep == pytest.approx(dm.control_timestep())
    assert env.action_size == dm.action_spec().shape[0]
    np.testing.assert_allclose(dm.action_spec().minimum, -1)
    state = quick.jit(env.reset)(jax.random.key(5))
    put(dm, state.physics.qpos, state.physics.qvel, state.task)
    np.testing.assert_allclose(
        state.observation, flat(dm.task.get_observation(dm.physics)), atol=1e-5
    )
    step, rng = quick.jit(env.step), np.random.default_rng(2)
    for _ in range(3):
        action = rng.uniform(-1, 1, env.action_size)
        state, expected = step(state, jnp.float32(action)), dm.step(np.float32(action))
        np.testing.assert_allclose(state.observation, flat(expected.observation), atol=2e-3)
        np.testing.assert_allclose(state.reward, expected.reward, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cartpole-swingup",
        "pendulum-swingup",
        "reacher-easy",
        "acrobot-swingup",
        "ball_in_cup-catch",
        "fish-swim",
    ],
)
def test_engines_agree(name):
    """The domains that MJX compiles in seconds, over 10 random control steps."""
    c, mjx = ours(name, "c"), ours(name, "jax")
    first, rng = quick.jit(c.reset)(jax.random.key(0)), np.random.default_rng(0)
    actions = jnp.float32(rng.uniform(-1, 1, (10, c.action_size)))
    last = [
        quick.jit(
            lambda s, env=env: jax.lax.scan(lambda s, a: (env.step(s, a), s.reward), s, actions)
        )(first)
        for env in (c, mjx)
    ]
    np.testing.assert_allclose(last[1][0].observation, last[0][0].observation, atol=1e-4)
    np.testing.assert_allclose(last[1][1], last[0][1], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cartpole-swingup_sparse",
        "finger-turn_hard",
        "fish-swim",
        "manipulator-bring_ball",
        "point_mass-easy",
        "swimmer-swimmer15",
    ],
)
def test_starts_are_distributed_as_dm_controls(name):
    """What is observed at 1000 starts of each, number by number: one distribution."""
    state = quick.jit(jax.vmap(ours(name).reset))(jax.random.split(jax.random.key(0), 1000))
    dm = suite.load(*name.split("-"), task_kwargs={"random": 0})
    theirs = np.array([flat(dm.reset().observation) for _ in range(1000)])
    distance = [ks_distance(*pair) for pair in zip(state.observation.T, theirs.T, strict=True)]
    # Two samples of one distribution are so far apart once in a million.
    assert max(distance) < np.sqrt(np.log(2e6) / 1000)


def ks_distance(a, b):
    """Greatest difference between the distributions of two samples (Kolmogorov and Smirnov)."""
    a, b = np.round(np.float64(a), 5), np.round(b, 5)
    at = np.concatenate([a, b])
    below = [np.searchsorted(np.sort(x), at, side="right") / len(x) for x in (a, b)]
    return np.abs(below[0] - below[1]).max()


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_environments_keep_the_protocol(pair):
    check_env(pair[0], num_envs=2, num_steps=3)


def test_episodes_are_1000_steps(pair):
    dm = pair[1]
    assert isinstance(dm, control.Environment)
    assert dm._step_limit == base.EPISODE_STEPS


def test_tolerance_is_dm_controls():
    x = np.linspace(-4, 4, 401)
    for sigmoid in SIGMOIDS:
        for bounds in ((0.0, 0.0), (-0.5, 1.0), (0.5, np.inf)):
            for margin in (0.0, 0.7, 2.0):
                for value in (0.1, 0.5):
                    args = (bounds, margin, sigmoid, value)
                    np.testing.assert_allclose(
                        tolerance(jnp.float32(x), *args),
                        rewards.tolerance(np.float32(x), *args),
                        atol=2e-6,
                    )
    for sigmoid in ("linear", "quadratic"):
        expected = rewards.tolerance(np.float32(x), (0, 1), 1.0, sigmoid, 0)
        np.testing.assert_allclose(
            tolerance(jnp.float32(x), (0, 1), 1.0, sigmoid, 0), expected, atol=2e-6
        )


@pytest.mark.parametrize(
    "kwargs",
    [{"bounds": (1, 0)}, {"margin": -1}, {"sigmoid": "gauss"}, {"value_at_margin": 0}],
)
def test_tolerance_refuses(kwargs):
    with pytest.raises(ValueError):
        tolerance(jnp.zeros(()), **kwargs)


def test_an_unknown_task_is_named():
    with pytest.raises(ValueError, match="'fish_swim'. Did you mean 'fish-swim'.*fish-upright"):
        ours("fish_swim")
    with pytest.raises(ValueError, match="'hopper-walk'. Did you mean 'hopper-stand'.*walker-walk"):
        ours("hopper-walk")
    with pytest.raises(ValueError, match="stand, hop"):
        hopper.build(hopper.Options("walk"))


def test_the_command_names_the_nearest_task(capsys):
    assert run.main(["suite", "--env.task", "fish-swm"]) == 2
    said = capsys.readouterr().err
    assert "did you mean 'fish-swim'? It must be one of 'acrobot-swingup'," in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "name",
    [
        "humanoid-stand",
        "ball_in_cup-catch",
        "finger-spin",
        pytest.param("manipulator-bring_ball", marks=pytest.mark.slow),
    ],
)
def test_starts_touch_nothing(name):
    """In nearly all starts; and the draw sees what MuJoCo sees."""
    env = ours(name)
    model, data = env.physics.model, mujoco.MjData(env.physics.model)
    keys = jax.random.split(jax.random.key(3), 128)
    starts = np.asarray(quick.jit(jax.vmap(env.domain.start))(keys).qpos)
    draw = getattr(env.domain, "_place_ball", lambda k: base.random_joints(model, k))
    poses = np.asarray(quick.jit(jax.vmap(draw))(jax.random.clone(keys)))
    pairs = base.touching_pairs(model)
    gap = quick.jit(lambda p, m: base.least_gap(model, pairs, p, m))
    touching = [_contacts(model, data, q) > 0 for q in starts]
    print(name, "starts that touch:", sum(touching), "of 128")
    assert sum(touching) <= 1
    mixed = 0
    for qpos in poses:
        touches = _contacts(model, data, qpos) > 0
        xmat = data.geom_xmat.reshape(-1, 3, 3)
        assert (float(gap(jnp.float32(data.geom_xpos), jnp.float32(xmat))) < 0) == touches
        mixed += touches
    assert 0 < mixed < 120


def _contacts(model, data, qpos) -> int:
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data.ncon


def test_a_cheetah_falls_by_the_steps_that_it_runs_by():
    """One kernel of 200 steps is too far from XLA's: starts took five sixths of a training."""
    env = ours("cheetah-run", "jax")
    assert env.domain.settling is env.physics and env.physics.substeps == 1
    assert ours("cheetah-run").domain.settling.substeps == cheetah.SETTLING


@pytest.mark.slow
def test_random_joints_have_their_ranges():
    """Against dm_control's own draw, joint by joint: the same least and greatest."""
    for name in ("walker-stand", "humanoid-stand", "hopper-hop"):
        model = ours(name).physics.model
        draw = quick.jit(jax.vmap(lambda k, m=model: base.random_joints(m, k)))
        qpos = np.asarray(draw(jax.random.split(jax.random.key(0), 2000)))
        physics = suite.load(*name.split("-")).physics
        rng, theirs = np.random.RandomState(0), []
        for _ in range(2000):
            randomizers.randomize_limited_and_rotational_joints(physics, rng)
            theirs.append(physics.data.qpos.copy())
        theirs = np.array(theirs)
        for statistic in (np.min, np.max, np.mean, np.std):
            spread = np.ptp(theirs, axis=0) + 1e-3
            difference = np.abs(statistic(qpos, axis=0) - statistic(theirs, axis=0)) / spread
            assert difference.max() < 0.05


def test_a_video_shows_the_target_where_the_episode_has_it():
    env = tasks.build(tasks.Options(task="reacher-hard"), "c")
    state = env.reset(jax.random.key(1))
    target = env.physics.model.geom("target").id
    shown = env.model_changes(state)["geom_pos"][target]
    assert np.abs(shown - env.physics.model.geom_pos[target]).max() > 0.01
    np.testing.assert_allclose(shown[:2], state.task["geom_pos"][target, :2])
