"""Networks that act through a code: what it costs, and how another task uses it again."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import Network, Normal, PolicyOutput, eyes, networks, run
from purerl.core.errors import INTERRUPTED, SUCCESS
from purerl.devices.programs import abstract_state
from purerl.experiment import objects
from purerl.experiments import (
    ant_gaps_reuse,
    ant_intention,
    intention,
    rodent_gaps_reuse,
    rodent_intention,
)
from purerl.experiments.intention import Coder, Decoder, divergence, in_ball
from purerl.machine.state_arrays import leaf_paths
from tests import quick
from tests.experiments import toy_imitating, toy_reusing
from tests.training.test_network_parts import saved

pytestmark = pytest.mark.usefixtures("file_is_compiled_quickly", "programs_are_kept")

FELT, TOLD, ACTIONS = 5, 4, 2
SMALL = toy_imitating.SMALL
STANDARD = Normal(jnp.zeros(()), jnp.ones(()))


def some(*shape, seed=0, size=1.0):
    return jnp.float32(np.random.default_rng(seed).normal(scale=size, size=shape))


def spread(params, size=0.5):
    """Returns parameters far from those drawn, which are nearly zero where it matters."""
    leaves, tree = jax.tree.flatten(params)
    leaves = [x + some(*x.shape, seed=i, size=size) for i, x in enumerate(leaves)]
    return jax.tree.unflatten(tree, leaves)


# --- what a code costs ---


def test_the_divergence_is_the_integral():
    p = [np.array(x) for x in ([0.3, -1.0, 0.0], [0.5, 1.7, 1.0])]
    q = [np.array(x) for x in ([-0.4, 0.2, 0.0], [0.9, 1.1, 1.0])]
    x = np.linspace(-15.0, 15.0, 300_001)[:, None]

    def log_density(loc, scale):
        return -0.5 * np.square((x - loc) / scale) - np.log(scale * np.sqrt(2 * np.pi))

    here, there = log_density(*p), log_density(*q)
    whole = np.trapezoid(np.exp(here) * (here - there), x, axis=0)
    assert whole[0] > 0.1 and whole[1] > 0.1
    found = divergence(*(Normal(*map(jnp.float32, one)) for one in (p, q)))
    np.testing.assert_allclose(found, whole.mean(), rtol=1e-5)


def test_a_code_that_tells_nothing_costs_nothing():
    assert float(divergence(Normal(jnp.zeros(4), jnp.ones(4)), STANDARD)) == 0.0
    assert float(divergence(Normal(jnp.zeros(4), jnp.full(4, 0.5)), STANDARD)) > 0.1


@pytest.fixture(scope="module")
def imitator():
    options = intention.ImitationOptions(**SMALL, encoder=(8,), value=(8,))
    observation = {"proprioception": some(7, FELT), "reference": some(7, TOLD, seed=1)}
    one = jax.tree.map(lambda x: x[0], observation)
    network = intention.imitate(options, one, ACTIONS)
    return network, spread(network.init(jax.random.key(0))[0]), observation


@pytest.mark.parametrize(("loss", "part"), [("code_kl", "encoder"), ("prior_kl", "prior")])
def test_a_loss_teaches_its_own_part_alone(imitator, loss, part):
    network, params, observation = imitator

    def mean(params):
        return network.apply(params, observation, (), some(7, 3))[0].losses[loss].mean()

    gradient = quick.jit(jax.grad(mean))(params)["params"]
    assert {"encoder", "prior", "decoder", "value", "value_out", "scale"} == gradient.keys()
    moved = {name for name, x in gradient.items() if any(np.any(y) for y in jax.tree.leaves(x))}
    assert moved == {part}


def test_the_losses_are_of_the_code_and_of_what_is_felt(imitator):
    network, params, observation = imitator
    both = jnp.concatenate([observation["reference"], observation["proprioception"]], -1)
    code, prior = (
        Coder(widths, 3).apply({"params": params["params"][name]}, x)
        for name, widths, x in (
            ("encoder", (8,), both),
            ("prior", (4,), observation["proprioception"]),
        )
    )
    losses = network.apply(params, observation, ())[0].losses
    np.testing.assert_allclose(losses["code_kl"], divergence(code, STANDARD), rtol=1e-5)
    np.testing.assert_allclose(losses["prior_kl"], divergence(code, prior), rtol=1e-5)
    assert losses["code_kl"].shape == (7,)
    for scale in (code.scale, prior.scale):
        assert np.exp(-5.01) < scale.min() and scale.max() < np.exp(2.01)


def test_noise_draws_the_code_and_without_it_the_code_is_its_mean(imitator):
    network, params, observation = imitator
    felt, own = observation["proprioception"], params["params"]
    both = jnp.concatenate([observation["reference"], felt], -1)
    code = Coder((8,), 3).apply({"params": own["encoder"]}, both)
    apply, noise = quick.jit(network.apply), some(7, 3, seed=3)

    def moved(code):
        return Decoder((8,), ACTIONS).apply({"params": own["decoder"]}, felt, code)

    by_mean, again = (apply(params, observation, ())[0].distribution for _ in range(2))
    np.testing.assert_array_equal(by_mean.loc, again.loc)
    np.testing.assert_allclose(by_mean.loc, moved(code.loc), rtol=1e-4, atol=1e-5)
    drawn = apply(params, observation, (), noise)[0].distribution
    expected = moved(code.loc + code.scale * noise)
    np.testing.assert_allclose(drawn.loc, expected, rtol=1e-4, atol=1e-5)
    assert np.abs(drawn.loc - by_mean.loc).max() > 1e-2
    assert network.draw(jax.random.key(0)).shape == (3,)


# --- a code that is used again ---


def test_a_ball_holds_what_is_drawn_into_it():
    x = some(200, 3, seed=4) * np.logspace(-4, 6, 200)[:, None]
    held = np.asarray(in_ball(jnp.float32(x), 2.0))
    length, before = np.linalg.norm(held, axis=-1), np.linalg.norm(x, axis=-1)
    assert length.max() <= 2.0 * (1 + 1e-6) and length[-1] > 1.999
    cosine = (held * x).sum(-1) / (length * before)
    np.testing.assert_allclose(cosine, 1.0, atol=1e-5)  # as it points
    near = before < 1e-2
    np.testing.assert_allclose(held[near], x[near], rtol=1e-4)
    assert 3 < near.sum() < 200
    # Halfway: 2 of a radius of 2 comes to 2 / sqrt(2).
    np.testing.assert_allclose(in_ball(jnp.float32([2.0, 0.0]), 2.0), [np.sqrt(2.0), 0.0])
    np.testing.assert_array_equal(jax.jacobian(in_ball)(jnp.zeros(3), 2.0), np.eye(3))


def wishing(options, observation, code):
    """A task's policy that says what its parameters are."""

    def apply(params, observation, memory):
        loc = jnp.broadcast_to(params["wish"], (*observation["policy"].shape[:-1], code))
        return PolicyOutput(Normal(loc, jnp.ones_like(loc)), loc.sum(-1)), memory

    return Network(lambda key: ({"wish": jnp.zeros(code)}, ()), apply)


