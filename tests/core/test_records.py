"""Counters count exactly, beyond what 32 bits hold."""

import jax.numpy as jnp
import numpy as np

from purerl.core.records import add_count, count_as_float, count_as_int, zero_count


def test_counter_is_exact_past_32_bits():
    count = zero_count()
    for _ in range(3):
        count = add_count(count, jnp.asarray(2**32 - 1, jnp.uint32))
    assert count_as_int(count) == 3 * (2**32 - 1)
    np.testing.assert_allclose(count_as_float(count), 3 * (2**32 - 1), rtol=1e-6)
