"""A key depends on what it is for, and on nothing else."""

import jax
import jax.numpy as jnp
import numpy as np

from purerl.core.keys import Purpose, derive, per_environment


def numbers(key):
    return np.asarray(jax.random.key_data(key))


def test_purposes_and_indices_have_keys_of_their_own():
    seed = jax.random.key(3)
    uses = [derive(seed, p, *more) for p in Purpose for more in ((), (0,), (1,), (0, 1), (1, 0))]
    assert len({numbers(key).tobytes() for key in uses}) == len(uses)


def test_the_numbers_of_purposes_are_part_of_every_run():
    """A run that was made before would draw others: append, and never renumber."""
    first = "PARAMETERS FIRST_RESET FIRST_LIMIT RESET ACTION PERMUTATION EVALUATION VIDEO"
    assert [p.name for p in Purpose][:8] == first.split()
    assert [int(p) for p in Purpose] == list(range(len(Purpose)))


def test_an_environment_has_the_same_key_whoever_is_computed_beside_it():
    key = derive(jax.random.key(0), Purpose.RESET, 5)
    together = numbers(per_environment(key, jnp.arange(6)))
    np.testing.assert_array_equal(
        numbers(per_environment(key, jnp.array([4, 1]))), together[[4, 1]]
    )
