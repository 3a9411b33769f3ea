"""Networks that see, and environments with eyes."""

import dataclasses
import importlib.util
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from purerl import Physics, eyes
from purerl.envs import run, sight
from purerl.eyes.networks import windows
from purerl.ppo import running_moments
from purerl.report import numpy_policy, policy_npz

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly")

LAB = eyes.Encoder(channels=(4, 8), kernels=(3, 3), strides=(1, 2), features=6)
SEEN = {"policy": jnp.ones(3), "eyes": jnp.zeros((2, 12, 12), jnp.uint8), "privileged": jnp.ones(2)}
NORMAL = SEEN | {"eyes": jnp.zeros((2, 12, 12))}


@pytest.mark.parametrize(("kernel", "stride"), [(3, 1), (3, 2), (4, 4), (5, 3)])
def test_windows_times_weights_are_a_convolution(kernel, stride):
    x = jax.random.normal(jax.random.key(0), (2, 13, 14, 3))
    weights = jax.random.normal(jax.random.key(1), (kernel, kernel, 3, 5))
    right = jax.lax.conv_general_dilated(
        x, weights, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    found = windows(x, kernel, stride) @ weights.reshape(-1, 5)
    np.testing.assert_allclose(found, right, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shared", [True, False])
def test_both_eyes_reach_the_policy(shared):
    options = eyes.MlpOptions(eyes=dataclasses.replace(LAB, shared=shared))
    network = eyes.mlp(options, SEEN, 2)
    params, memory = jax.jit(network.init)(jax.random.key(0))
    assert memory == ()
    assert sum("Convolutions" in name for name in params["params"]) == 2 - shared

    def policy(pictures):
        return network.apply(params, NORMAL | {"eyes": pictures}, ())[0].distribution.loc.sum()

    moved = jax.jit(jax.grad(policy))(jax.random.normal(jax.random.key(1), (2, 12, 12)))
    assert (np.abs(moved).max(axis=(1, 2)) > 0).all()
    batched = jax.tree.map(lambda x: jnp.broadcast_to(x, (4, 5, *x.shape)), NORMAL)
    assert jax.jit(network.apply)(params, batched, ())[0].value.shape == (4, 5)


def exported(options: eyes.MlpOptions, params: dict, file: Path) -> numpy_policy.Policy:
    """The reader of a policy of SEEN, as if it were a run's."""
    statistics = running_moments.init(SEEN)
    source = SimpleNamespace(source=SimpleNamespace(name="none"))
    run = SimpleNamespace(
        experiment=SimpleNamespace(build_network=eyes.mlp, network=options), restored=source,
        state=SimpleNamespace(params=params, normalizer=statistics), update=0, steps=0, digest="",
        env=SimpleNamespace(control_timestep=0.1),
    )  # fmt: skip
    np.savez(file, **policy_npz.policy_arrays(run))
    return numpy_policy.Policy(file)


@pytest.mark.parametrize(("shared", "kernels"), [(True, (3, 3)), (False, (3, 2)), (True, ())])
def test_numpy_sees_the_same_in_windows_that_overlap(shared, kernels, tmp_path):
    """Odd edges are cut off; each eye has its encoder; without layers a picture is all features."""
    lab = eyes.Encoder((4, 8)[: len(kernels)], kernels, (1, 2)[: len(kernels)], 6, shared)
    network = eyes.mlp(options := eyes.MlpOptions(eyes=lab), SEEN, 2)
    params, _ = jax.jit(network.init)(jax.random.key(0))
    random = np.random.default_rng(0)
    params = jax.tree.map(lambda x: jnp.float32(0.2 * random.normal(size=x.shape)), params)
    policy = exported(options, params, tmp_path / "p.npz")
    pictures = random.integers(0, 256, (3, 2, 12, 12), np.uint8)
    seen = {name: np.broadcast_to(x, (3, *x.shape)) for name, x in SEEN.items()}
    seen["eyes"] = pictures
    right = jax.jit(network.apply)(params, seen | {"eyes": pictures / 127.5 - 1}, ())[0]
    action = policy(seen)
    np.testing.assert_allclose(action, np.tanh(right.distribution.loc), atol=1e-5)
    assert np.abs(action - action[0]).max() > 1e-3


def test_a_memory_stands_behind_the_eyes():
    network = eyes.recurrent(eyes.RecurrentOptions(cell="lstm", hidden=7, eyes=LAB), SEEN, 2)
    params, memory = jax.jit(network.init)(jax.random.key(0))
    output, following = jax.jit(network.apply)(params, NORMAL, memory)
    assert output.distribution.loc.shape == (2,) and following[0].shape == (7,)


def test_what_is_privileged_moves_the_value_alone():
    network = eyes.mlp(eyes.MlpOptions(eyes=LAB), SEEN, 2)
    params, _ = jax.jit(network.init)(jax.random.key(0))
    one, other = (
        network.apply(params, NORMAL | {"privileged": x * jnp.ones(2)}, ())[0] for x in (0, 1)
    )
    assert np.array_equal(one.distribution.loc, other.distribution.loc) and one.value != other.value


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: eyes.Encoder(channels=(4, 8)), "are of different lengths"),
        (lambda: eyes.Encoder(strides=(2, 0, 2)), "has a number below 1"),
        (lambda: eyes.mlp(eyes.MlpOptions(), jnp.zeros(4), 2), "needs a dict with pictures"),
        (
            lambda: eyes.mlp(
                eyes.MlpOptions(eyes=LAB), SEEN | {"eyes": jnp.zeros((1, 3, 3))}, 2
            ).init(jax.random.key(0)),
            "A kernel of 3 looks at a picture of 1 x 1 pixels",
        ),
        (lambda: sight.Sight(number=1, dropout=0.5), "closed and dropout are of two eyes"),
        (lambda: sight.Sight(number=2, dropout=1.5), "dropout is 1.5"),
    ],
)
def test_mistakes_are_a_line(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_pictures_have_no_statistics_and_are_normalized_by_their_range():
    statistics = running_moments.init(SEEN)
    assert jax.tree.leaves(statistics.mean["eyes"]) == []
    batch = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), SEEN)
    seen = running_moments.deviations(statistics, batch, jnp.ones(2, bool))
    merged = running_moments.merge(statistics, seen)
    white = SEEN | {"eyes": jnp.full((2, 12, 12), 255, jnp.uint8)}
    assert (running_moments.normalize(merged, white)["eyes"] == 1.0).all()
    assert (running_moments.normalize(merged, SEEN)["eyes"] == -1.0).all()
    np.testing.assert_allclose(running_moments.normalize(merged, SEEN)["policy"], -1.0, rtol=1e-5)


