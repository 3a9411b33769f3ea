"""Other trainers beside ours: the same thing is simulated, and the same sizes are learned."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra peers")

import gymnasium  # noqa: E402

from purerl.checks.check_env import check_env  # noqa: E402
from purerl.core.errors import UserError  # noqa: E402
from purerl.envs import gymnasium_ant  # noqa: E402
from tests import quick  # noqa: E402

pytestmark = pytest.mark.slow

STEPS = 200


def starting_at(state, data):
    """Returns our state with the simulation of Gymnasium's `data`."""
    fields = {name: jnp.asarray(getattr(data, name), jnp.float32) for name in ("qpos", "qvel")}
    warm = jnp.asarray(data.qacc_warmstart, jnp.float32)
    return state.replace(physics=state.physics.replace(qacc_warmstart=warm, **fields))


@pytest.fixture(scope="module")
def steps():
    """Single steps from states on Gymnasium's way: (its observation, reward, terminated), ours."""
    theirs, env = gymnasium.make("Ant-v5").unwrapped, gymnasium_ant.build(engine="c")
    step, state = quick.jit(env.step), quick.jit(env.reset)(jax.random.key(0))
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, env.action_size))
    theirs.reset(seed=0)
    found = []
    for action in actions:
        before = starting_at(state, theirs.data)
        observation, reward, terminated, _, _ = theirs.step(action)
        ours = step(before, jnp.asarray(action, jnp.float32))
        found.append((observation, reward, terminated, jax.device_get(ours)))
        if terminated:
            theirs.reset()
    return found


def test_it_keeps_to_the_protocol():
    check_env(gymnasium_ant.build(engine="c"))


def test_positions_and_velocities_are_gymnasiums(steps):
    for observation, _, _, ours in steps:
        assert ours.observation.shape == observation.shape == (105,)
        np.testing.assert_allclose(ours.observation[:27], observation[:27], atol=1e-4)


def test_contact_forces_are_on_gymnasiums_bodies(steps):
    """Taken a moment earlier: a body that has just touched, or let go, differs."""
    theirs = np.array([s[0][27:].reshape(13, 6) for s in steps])
    ours = np.array([s[3].observation[27:].reshape(13, 6) for s in steps])
    touched = (np.abs(theirs) > 0).any(2) & (np.abs(ours) > 0).any(2)
    assert touched.sum() > 30
    assert np.isclose(ours, theirs, atol=0.01)[touched].mean() > 0.7
    assert ((np.abs(theirs) > 0).any(2) == (np.abs(ours) > 0).any(2)).mean() > 0.97


def test_rewards_and_ends_are_gymnasiums(steps):
    ends = [terminated for _, _, terminated, _ in steps]
    assert 0 < sum(ends) < STEPS
    assert [bool(ours.terminated) for *_, ours in steps] == ends
    differences = [abs(reward - ours.reward) for _, reward, _, ours in steps]
    # Gymnasium's position is that of its integrator's last stage, 1e-3 m away at most.
    assert np.median(differences) < 0.005
    assert max(differences) < 0.06


def test_starts_are_spread_as_gymnasiums():
    theirs = gymnasium.make("Ant-v5").unwrapped
    theirs.reset(seed=0)
    expected = np.array([theirs.reset()[0] for _ in range(2000)])
    env = gymnasium_ant.build(engine="c")
    keys = jax.random.split(jax.random.key(0), 2000)
    starts = np.asarray(quick.jit(jax.vmap(env.reset))(keys).observation)
    np.testing.assert_allclose(starts.mean(0), expected.mean(0), atol=0.02)
    np.testing.assert_allclose(starts.std(0), expected.std(0), atol=0.01)
    np.testing.assert_allclose(starts.max(0)[:13], expected.max(0)[:13], atol=0.01)


def test_both_trainers_learn_with_equal_sizes():
    """Counts stable-baselines3's gradient steps and parameters, and ours."""
    pytest.importorskip("stable_baselines3", reason="needs the extra peers")
    from purerl.experiments.peers import sb3 as peers

    sizes = peers.Sizes((16, 8), "swish", samples=512, minibatch=64, epochs=2)
    part = peers.sb3(sizes, 2, processes=False, threads=1)
    model = part.call.model
    assert model.num_timesteps == part.steps == 512
    assert model._n_updates == sizes.epochs
    assert (model.n_steps, model.n_envs, model.batch_size) == (256, 2, 64)
    config, network = peers.our_config(sizes), peers.our_network(sizes)
    assert config.steps_per_update == 512
    assert config.steps_per_update // config.num_minibatches == sizes.minibatch
    built = peers.experiment.build_network(network, jnp.zeros(105), 8)
    params = built.init(jax.random.key(0))[0]
    number = sum(x.size for x in jax.tree.leaves(params))
    assert number == sum(p.numel() for p in model.policy.parameters())


@pytest.mark.nightly
def test_braxs_environment_keeps_to_the_protocol_and_steps_as_braxs():
    """Its states through our record and back are the states that brax steps through itself."""
    pytest.importorskip("brax", reason="needs the extra peers")
    from purerl.experiments.peers import brax_env

    env = brax_env.build(brax_env.Options(backend="positional"))  # the quickest to compile
    check_env(env)
    key, step = jax.random.key(0), quick.jit(env.step)
    ours, theirs = quick.jit(env.reset)(jax.random.clone(key)), quick.jit(env.env.reset)(key)
    their_step = quick.jit(env.env.step)
    for i in range(10):
        action = jnp.full(env.action_size, (-1.0) ** i)
        ours, theirs = step(ours, action), their_step(theirs, action)
        np.testing.assert_allclose(ours.observation, theirs.obs, atol=1e-5)
        np.testing.assert_allclose(ours.reward, theirs.reward, atol=1e-5)
        assert bool(ours.terminated) == bool(theirs.done)


