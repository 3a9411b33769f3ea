"""One part is the plain call, and sums over parts have one order."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from purerl.core.parts import WHOLE, add_in_order, as_one_part


def test_parts_add_in_one_order_whatever_their_number():
    x = jax.random.normal(jax.random.key(0), (7, 3)) * 10.0 ** jnp.arange(7)[:, None]
    a, b, c, d, e, f, g = np.asarray(x)
    expected = ((a + d) + (c + f)) + ((b + e) + g)
    np.testing.assert_allclose(add_in_order(x), expected, rtol=1e-6)
    assert add_in_order(jnp.array([1e8, 1.0, -1e8, 1.0])) == 2.0  # (a + c) + (b + d)


def test_one_part_is_the_plain_call():
    tree = as_one_part({"x": jnp.arange(3.0)})
    assert WHOLE.map(lambda t: t["x"].sum(), tree).tolist() == [3.0]
    assert WHOLE.sum(lambda t: t["x"].sum(), tree) == 3.0
    with pytest.raises(ValueError):
        WHOLE.map(lambda x: x, jnp.zeros((2, 3)))  # two parts are not one
