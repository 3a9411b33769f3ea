"""`python -m purerl.export RUN --format onnx`, computed by onnxruntime."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import purerl
from tests.report.test_export import NIGHTLY, PYTHON, place, trained  # noqa: F401 (a fixture)

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

from purerl.report import onnx_nodes, policy_onnx  # noqa: E402
from purerl.report.policy_file import PolicyFunction, policy_function  # noqa: E402

pytestmark = pytest.mark.slow


def computed(act, *arguments):
    """What onnxruntime makes of a function (observation, memory) -> (action, memory), [N, ...]."""
    examples = jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), arguments)
    model = policy_onnx.build_model(PolicyFunction(act, *examples), None, {})
    onnx.checker.check_model(model, full_check=True)
    session = onnxruntime.InferenceSession(model.SerializeToString())
    given = [entry.name for entry in session.get_inputs()]
    leaves = map(np.asarray, jax.tree.leaves(arguments))
    return session.run(None, dict(zip(given, leaves, strict=True)))


RARE = [pytest.param(kind, marks=NIGHTLY) for kind in ("linear", "elu", "gru")]


@pytest.mark.parametrize("kind", ["relu", "lstm", "own", *RARE])
def test_onnxruntime_acts_as_the_run_does(kind, place, tmp_path):  # noqa: F811
    run, recorded = trained(kind, place)
    file = tmp_path / "policy.onnx"
    assert recorded.difference(policy_onnx.write_onnx(run, file)) < 4e-6
    model = onnx.load(str(file))
    (opset,) = model.opset_import
    assert opset.version == onnx_nodes.OPSET
    assert {"digest": run.digest}.items() <= {p.key: p.value for p in model.metadata_props}.items()


@pytest.mark.parametrize("kind", ["relu", "lstm"])
def test_controls_and_memory_come_out_by_name(kind, place, tmp_path):  # noqa: F811
    run, _ = trained(kind, place)
    policy_onnx.write_onnx(run, tmp_path / "policy.onnx")
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    inputs = {entry.name: entry.shape for entry in session.get_inputs()}
    # What only the value function reads is not asked for.
    assert inputs == (
        {"observation_policy": ["batch", 3]}
        if kind == "relu"
        else {"observation": ["batch", 5], "memory_0": ["batch", 16], "memory_1": ["batch", 16]}
    )
    rng = np.random.default_rng(0)
    seen = {name: np.float32(rng.normal(size=(3, n))) for name, (_, n) in inputs.items()}
    made = dict(zip([x.name for x in session.get_outputs()], session.run(None, seen), strict=True))
    assert made.keys() - {"action", "control"} == {
        name.replace("memory", "next_memory") for name in inputs if "memory" in name
    }
    policy = policy_function(run)
    leaves = list(seen.values())
    arguments = jax.tree.unflatten(jax.tree.structure((policy.observation, policy.memory)), leaves)
    action, memory = policy.act(*arguments)
    np.testing.assert_allclose(made["action"], action, atol=4e-6)
    control = purerl.lookup.scale_action(run.env.physics.model, action)
    np.testing.assert_allclose(made["control"], control, atol=4e-5)
    for number, leaf in enumerate(jax.tree.leaves(memory)):
        np.testing.assert_allclose(made[f"next_memory_{number}"], leaf, atol=4e-6)


def gallery(x, memory):
    """What networks of users compute, for x [N, 6]."""
    pairs = x.reshape(-1, 2, 3)
    normed = (x - x.mean(-1, keepdims=True)) * jax.lax.rsqrt(x.var(-1, keepdims=True) + 1e-5)
    ones = jnp.ones((x.shape[0], 1))
    parts = [
        normed,
        jnp.swapaxes(pairs, 1, 2).reshape(-1, 6) @ jnp.arange(12.0).reshape(6, 2),
        pairs.max(1) - pairs.min(1),
        x[:, 1:5:2] ** 3,
        jnp.expm1(x * 3),
        jax.nn.softmax(x),
        jax.nn.gelu(x) + jax.nn.gelu(x, approximate=False) + jax.nn.softplus(x) + jax.nn.mish(x),
        jnp.where((x > 0.1) & ~(x > 1) | (x != x), jnp.square(x), jnp.sign(x)),
        jnp.clip(x, -0.5, jnp.float32(0.5)) * (x > 0),
        jnp.broadcast_to(x[:, :1], x.shape) * jnp.concatenate([ones, 2 * ones] * 3, axis=-1),
        jnp.einsum("...i,ji->...j", pairs, jnp.arange(6.0).reshape(2, 3)).reshape(-1, 4),
        ones,
    ]
    return jnp.concatenate(parts, axis=-1), jnp.logaddexp(memory, x)


@pytest.mark.parametrize("number", [1, 4])
def test_what_networks_compute_is_written(number):
    x, memory = jax.random.normal(jax.random.key(number), (2, number, 6))
    found = computed(gallery, x, memory)
    for mine, theirs in zip(found, gallery(x, memory), strict=True):
        assert mine.shape == theirs.shape
        np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-5)


def test_layers_of_flax_are_written():
    module = nn.Sequential([nn.Dense(8), nn.LayerNorm(), nn.leaky_relu, nn.Dense(8), nn.RMSNorm()])
    x = jax.random.normal(jax.random.key(1), (3, 6))
    params = module.init(jax.random.key(2), x)
    found = computed(lambda x, memory: (module.apply(params, x), memory), x, ())
    np.testing.assert_allclose(found[0], module.apply(params, x), atol=1e-5)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (jnp.sort, "computes 'sort'.*use --format jax"),
        (
            lambda x: (x[:, :, None] @ x[:, None, :]).sum(1),
            "product of matrices that is no",
        ),
        (lambda x: x.astype(jnp.bfloat16).astype(jnp.float32), "computes in bfloat16"),
    ],
)
def test_what_cannot_be_written_is_told(function, message):
    with pytest.raises(purerl.UserError, match=message):
        computed(lambda x, memory: (function(x), memory), jnp.ones((2, 3)), ())


@pytest.mark.parametrize("kind", ["relu", "lstm"])
def test_the_page_shows_how_to_run_it(kind, place, tmp_path, monkeypatch):  # noqa: F811
    run, _ = trained(kind, place)
    policy_onnx.write_onnx(run, tmp_path / "policy.onnx")
    monkeypatch.chdir(tmp_path)
    (block,) = [block for block in PYTHON if "onnxruntime" in block]
    names: dict = {}
    exec(block, names)
    policy = policy_function(run)
    examples = jax.tree.map(lambda x: jnp.zeros((1, *x.shape)), (policy.observation, policy.memory))
    action, memory = policy.act(*examples)
    np.testing.assert_allclose(names["action"], action, atol=4e-6)
    assert sorted(names["memory"]) == ["memory_0", "memory_1"][: len(jax.tree.leaves(memory))]
    for mine, theirs in zip(names["memory"].values(), jax.tree.leaves(memory), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=4e-6)