@pytest.mark.parametrize("body", ["ant", "humanoid", "halfcheetah"])
def test_braxs_settings_make_the_same_update(body):
    """As many samples, of as many environments, in minibatches of the same size."""
    from purerl.experiments.peers import brax_peer

    sizes = brax_peer.BODIES[body]
    config = brax_peer.our_experiment(body, "mjx", sizes, 10**8).ppo
    assert config.steps_per_update == sizes.samples
    assert sizes.batch_size * sizes.num_minibatches % sizes.num_envs == 0  # brax's own rule
    minibatch = config.steps_per_update // config.num_minibatches
    assert minibatch == sizes.batch_size * sizes.unroll_length


@pytest.mark.parametrize("body", ["ant", pytest.param("humanoid", marks=pytest.mark.nightly)])
def test_braxs_body_moves_on_our_physics_as_on_braxs(body):
    pytest.importorskip("brax", reason="needs the extra peers")
    from purerl.experiments.peers import brax_env

    ours, theirs = (
        brax_env.build(brax_env.Options(body, physics), "jax") for physics in ("purerl", "mjx")
    )
    our_step, their_step = quick.jit(ours.step), quick.jit(theirs.step)
    state, reached = (
        quick.jit(ours.reset)(jax.random.key(0)),
        quick.jit(theirs.reset)(jax.random.key(0)),
    )
    for i in range(20):
        # From brax's state each time: contacts make the smallest difference grow.
        names = ("qpos", "qvel", "qacc_warmstart")
        same = {name: getattr(reached.physics, name) for name in names}
        physics = state.physics.replace(physics=state.physics.physics.replace(**same))
        action = 0.5 * jnp.sin(jnp.arange(ours.action_size) + i)
        state = our_step(state.replace(physics=physics), action)
        reached = their_step(reached, action)
        np.testing.assert_allclose(state.physics.q, reached.physics.q, atol=1e-4)
        np.testing.assert_allclose(state.physics.qd, reached.physics.qd, atol=1e-2)
        # Links are those of another physics step, one later.
        np.testing.assert_allclose(state.physics.x.pos, reached.physics.x.pos, atol=0.1)
        np.testing.assert_allclose(state.physics.xd.vel, reached.physics.xd.vel, atol=1.0)
        assert bool(state.terminated) == bool(reached.terminated)


def test_a_training_has_braxs_number_of_updates():
    """Brax rounds up to the same number of updates between any two evaluations."""
    from purerl.experiments.peers import brax_peer, brax_training

    task = brax_training.make_task("ant", brax_peer.BODIES["ant"], 31_000_000, evaluations=6)
    assert (task.stretches, task.updates, task.steps) == (5, 19, 31_129_600)


def test_the_difference_of_returns_has_an_interval_from_five_seeds_on():
    from purerl.experiments.peers import brax_training

    ours, theirs = np.arange(5.0) + 100, np.arange(5.0)
    assert brax_training.difference(ours, theirs).startswith("100 [")
    assert brax_training.difference(ours[:4], theirs) == "100, too few seeds"


def test_our_runs_stand_beside_braxs(tmp_path, capsys):
    """Runs of another body are left out; one without an evaluation is told."""
    from purerl.experiments.peers import brax_training

    run = brax_training.Run("brax", "ant", 0, False, [0, 10], [1.0, 30.0], [0.0, 100.0], [])
    theirs = [run._replace(seed=i, returns=[0.0, 100.0 + i])._asdict() for i in range(5)]
    theirs.append(run._replace(body="humanoid", returns=[0.0, 900.0])._asdict())
    file = tmp_path / "brax.json"
    file.write_text(json.dumps({"runs": theirs}))
    for seed in range(5):
        folder = tmp_path / "runs" / f"seed{seed}"
        folder.mkdir(parents=True)
        settings = {"seed": seed, "ppo": {}, "env": {"name": "ant"}}
        (folder / "config.json").write_text(json.dumps({"experiment": "x", "settings": settings}))
        (folder / "manifest.json").write_text("{}")
        (folder / "experiment.py").write_text("")
        line = {
            "update": 3,
            "steps": 4_000_000,
            "wall_s": 60.0,
            "eval/episode_return": 200.0 + seed,
        }
        (folder / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    words = ["table", "ant", str(file), str(tmp_path / "runs")]
    assert brax_training.main(words) == 0
    brax, ours = capsys.readouterr().out.splitlines()[2:]
    assert brax.startswith("| brax | 5 | 0.0 M | 30 | 102 (100 to 104) |")
    assert ours.startswith("| purerl | 5 | 4.0 M | 60 | 202 (200 to 204) | 100 [")
    (folder / "metrics.jsonl").write_text(json.dumps({"update": 3, "steps": 4}) + "\n")
    with pytest.raises(UserError, match="seed4 has no eval/episode_return"):
        brax_training.main(words)
