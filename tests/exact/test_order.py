"""The promise: no sum without a fixed order is left, the sums are the same, else it is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl import exact
from tests.exact import rewritten


def rough(x):
    """Scatter sums in every kind of place, with indices that meet and one that is out of range."""
    index = np.array([2, 0, 2, 2, 9, 0])
    add = lambda c: c.at[index].add(x[:6])  # noqa: E731
    rows = jnp.zeros((4, 2)).at[np.array([1, 1, 3])].add(x[:6].reshape(3, 2))
    looped = jax.lax.fori_loop(0, 3, lambda i, c: add(c) * 0.5, jnp.zeros(5))
    whiled = jax.lax.while_loop(lambda c: c.sum() < 3.0, lambda c: add(c) + 1.0, jnp.zeros(5))
    scanned, _ = jax.lax.scan(lambda c, y: (add(c) * y, None), jnp.zeros(5), x[:3])
    branch = jax.lax.cond(x[0] > 0, add, lambda c: c, jnp.ones(5))
    segments = jax.vmap(lambda y: jax.ops.segment_sum(y, index[:3], 4))(x[:6].reshape(2, 3))
    many = jnp.zeros(2).at[np.zeros(12, int)].add(jnp.tile(x[:6], 2))
    corners = jax.vmap(lambda c, i: jax.lax.dynamic_slice(c, i, (2, 2)), (None, 0))
    overlap = jax.vjp(lambda c: corners(c, np.array([[0, 1], [1, 0], [9, 9]])), jnp.ones((3, 4)))
    clipped = overlap[1](x.repeat(2)[:12].reshape(3, 2, 2))[0]
    own = jax.vmap(lambda y, i: jnp.zeros((3, 2)).at[i, 1].add(y))  # batch axes of a scatter
    batched = own(x[:6].reshape(2, 3), np.array([[0, 0, 2], [1, 2, 1]]))
    tables = jax.vmap(lambda y: own(y, np.array([[0, 0, 2], [1, 2, -1]])))(x[:6].reshape(1, 2, 3))
    return rows, looped, whiled, scanned, branch, segments, many, clipped, batched, tables


@pytest.mark.slow
@pytest.mark.parametrize("fuse", [True, False])
def test_rewritten_sums_are_the_same_sums(fuse):
    x = jax.random.uniform(jax.random.key(0), (8,))
    function = exact.rewrite(rough, fuse=fuse)
    assert len(exact.unordered_sums(rough, x)) >= 10
    assert not exact.unordered_sums(function, x)
    found = jax.jit(jax.vmap(function))(jnp.stack([x, -x]))
    for got, one, two in zip(found, rough(x), rough(-x), strict=True):
        np.testing.assert_allclose(got, jnp.stack([one, two]), rtol=1e-5)


def test_the_audit_says_what_and_where():
    def function(x):
        counts = jnp.zeros(3, jnp.int32).at[np.array([1, 1])].add(1)  # exact in any order
        apart = jnp.zeros(3).at[np.array([0, 1])].add(x, unique_indices=True)
        return jnp.zeros((4, 3)).at[np.array([1, 1])].add(x[:, None]), counts, apart

    shape = jax.ShapeDtypeStruct((2,), jnp.float32)
    (found,) = exact.unordered_sums(function, shape)
    assert found.primitive == "scatter-add" and found.shape == (4, 3)
    line = function.__code__.co_firstlineno + 3
    assert found.source == f"{__file__}:{line}"
    assert exact.unordered_in(jax.make_jaxpr(function)(shape)) == [found]


def test_a_sum_at_indices_known_only_later_is_refused():
    with pytest.raises(RuntimeError, match="test_order.py:.* known only while running"):
        rewritten(lambda i: jnp.zeros(3).at[i].add(jnp.ones(4)), jnp.arange(4))


def test_a_product_is_refused():
    with pytest.raises(RuntimeError, match="scatter-mul traced at .*test_order.py.* no sum"):
        rewritten(lambda x: x.at[np.array([0, 0])].multiply(2.0), jnp.ones(3))


def test_a_sum_inside_of_what_cannot_be_rewritten_is_refused():
    def function(x):
        matrix = lambda y: y.at[np.array([0, 0])].add(0.0) * 2.0  # noqa: E731
        return jax.lax.custom_linear_solve(matrix, x, lambda _, b: b * 0.5, symmetric=True)

    with pytest.raises(RuntimeError, match="sums without a fixed order are left.*test_order.py"):
        rewritten(function, jnp.ones(3))
