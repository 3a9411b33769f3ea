"""Scatters with known indices, computed by gathers: so the sums of a scatter-add have an order."""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend import core

from purerl.exact.constants import Known
from purerl.exact.traces import source

_FEW_TERMS = 4


def ordered_scatter(eqn: core.JaxprEqn, inputs: list, known: list[Known]) -> Array:
    """Computes a scatter-add by gathers, which are added in the order of the updates.

    Raises:
      RuntimeError: the primitive is not a scatter-add, or its indices are not known.
    """
    operand, _, updates = inputs
    if known[1] is None or "add" not in eqn.primitive.name:
        why = "its indices are known only while running" if known[1] is None else "it is no sum"
        raise RuntimeError(
            f"A {eqn.primitive.name} traced at {source(eqn)} cannot be given a fixed order: {why}. "
            "Compute the indices of a sum from constants; of MJX, change the model or ask for "
            "fewer readings, so that it is not needed."
        )
    addresses = _addresses(eqn, np.asarray(known[1]()))
    touched, turns = _order_of_sums(addresses, updates.size)
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
    return jnp.reshape(_take(jnp.concatenate([whole, total]), place), operand.shape)


def puts(eqn: core.JaxprEqn) -> bool:
    """Tells whether an equation is a scatter that puts updates in their places, as `.set` does.

    `.apply` has the same primitive, and computes a function of the values that stand there.
    """
    return eqn.primitive.name == "scatter" and eqn.params["update_jaxpr"] is None


def gathered_scatter(eqn: core.JaxprEqn, inputs: list, known: list[Known]) -> Array:
    """Computes a scatter that `puts`, with known indices, by one gather.

    XLA has two kernels for a scatter, one of them a copy, and neither is fused with others. It
    leaves open which of several updates at one place is kept; here it is the last.
    """
    operand, _, updates = inputs
    addresses = _addresses(eqn, np.asarray(known[1]()))
    kept = np.flatnonzero(addresses >= 0)
    if not kept.size:
        return operand
    place = np.full(operand.size, -1)
    place[addresses[kept]] = kept
    put = jnp.reshape(_take(jnp.reshape(updates, (-1,)), np.maximum(place, 0)), operand.shape)
    return jnp.where(np.reshape(place >= 0, operand.shape), put, operand)


def _take(flat: Array, index: np.ndarray) -> Array:
    """`flat[index]` of constant indices within bounds, as one operation."""
    first = index.flat[0] if index.size else 0
    if index.ndim == 1 and (index == first + np.arange(index.size)).all():
        return lax.slice(flat, (first,), (first + index.size,))
    numbers = lax.GatherDimensionNumbers((), (0,), (0,))
    index = index.astype(np.int32)[..., None]
    return lax.gather(flat, index, numbers, (1,), mode=lax.GatherScatterMode.PROMISE_IN_BOUNDS)


def _addresses(eqn: core.JaxprEqn, indices: np.ndarray) -> np.ndarray:
    """Returns for each update the flat address it is added to; -1 if it is dropped.

    This is XLA's definition of a scatter: each index vector says where a window of updates starts.
    A window that does not fit is dropped whole or, in mode CLIP, moved until it fits.
    """
    shape, updates = eqn.invars[0].aval.shape, eqn.invars[2].aval
    d = eqn.params["dimension_numbers"]
    batch_axes = [i for i in range(len(updates.shape)) if i not in d.update_window_dims]
    batch = tuple(updates.shape[i] for i in batch_axes)
    absent = (*d.inserted_window_dims, *d.operand_batching_dims)
    axis_of = dict(
        zip([i for i in range(len(shape)) if i not in absent], d.update_window_dims, strict=True)
    )
    starts = np.zeros((len(shape), *batch), np.int64)
    for column, dim in enumerate(d.scatter_dims_to_operand_dims):
        starts[dim] = indices[..., column]
    for dim, axis in zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True):
        starts[dim] = np.indices(batch)[axis]
    sizes = [updates.shape[axis_of[i]] if i in axis_of else 1 for i in range(len(shape))]
    room = (np.array(shape) - sizes).reshape(-1, *[1] * len(batch)).astype(np.int64)
    if eqn.params["mode"] == lax.GatherScatterMode.CLIP:
        starts = np.clip(starts, 0, room)
    fits = ((starts >= 0) & (starts <= room)).all(0)
    address = np.zeros(updates.shape, np.int64)
    steps = np.cumprod([1, *shape[:0:-1]])[::-1] if shape else []
    spread = tuple(i for i in range(len(updates.shape)) if i not in batch_axes)
    for dim, step in enumerate(steps):
        address += step * np.expand_dims(starts[dim], spread)
        if dim in axis_of:
            along = [1] * len(updates.shape)
            along[axis_of[dim]] = sizes[dim]
            address += step * np.arange(sizes[dim]).reshape(along)
    return np.where(np.expand_dims(fits, spread), address, -1).reshape(-1)


def _order_of_sums(address: np.ndarray, none: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts updates by the address that they are added to.

    Args:
      address: [updates]; -1 where an update is dropped.
      none: the number that stands for no update.

    Returns:
      The addresses that receive an update, [touched], ascending; and for each the number of its
      k-th update, [turns, touched].
    """
    kept = np.flatnonzero(address >= 0)
    order = kept[np.argsort(address[kept], kind="stable")]
    touched, start, count = np.unique(address[order], return_index=True, return_counts=True)
    turns = np.full((count.max(initial=0), len(touched)), none)
    turn = np.arange(len(order)) - np.repeat(start, count)
    turns[turn, np.repeat(np.arange(len(touched)), count)] = order
    return touched, turns