@pytest.fixture(scope="module")
def asked():
    """Returns what a network of `wishing` answers, and the actions' means, prior of its parts."""
    observation = {"proprioception": some(7, FELT), "policy": some(7, 1)}
    felt = observation["proprioception"]

    def ask(wish, **more):
        options = intention.ReuseOptions(**SMALL, radius=2.0, **more)
        one = jax.tree.map(lambda x: x[0], observation)
        network = intention.reuse(wishing)(options, one, ACTIONS)
        own = spread(network.init(jax.random.key(0))[0]["params"])
        params = {"params": {**own, "task": {"wish": jnp.full(3, wish)}}}
        prior = Coder((4,), 3).apply({"params": own["prior"]}, felt)
        output = network.apply(params, observation, ())[0]
        return (
            output,
            prior,
            lambda code: Decoder((8,), ACTIONS).apply({"params": own["decoder"]}, felt, code),
        )

    return ask


def test_without_a_wish_the_code_is_the_priors_mean(asked):
    output, prior, moved = asked(0.0)
    np.testing.assert_allclose(output.distribution.loc, moved(prior.loc), rtol=1e-6)
    assert not np.any(output.losses["anchor"]) and output.losses["code_distance"].max() < 1e-5


def test_a_wish_is_in_the_priors_deviations_and_stays_in_the_ball(asked):
    output, prior, moved = asked(1.0)
    away = np.ones(3) / np.sqrt(1 + 3 / 4)
    np.testing.assert_allclose(
        output.distribution.loc, moved(prior.loc + prior.scale * away), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(output.losses["anchor"], 4 / 7, rtol=1e-5)
    np.testing.assert_allclose(output.losses["code_distance"], np.sqrt(12 / 7), rtol=1e-5)
    far = asked(1e4)[0].losses["code_distance"]
    assert far.min() > 1.99 and far.max() <= 2.0 * (1 + 1e-6)


def test_the_decoder_alone_takes_the_wish_itself(asked):
    output, prior, moved = asked(5.0, from_prior=False)
    np.testing.assert_allclose(
        output.distribution.loc, moved(jnp.full((7, 3), 5.0)), rtol=1e-3, atol=1e-4
    )
    away = np.linalg.norm((5.0 - np.asarray(prior.loc)) / np.asarray(prior.scale), axis=-1)
    np.testing.assert_allclose(output.losses["code_distance"], away, rtol=1e-4)
    assert away.max() > 2.0


SIZES = {"hidden": 6, "encoder": (8,), "value_hidden": (8,)}
EYES = eyes.Encoder(channels=(2,), kernels=(4,), strides=(4,), features=3)


@pytest.mark.parametrize("seeing", [False, True])
def test_the_tasks_network_may_see_remember_and_have_a_critic_that_is_told_more(seeing):
    observation = {"proprioception": some(FELT), "policy": some(3), "privileged": some(2)}
    build, task = networks.recurrent, networks.RecurrentOptions(**SIZES)
    if seeing:
        observation["eyes"] = jnp.uint8(some(2, 8, 8, size=90.0) % 256)
        build, task = eyes.recurrent, eyes.RecurrentOptions(**SIZES, eyes=EYES)
    network = intention.reuse(build)(
        intention.ReuseOptions(**SMALL, task=task), observation, ACTIONS
    )
    params, memory = network.init(jax.random.key(0))
    params, apply = spread(params), quick.jit(network.apply)
    assert memory.shape == (6,) and not memory.any()

    def answer(memory=memory, **changed):
        output, after = apply(params, observation | changed, memory)
        return np.asarray(output.distribution.loc), float(output.value), np.asarray(after)

    loc, value, after = answer()
    assert loc.shape == (ACTIONS,) and after.shape == (6,) and after.any()
    other, told, _ = answer(privileged=some(2, seed=9))
    assert (other == loc).all() and told != value
    for change in ("policy", "proprioception", *["eyes"] * seeing):
        x = observation[change]
        assert (answer(**{change: (x + 1).astype(x.dtype)})[0] != loc).any(), change
    assert (answer(memory=jnp.ones(6))[0] != loc).all()


def test_noise_that_the_tasks_network_draws_reaches_it():
    def drawing(options, observation, code):
        def apply(params, observation, memory, noise=None):
            loc = jnp.zeros(code) if noise is None else noise
            return PolicyOutput(Normal(loc, jnp.ones(code)), jnp.zeros(())), memory

        draw = lambda key: jax.random.normal(key, (code,))  # noqa: E731
        return Network(lambda key: ({}, ()), apply, draw)

    observation = {"proprioception": some(FELT)}
    network = intention.reuse(drawing)(intention.ReuseOptions(**SMALL), observation, ACTIONS)
    params, _ = network.init(jax.random.key(0))
    noise = network.draw(jax.random.key(1))
    by_mean, drawn = (network.apply(params, observation, (), *x)[0] for x in ((), (noise,)))
    assert by_mean.losses["code_distance"] < 1e-5 and drawn.losses["code_distance"] > 0.1


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"radius": 0.0}, "radius is 0.0; it must be above 0."),
        ({"code": 0}, "code=0, .* has a width below 1."),
        ({"decoder": (8, 0)}, "has a width below 1."),
        ({"initial_std": 0.0}, "initial_std is 0.0, min_std 0.001; they must be 0.001 to 100, and"),
        ({"min_std": 0.0}, "min_std 0.0; they must be"),
    ],
)
def test_sizes_of_which_no_network_is_made_are_refused(wrong, says):
    with pytest.raises(ValueError, match=says):
        intention.ReuseOptions(**wrong)


