"""Scatters with known indices, computed by gathers: so the sums of a scatter-add have an order."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from purerl.exact.constants import is_known
from purerl.exact.traces import source
from purerl.exact.walk import Inside

_FEW_TERMS = 4


def ordered_scatter(eqn: core.JaxprEqn, inputs: Sequence, inside: Inside) -> list[Array]:
    """Computes a scatter-add by gathers, which are added in the order of the updates.

    Raises RuntimeError if it is another primitive, or if its indices are not known.
    """
    operand, indices, updates = inputs
    if not is_known(indices) or "add" not in eqn.primitive.name:
        why = "it is no sum" if is_known(indices) else "its indices are known only while running"
        raise RuntimeError(
            f"A {eqn.primitive.name} traced at {source(eqn)} cannot be given a fixed order: {why}. "
            "Compute the indices of a sum from constants; of MJX, change the model or ask for "
            "fewer readings, so that it is not needed."
        )
    touched, turns = order_of_sums(addresses(eqn, indices), updates.size)
    whole, flat = jnp.reshape(operand, (-1,)), jnp.reshape(updates, (-1,))
    if (turns == updates.size).any():
        flat = jnp.concatenate([flat, jnp.zeros(1, flat.dtype)])
    total = _take(whole, touched)
    if len(turns) <= _FEW_TERMS:
        for turn in turns:
            total = total + _take(flat, turn)
    else:
        # One gather and one reduction: a long chain of sums takes XLA minutes to compile.
        total = total + jnp.sum(_take(flat, turns), axis=0)
    place = np.arange(operand.size)
    place[touched] = operand.size + np.arange(len(touched))
    return [jnp.reshape(_take(jnp.concatenate([whole, total]), place), operand.shape)]


def puts(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation is a scatter that puts updates in their places, as `.set` does.

    `.apply` has the same primitive, and computes a function of the values that stand there.
    """
    return eqn.primitive.name == "scatter" and eqn.params["update_jaxpr"] is None


def gathered_scatter(eqn: core.JaxprEqn, inputs: Sequence, inside: Inside) -> list | None:
    """Computes a scatter that `puts` by one gather; None if its indices are not known.

    XLA has two kernels for a scatter, one of them a copy, and neither is fused with others. It
    leaves open which of several updates at one place is kept; here it is the last.
    """
    operand, indices, updates = inputs
    if not is_known(indices):
        return None
    found = addresses(eqn, indices)
    kept = np.flatnonzero(found >= 0)
    if not kept.size:
        return [operand]
    place = np.full(operand.size, -1)
    place[found[kept]] = kept
    put = jnp.reshape(_take(jnp.reshape(updates, (-1,)), np.maximum(place, 0)), operand.shape)
    return [jnp.where(np.reshape(place >= 0, operand.shape), put, operand)]


def _take(flat: Array, index: np.ndarray) -> Array:
    """`flat[index]` of constant indices within bounds, as one operation."""
    first = index.flat[0] if index.size else 0
    if index.ndim == 1 and (index == first + np.arange(index.size)).all():
        return lax.slice(flat, (first,), (first + index.size,))
    numbers = lax.GatherDimensionNumbers((), (0,), (0,))
    index = index.astype(np.int32)[..., None]
    return lax.gather(flat, index, numbers, (1,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def addresses(eqn: core.JaxprEqn, indices: np.ndarray) -> np.ndarray:
    """Returns for each update the flat address it is added to; below 0 if it is dropped.

    This is XLA's definition of a scatter: each index vector says where a window of updates starts.
    A window that does not fit is dropped whole or, in mode CLIP, moved until it fits.
    """
    shape, updates = eqn.invars[0].aval.shape, eqn.invars[2].aval.shape
    d, indices = eqn.params["dimension_numbers"], np.asarray(indices)
    absent = (*d.inserted_window_dims, *d.operand_batching_dims)
    window = [updates[axis] for axis in d.update_window_dims]
    sizes = np.ones(len(shape), np.int64)
    sizes[[i for i in range(len(shape)) if i not in absent]] = window
    batch = indices.shape[:-1]
    starts = np.zeros((*batch, len(shape)), np.int64)
    starts[..., list(d.scatter_dims_to_operand_dims)] = indices
    for dim, axis in zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True):
        starts[..., dim] = np.indices(batch)[axis]
    room = np.array(shape, np.int64) - sizes
    if eqn.params["mode"] == lax.GatherScatterMode.CLIP:
        starts = np.clip(starts, 0, room)
    fits = ((starts >= 0) & (starts <= room)).all(axis=-1)
    steps = np.array([np.prod(shape[i + 1 :], dtype=np.int64) for i in range(len(shape))], np.int64)
    first = np.where(fits, starts @ steps, -np.prod(shape, dtype=np.int64))
    inside = np.tensordot(steps, np.indices(tuple(sizes)), 1).reshape(window)
    address = np.add.outer(first, inside)
    window_axes = range(len(batch), address.ndim)
    return np.moveaxis(address, window_axes, d.update_window_dims).reshape(-1)


def order_of_sums(address: np.ndarray, none: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts updates by the address [updates] that they are added to; `none` stands for no update.

    Returns the addresses that receive an update, [touched], ascending; and for each the number of
    its k-th update, [turns, touched].
    """
    kept = np.flatnonzero(address >= 0)
    order = kept[np.argsort(address[kept], kind="stable")]
    touched, start, column, count = np.unique(address[order], True, True, True)
    turns = np.full((count.max(initial=0), len(touched)), none)
    turns[np.arange(len(order)) - start[column], column] = order
    return touched, turns
