"""The promise: every sum of a trace has a fixed order.

On a GPU a scatter-add is atomic: terms that meet at one address are added in the order in which
they arrive, so two runs differ in their last bits. The rule here replaces each scatter-add whose
indices follow from constants (`scatters.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend import core

from purerl.exact import scatters, walk
from purerl.exact.traces import equations, source

_SUMS = ("scatter-add", "scatter_add", "scatter-mul", "scatter_mul", "scatter-sub", "scatter_sub")


class ScatterSum(NamedTuple):
    """One scatter primitive whose result may depend on the order of its sums."""

    primitive: str
    shape: tuple[int, ...]  # of the operand
    source: str  # file and line that traced it


def unordered_sums(f: Callable, *example: Any) -> list[ScatterSum]:
    """Lists the sums of a function whose order nothing fixes on a GPU.

    Args:
      f: a pure function of pytrees of arrays.
      *example: its arguments, or `jax.ShapeDtypeStruct`s of the same shapes. Nothing is computed.

    Returns:
      The sums at any depth, in the order in which they are traced.
    """
    return unordered_in(jax.make_jaxpr(f)(*example))


def unordered_in(closed: core.ClosedJaxpr) -> list[ScatterSum]:
    """Lists the sums of a trace whose order nothing fixes on a GPU, at any depth."""
    found = filter(_is_unordered, equations(closed))
    return [ScatterSum(e.primitive.name, e.invars[0].aval.shape, source(e)) for e in found]


def _is_unordered(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation adds or multiplies numbers in an order that nothing fixes.

    Sums of integers are exact in any order, and `unique_indices` promises that no terms meet.
    """
    sums = eqn.primitive.name in _SUMS and not eqn.params["unique_indices"]
    return sums and jnp.issubdtype(eqn.invars[0].aval.dtype, jnp.inexact)


RULE = walk.Rule(_is_unordered, scatters.ordered_scatter)


def check_ordered(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
    """Returns the trace; raises RuntimeError if it has a sum without a fixed order."""
    left = unordered_in(closed)
    if left:
        raise RuntimeError(
            f"{len(left)} sums without a fixed order are left after rewriting, the first is "
            f"{left[0]}: they stand inside an operation that purerl.exact cannot rewrite. Use the "
            "versions in the constraints file, or move the sum out of that operation."
        )
    return closed
