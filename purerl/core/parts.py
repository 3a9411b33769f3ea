"""The seam between the algorithm and the machine: a batch is computed in V parts.

A part has its own environments and an equal share of every minibatch. The algorithm says what is
computed of each part and what is added up over all of them. It does not know how many there are,
nor where they are computed: that is in the record `Parts`. Here is the simplest one, `WHOLE`. The
others are written where the machine is known.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from purerl.core.records import Array, PyTree


class Parts(NamedTuple):
    """How parts are computed. Every array has the part axis in front, [V, ...].

    `map(function, *trees)`: `function` of each part alone, [V, ...].
    `sum(function, *trees)`: the sum of that over all parts, [...], in a fixed order.
    `gather(tree)`: what all parts have, [V, ...], where each part's share was computed apart.
    """

    map: Callable[..., PyTree]
    sum: Callable[..., PyTree]
    gather: Callable[[PyTree], PyTree]


def add_in_order(x: Array) -> Array:
    """Returns the sum over the first axis, [V, ...] -> [...], by halves: one fixed tree."""
    # Floating-point addition is not associative. `x.sum(0)` leaves the order to the compiler; here
    # the order depends on V alone.
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = jnp.concatenate([x[:half] + x[half : 2 * half], x[2 * half :]])
    return x[0]


def _only(function: Callable, *trees: PyTree) -> PyTree:
    """Returns `function` of the only part.

    Args:
      function: takes one part's trees, [...].
      trees: leaves [1, ...].
    """
    # `squeeze` refuses an axis of another size than 1: two parts given to `WHOLE` are an error.
    return function(*jax.tree.map(lambda x: jnp.squeeze(x, 0), trees))


def as_one_part(tree: PyTree) -> PyTree:
    """Puts the part axis in front of every array: one part, [1, ...]."""
    return jax.tree.map(lambda x: x[None], tree)


WHOLE = Parts(
    map=lambda function, *trees: as_one_part(_only(function, *trees)),
    sum=_only,
    gather=lambda tree: tree,
)
