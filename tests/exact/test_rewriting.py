"""`exact.rewrite`: a function like the one it is given, wherever JAX takes a function."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from purerl import exact
from tests import quick
from tests.exact import named

INDEX = np.array([0, 2, 2, 1, 0])


def table(x, *, scale=1.0):
    """Takes and returns pytrees, and adds where indices meet."""
    rows = jnp.zeros(3).at[INDEX].add(x["a"] * x["b"])
    return {"rows": scale * rows, "whole": (x["a"].sum(), x["n"] + 1)}


def values(seed=0):
    a, b = np.random.default_rng(seed).normal(size=(2, 5)).astype(np.float32)
    return {"a": jnp.asarray(a), "b": jnp.asarray(b), "n": jnp.int32(3)}


def assert_close(found, wanted, tolerance=1e-5):
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert jnp.result_type(x) == jnp.result_type(y)
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def test_it_is_called_as_the_function_is():
    x, function = values(), exact.rewrite(table)
    assert function.__name__ == "table"
    assert_close(function(x), table(x))
    assert_close(function(x, scale=2.0), table(x, scale=2.0))
    assert_close(jax.jit(function)(x), table(x))
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), x, values(1))
    assert_close(jax.vmap(function)(both), jax.vmap(table)(both))
    assert_close(jax.lax.map(function, both), jax.lax.map(table, both))


def test_it_is_traced_once_for_each_set_of_shapes():
    traced = []

    def function(x):
        traced.append(x.shape)
        return x.at[np.array([0, 0])].add(1.0)

    rewritten = exact.rewrite(function)
    for x in (jnp.ones(3), jnp.zeros(3), jnp.ones(4)):
        rewritten(x)
        jax.jit(lambda y: rewritten(y) * 2.0)(x)
        jax.vmap(rewritten)(jnp.stack([x, x]))
    assert traced == [(3,), (4,)]


def test_the_platform_is_the_default_backends_unless_one_is_given(monkeypatch):
    function = lambda x: x.at[np.array([1])].set(7.0)  # noqa: E731
    for backend, platform, left in (("cpu", None, 1), ("cpu", "gpu", 0), ("gpu", "cpu", 1)):
        monkeypatch.setattr(jax, "default_backend", lambda name=backend: name)
        closed = jax.make_jaxpr(exact.rewrite(function, platform=platform))(jnp.ones(3))
        assert len(named(closed, "scatter")) == left
    assert not named(jax.make_jaxpr(exact.rewrite(function))(jnp.ones(3)), "scatter")  # on a GPU


def test_the_package_starts_no_jax_and_names_what_it_has():
    lines = ["import sys", "from purerl import exact", "exact.set_xla_flags()"]
    lines += ["assert not {'jax', 'numpy'} & set(sys.modules)", "print(callable(exact.rewrite))"]
    lines += ["import purerl.exact.rewriting, purerl.exact.fuse", "print(callable(exact.rewrite))"]
    found = subprocess.run([sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True)
    assert found.stdout.split() == ["True", "True"], found.stderr
    told = "no name 'rewrit': write `from purerl.exact import rewrite`"
    with pytest.raises(AttributeError, match=told):
        exact.rewrit  # noqa: B018
    assert all(getattr(exact, name) for name in exact.__all__)


# --- derivatives ---


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_derivatives_are_those_of_the_function(derivative):
    def loss(a):
        x = table(values() | {"a": a})
        return (x["rows"] ** 3).sum() + jnp.sin(x["whole"][0])

    a = values()["a"]
    for ours in (exact.rewrite(loss), exact.rewrite(loss, fuse=False)):
        assert_close(derivative(ours)(a), derivative(loss)(a))


def test_a_derivative_has_ordered_sums_where_it_is_rewritten_itself():
    x = values()["a"]
    take = lambda x: (x[INDEX] ** 2).sum()  # whose derivative adds at the indices # noqa: E731
    for function in (take, exact.rewrite(take)):
        assert exact.unordered_sums(jax.grad(function), x)
        ordered = exact.rewrite(jax.grad(function))
        assert not exact.unordered_sums(ordered, x)
        assert_close(ordered(x), jax.grad(take)(x))


def test_indices_that_a_derivative_keeps_from_its_first_half_are_known():
    inner = jax.jit(lambda x: jnp.sin(x)[jnp.asarray(INDEX) % 3].prod())
    x = values()["a"]
    ordered = exact.rewrite(jax.grad(inner))
    assert not exact.unordered_sums(ordered, x)
    assert_close(ordered(x), jax.grad(inner)(x))


def own_derivative(kind):
    """Adds where indices meet, with a derivative that is another's on purpose."""
    function = kind(lambda x: jnp.zeros(3).at[INDEX].add(x))
    if kind is jax.custom_jvp:
        function.defjvp(lambda x, t: (function(*x), 7.0 * jnp.ones(3) * t[0][0]))
    else:
        function.defvjp(lambda x: (function(x), None), lambda _, g: (7.0 * g.sum() * jnp.ones(5),))
    return lambda x: function(x).sum()


@pytest.mark.parametrize("kind", [jax.custom_jvp, jax.custom_vjp])
def test_a_derivative_of_the_users_own_is_kept(kind):
    x = values()["a"]
    plain = own_derivative(kind)
    ours = exact.rewrite(plain)
    assert not exact.unordered_sums(ours, x)
    assert_close(ours(x), plain(x))
    assert_close(jax.jit(jax.grad(ours))(x), jax.grad(plain)(x))


# Two links, the second held by its limit: Newton's method makes several iterations.
ARM = """
<mujoco>
  <option timestep="0.005" iterations="3" ls_iterations="4"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0 0" contype="0"/>
      <body pos="0.3 0 0">
        <joint axis="0 1 0" limited="true" range="-10 10"/>
        <geom size="0.1" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder"/></actuator>
</mujoco>
"""


@pytest.mark.slow
def test_a_gradient_through_mjx_is_that_of_finite_differences():
    """In reverse mode MJX itself refuses more than one iteration of its solver."""
    model = mujoco.MjModel.from_xml_string(ARM)
    on_device = mjx.put_model(model, impl="jax")
    data = mjx.make_data(model, impl="jax").replace(qpos=jnp.array([0.2, 0.25]))

    def loss(step, ctrl):
        return (step(on_device, data.replace(ctrl=ctrl)).qvel ** 2).sum()

    plain, ctrl = functools.partial(loss, mjx.step), jnp.array([0.7])
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.eval_shape(jax.grad(plain), ctrl)
    ordered = exact.rewrite(jax.value_and_grad(functools.partial(loss, exact.rewrite(mjx.step))))
    value, gradient = quick.jit(ordered)(ctrl)
    compiled = quick.jit(plain)
    np.testing.assert_allclose(value, compiled(ctrl), rtol=1e-5)
    difference = (compiled(ctrl + 0.05) - compiled(ctrl - 0.05)) / 0.1
    np.testing.assert_allclose(gradient[0], difference, rtol=2e-3)
    assert not exact.unordered_sums(ordered, ctrl)


def test_sums_inside_what_is_computed_again_for_its_derivative_have_an_order():
    twice = np.array([0, 0])

    def added(x):
        return jax.checkpoint(lambda y: y.at[twice].add(1.0))(x)

    def slope(x):
        return jax.grad(lambda x: jax.checkpoint(lambda y: y[twice].prod())(x))(x)

    for function, want in ((added, [3.0, 1.0, 1.0]), (slope, [2.0, 0.0, 0.0])):
        rewritten = exact.rewrite(function, platform="cuda")
        np.testing.assert_array_equal(rewritten(jnp.ones(3)), want)
