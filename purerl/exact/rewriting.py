"""`rewrite`: a function like another, whose sums have a fixed order."""

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core

from purerl.exact import fuse as optimisation, order, walk


def rewrite(f: Callable, *, platform: str | None = None, fuse: bool = True) -> Callable:
    """Returns a function with the values of `f` up to rounding, whose sums have a fixed order.

    It is traced once for each set of shapes, as by `jax.jit`, and can be called from any JAX code.
    The derivative of `rewrite(f)` has the right values, but the order of its own sums is fixed only
    in `rewrite(jax.grad(f))`. `rewrite(jax.vmap(f))` has the values of `jax.vmap(rewrite(f))`, but
    less of what `fuse` does: loops that count and linear systems stay as they are.

    Args:
      f: a pure function of pytrees of arrays. Indices of its sums have to follow from constants:
        from the arrays that it closes over, not from its arguments.
      platform: where it will run, "cpu" or "gpu"; None: JAX's default backend when it is traced.
      fuse: whether to optimise as well (`fuse.py`); the order is fixed in either case.

    Raises:
      RuntimeError: when it is traced, if the order of a sum cannot be fixed.
    """

    def in_order(closed: core.ClosedJaxpr) -> core.ClosedJaxpr:
        rules = optimisation.rules(platform or jax.default_backend()) if fuse else []
        return order.check_ordered(walk.rewrite_trace(closed, [order.RULE, *rules]))

    return jax.jit(traced_anew(f, in_order), inline=True)


def traced_anew(f: Callable, change: Callable[[core.ClosedJaxpr], core.ClosedJaxpr]) -> Callable:
    """Returns a function that traces `f` when it is called, and runs the trace that `change` gives.

    `f` is a pure function of pytrees of arrays.
    """

    @functools.wraps(f.func if isinstance(f, functools.partial) else f)
    def rewritten(*args: Any, **kwargs: Any) -> Any:
        leaves, tree = jax.tree.flatten((args, kwargs))

        def flat(*leaves: Any) -> Any:
            args, kwargs = jax.tree.unflatten(tree, leaves)
            return f(*args, **kwargs)

        closed, shapes = jax.make_jaxpr(flat, return_shape=True)(*leaves)
        results = core.jaxpr_as_fun(change(closed))(*leaves)
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return rewritten
