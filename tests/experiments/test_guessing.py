"""A policy that guesses what another was told: by sight alone, and as that one acts. Costs 8 s."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from purerl import eyes, networks
from purerl.experiment.loading import find
from purerl.experiments import guessing

SIZES = networks.MlpOptions(policy_hidden=(8,), value_hidden=(8,), std="state")
OPTIONS = guessing.Options(
    eyes=eyes.Encoder(channels=(4,), kernels=(2,), strides=(2,), features=8),
    features=16, hidden=8, policy=SIZES,
)  # fmt: skip
FELT, TOLD, ACTIONS = 3, 2, 4


def observed(number, key=0):
    """Random ones [number]; where a bright column is, is `privileged`."""
    felt_key, place_key = jax.random.split(jax.random.key(key))
    column = jax.random.randint(place_key, (number, TOLD), 0, 8)
    light = jax.nn.one_hot(column, 8, dtype=jnp.uint8).sum(1) * 255
    pictures = jnp.broadcast_to(light[:, None, None], (number, 2, 8, 8)).astype(jnp.float32)
    return {
        "policy": jax.random.normal(felt_key, (number, FELT)),
        "privileged": jnp.sort(column / 4.0 - 1.0, axis=-1),
        "eyes": pictures / 127.5 - 1.0,
    }


@pytest.fixture(scope="module")
def made():
    example = jax.tree.map(lambda x: x[0], observed(1))
    network = guessing.guess(OPTIONS, example, ACTIONS)
    params, memory = network.init(jax.random.key(1))
    bright = jax.tree.map(lambda x: x + 0.3, params)  # the head begins near 0
    return network, bright, jnp.broadcast_to(memory, (5, *memory.shape))


@pytest.mark.slow
def test_the_actor_is_not_told_and_the_value_function_is(made):
    network, params, memory = made
    seen = observed(5)
    other = seen | {"privileged": seen["privileged"] + 1.0}
    (one, first), (two, second) = (network.apply(params, x, memory) for x in (seen, other))
    assert (one.distribution.loc == two.distribution.loc).all() and (first == second).all()
    assert (one.distribution.scale == two.distribution.scale).all()
    assert (one.value != two.value).all() and (one.losses["guess"] != two.losses["guess"]).all()
    blind = seen | {"eyes": -jnp.ones_like(seen["eyes"])}
    assert (network.apply(params, blind, memory)[0].distribution.loc != one.distribution.loc).any()


def test_a_guess_that_is_right_moves_it_as_the_one_that_was_told(made):
    network, params, memory = made
    seen = jax.tree.map(lambda x: jnp.repeat(x[:1], 5, 0), observed(5))
    own = dict(params["params"])
    own["guess"] = {"kernel": jnp.zeros((8, TOLD)), "bias": seen["privileged"][0]}
    output, _ = network.apply({"params": own}, seen, memory)
    told = jnp.concatenate([seen["policy"], seen["privileged"]], -1)
    teacher = networks.mlp(SIZES, told[0], ACTIONS)
    theirs, _ = teacher.init(jax.random.key(0))
    theirs = {"params": theirs["params"] | {k: own[k] for k in ("policy", "head")}}
    wanted, _ = teacher.apply(theirs, told, ())
    np.testing.assert_allclose(output.distribution.loc, wanted.distribution.loc, rtol=1e-6)
    np.testing.assert_allclose(output.distribution.scale, wanted.distribution.scale, rtol=1e-6)
    assert not output.losses["guess"].any()


def test_what_earns_moves_no_guess_and_the_guess_no_policy(made):
    network, params, memory = made
    seen = observed(5)

    def moved(answer):
        grads = jax.grad(lambda p: answer(network.apply(p, seen, memory)[0]))(params)["params"]
        return {name for name, tree in grads.items() if any(x.any() for x in jax.tree.leaves(tree))}

    earns = moved(lambda x: jnp.sin(x.distribution.loc).sum() + x.distribution.scale.sum())
    assert earns == {"policy", "head"}
    assert moved(lambda x: x.value.sum()) == {"value", "value_out"}
    guesses = moved(lambda x: x.losses["guess"].sum())
    assert guesses == {"Convolutions_0", "Dense_0", "Dense_1", "cell", "guess"}


def test_it_learns_where_something_is_from_its_pictures(made):
    network, _, memory = made
    params, _ = network.init(jax.random.key(2))
    optimizer = optax.adam(1e-2)

    def loss(params, seen):
        return network.apply(params, seen, jnp.zeros((256, 8)))[0].losses["guess"].mean()

    @jax.jit
    def learn(carry, key):
        params, state = carry
        value, grads = jax.value_and_grad(loss)(params, observed(256, key))
        updates, state = optimizer.update(grads, state)
        return (optax.apply_updates(params, updates), state), value

    (params, _), losses = jax.lax.scan(learn, (params, optimizer.init(params)), jnp.arange(300))
    assert losses[-1] < 0.1 * losses[0], losses[::50]


@pytest.mark.parametrize("size", [0.0, 0.1, guessing.KINK, 2.0])
def test_its_cost_is_smooth_at_the_kink(size):
    assert guessing.huber(jnp.asarray(0.0)) == 0.0
    wanted = min(size, guessing.KINK) / guessing.KINK
    assert jax.grad(guessing.huber)(size) == pytest.approx(wanted)


def test_what_no_network_can_be_made_of_is_refused():
    with pytest.raises(ValueError, match="has policy, privileged; this network needs policy, priv"):
        guessing.guess(OPTIONS, {"policy": jnp.zeros(3), "privileged": jnp.zeros(2)}, ACTIONS)
    with pytest.raises(ValueError, match="has one array; this network needs"):
        guessing.guess(OPTIONS, jnp.zeros(3), ACTIONS)
    with pytest.raises(ValueError, match="features is 0, hidden 128; a layer has at least 1 unit"):
        guessing.Options(features=0)


@pytest.mark.parametrize(
    "one", ["rodent_maze_eyes", "rodent_gaps_eyes", "rodent_gaps_reuse", "ant_gaps_reuse"]
)
def test_a_run_of_the_other_experiment_has_the_parts_that_one_takes(one):
    """1 s: shapes alone."""
    entries = ("policy", "privileged", "reference", "proprioception")
    example = {name: jnp.zeros(6) for name in entries}
    for name, part in find(one).parts.items():
        other = find(part.run)
        network = other.build_network(other.network, example, ACTIONS)
        params, _ = jax.eval_shape(network.init, jax.random.key(0))
        assert name in params["params"], (name, part.run)