# --- the corridor ---


@pytest.fixture(scope="module")
def ant():
    """15 s: the ant in a corridor, with two eyes, one of which may be closed."""
    options = sight.Sight(
        number=2, size=16, reach=8.0, check=0.5, dropout=0.5, noise=0.02, blur=0.5
    )
    env = run.build(run.Options(arena="gaps", eyes=options), "c")
    return env, jax.jit(env.reset), jax.jit(env.step)


@pytest.mark.slow
def test_the_actor_is_not_told_of_edges(ant):
    env, reset, _ = ant
    told = jax.jit(run.build(run.Options(arena="gaps"), "c").reset)
    seen, known = reset(jax.random.key(0)).observation, told(jax.random.key(0)).observation
    assert seen["eyes"].shape == (2, 16, 16) and seen["eyes"].dtype == jnp.uint8
    # Else it is the same environment: the same start, and what is missing is the critic's.
    assert np.array_equal(np.concatenate([seen["policy"], seen["privileged"]]), known)


@pytest.mark.slow
def test_a_gap_ahead_is_seen_and_each_episode_has_its_own(ant):
    env, reset, _ = ant

    @jax.jit
    def sees(state):
        return env.eyes.see(*places(env, state))

    sharp = [sees(reset(jax.random.key(k))) for k in (0, 0, 1)]
    sharp = list(map(np.asarray, sharp))
    assert np.array_equal(sharp[0], sharp[1]) and not np.array_equal(sharp[0], sharp[2])
    assert (sharp[0] == 0).any()  # the abyss


def places(env, state):
    """What the eyes of a state are given."""
    readings = env.physics.init(state.physics.qpos, state.physics.qvel, env.model_changes(state))[1]
    return readings.xpos, readings.xmat, env.scenery(state)


@pytest.mark.slow
def test_an_eye_is_closed_for_a_whole_episode(ant):
    _, reset, step = ant
    closed = []
    for key in jax.random.split(jax.random.key(0), 12):
        state = reset(key)
        later = step(state, jnp.zeros(8))
        black = [np.asarray(s.observation["eyes"] == 0).all(axis=(1, 2)) for s in (state, later)]
        assert np.array_equal(*black)
        closed.append(tuple(black[0].tolist()))
    assert {(False, False), (True, False), (False, True)} == set(closed)


def test_noise_is_drawn_anew_at_each_step():
    options = sight.Sight(number=1, noise=0.1)
    drawn = sight.draw(jax.random.key(0), options)
    flat = jnp.full((1, 32, 32), 128, jnp.uint8)
    one, same, later = (sight.spoil(flat, drawn, jnp.float32(t), options) for t in (0.0, 0.0, 0.02))
    assert np.array_equal(one, same) and not np.array_equal(one, later)
    assert 20 < np.asarray(one, float).std() < 31


def test_blur_keeps_the_mean_and_spreads_a_point():
    point = jnp.zeros((1, 21, 21)).at[0, 10, 10].set(100.0)
    seen = np.asarray(sight.blurred(point, 2.0))
    assert np.isclose(seen.sum(), 100.0, rtol=1e-4)
    rows = (seen[0].sum(1) * np.square(np.arange(21) - 10)).sum() / 100
    assert np.isclose(rows, 4.0, rtol=0.05)


@pytest.mark.slow
def test_engines_see_the_same():
    """15 s: an arm of three links and its eye; positions differ in their last bits."""
    links = '<body pos="0 0 .3"><joint axis="0 1 .3"/><geom type="capsule" size=".03 .1"/>{}</body>'
    arm = links.format(links.format(links.format('<body name="eye" pos=".1 0 .1"/>')))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="0 0 1"/>{arm}</worldbody></mujoco>'
    )
    model.geom_contype[:] = 0
    see = jax.jit(jax.vmap(eyes.Eyes(model, [eyes.Eye("eye", direction=(1.0, 0.0, -0.5))]).see))
    qpos = jax.random.uniform(jax.random.key(0), (16, 3), minval=-1.0)
    pictures = []
    warp = ["warp"] if importlib.util.find_spec("warp") else []  # on this CPU, by its own kernels
    for engine in ("c", "jax", *warp):
        init = Physics(model, ("xpos", "xmat"), 1, engine).init
        readings = jax.jit(jax.vmap(lambda q, init=init: init(q, jnp.zeros(3))[1]))(qpos)
        pictures.append(np.asarray(see(readings.xpos, readings.xmat)))
    assert pictures[0].std() > 30
    assert all((pictures[0] != other).mean() < 0.002 for other in pictures[1:])