def test_an_observation_without_what_is_needed_is_refused():
    for build, seen, says in (
        (intention.imitate, {"proprioception": some(2)}, "no 'reference' .proprioception.: take"),
        (intention.reuse(networks.mlp), some(2), "no 'proprioception' .one array.: take envs.im"),
    ):
        with pytest.raises(ValueError, match=says):
            build(intention.ReuseOptions(), seen, 1)


# --- runs ---


def start(toy, runs, *words):
    return run.main([toy.__file__, "--runs", str(runs), "--checkpoints", "4", *words])


def taking(old):
    return [x for p in ("decoder", "prior") for x in (f"--parts.{p}.run", str(old))]


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    runs = tmp_path_factory.mktemp("old")
    assert start(toy_imitating, runs) == SUCCESS
    return runs / "toy_imitating" / "seed1"


@pytest.fixture(scope="module")
def reused(old, tmp_path_factory):
    runs = tmp_path_factory.mktemp("reused")
    assert start(toy_reusing, runs, *taking(old)) == SUCCESS
    return runs / "toy_reusing" / "seed1"


def logged(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_decoder_and_prior_stay_the_other_runs_to_the_bit_and_read_in_its_units(old, reused):
    before, after = saved(old), saved(reused)
    frozen = {k for k in after if k.startswith(("params/params/decoder/", "params/params/prior/"))}
    units = {k for k in after if k.startswith("normalizer/") and "/proprioception/" in k}
    assert len(frozen) == 2 * 6 and len(units) == 4
    for name in frozen | units:
        np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    assert (after["params/params/scale"] != before["params/params/scale"]).all()
    moments = {k for k in after if k.startswith("optimizer/") and "/params/" in k}
    for name in moments:
        still = "/params/decoder/" in name or "/params/prior/" in name
        assert not (still and after[name].any()), name
    assert any("/task/" in k and after[k].any() for k in moments)


def test_what_a_code_costs_is_logged(old, reused):
    first, last = logged(old)[0], logged(reused)[-1]
    assert first["train/auxiliary/code_kl"] > 0 and first["train/auxiliary/prior_kl"] > 0
    assert 0 < last["train/auxiliary/code_distance"] < 5.0
    assert last["train/auxiliary/code_distance_weight"] == 0.0


@pytest.mark.slow
def test_a_killed_run_goes_on_without_the_run_it_was_taken_from(old, reused, tmp_path, stop_after):
    copy = shutil.copytree(old, tmp_path / "gone")
    stop_after(5)
    assert start(toy_reusing, tmp_path, *taking(copy)) == INTERRUPTED
    stop_after(10**9)
    shutil.rmtree(copy)
    assert start(toy_reusing, tmp_path, "--resume") == SUCCESS
    assert logged(tmp_path / "toy_reusing/seed1")[-1]["digest"] == logged(reused)[-1]["digest"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("imitates", "reuses", "first_layer"),
    [(ant_intention, ant_gaps_reuse, (63 + 8, 128)),
     (rodent_intention, rodent_gaps_reuse, (277 + 16, 512))],
)  # fmt: skip
def test_what_is_taken_over_fits_the_gaps(imitates, reuses, first_layer):
    """It has in both experiments the same shapes, and acts at the same rate."""
    pytest.importorskip("h5py", reason="pip install -e '.[clips]'")
    imitates, reuses = imitates.experiment, reuses.experiment
    built = [objects.build(dataclasses.replace(x, parts={})) for x in (imitates, reuses)]
    assert built[0].env.control_timestep == pytest.approx(built[1].env.control_timestep)
    states = [abstract_state(*x[:3]) for x in built]
    before, after = (dict(zip(leaf_paths(x), jax.tree.leaves(x), strict=True)) for x in states)
    assert after["params/params/decoder/Tower_0/Dense_0/kernel"].shape == first_layer
    taken = ("params/params/decoder/", "params/params/prior/", "normalizer/mean/proprioception/")
    for name, x in after.items():
        if name.startswith(taken):
            assert x.shape == before[name].shape, name
    assert reuses.parts.keys() == {"decoder", "prior"}
    for part in reuses.parts.values():
        assert part.rate == 0.0 and part.reads == ("proprioception",)
