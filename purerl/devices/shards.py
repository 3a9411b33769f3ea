"""The batch cut into V shards, so that bits do not depend on how many devices D share them.

A shard is always computed by a program of the same width: a wider one adds in another order. A
device that has v = V / D shards computes them one after another. What crosses shards is gathered,
which moves numbers and adds none, and then added in the order of the shards on every device.

With one shard, the whole batch, every function here is the plain call of its argument. With
several, arrays of a device's shards are stacked, [v, ...], and the code runs inside
`jax.shard_map` over a mesh with the axis `AXIS` if there are several devices.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from purerl.core.records import Array, PyTree
from purerl.exact import pallas_calls
from purerl.exact.traced_loops import has_loop
from purerl.ppo.config import check_divides

AXIS = "devices"


class Shards(NamedTuple):
    """How the batch is cut, and how many devices share it."""

    number: int = 1  # V
    devices: int = 1  # D

    @property
    def local(self) -> int:
        """Shards of one device, v."""
        return self.number // self.devices


WHOLE = Shards()


def check_sizes(shards: Shards, num_envs: int) -> None:
    """Raises ValueError unless the devices divide the shards, and the shards the environments."""
    if shards.number % shards.devices:
        below = shards.number - shards.number % shards.devices
        sizes = [str(size) for size in (1, below, below + shards.devices) if size]
        raise ValueError(
            f"num_shards = {shards.number} cannot be shared by {shards.devices} devices; "
            f"num_shards could be {', '.join(dict.fromkeys(sizes))} (1: a single device is used), "
            "or show fewer devices."
        )
    check_divides("num_envs", num_envs, "num_shards", shards.number)


def each(shards: Shards, function: Callable, *parts: PyTree) -> PyTree:
    """Returns `function` of each shard of this device, one after another, stacked [v, ...]."""
    if shards.number == 1:
        return function(*parts)
    # A device that has one shard computes it as one that has several, alone and not in a loop: what
    # it reads and what it makes is set apart, the arrays that `function` closes over as well.
    first = jax.tree.map(lambda x: x[0], parts)
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*first)
    loops = has_loop(closed)

    def alone(one: PyTree) -> list[Array]:
        consts, leaves = set_apart((closed.consts, jax.tree.leaves(one)))
        compute = core.jaxpr_as_fun(core.ClosedJaxpr(closed.jaxpr, consts))
        return set_apart(in_branch(compute, *leaves) if loops else compute(*leaves))

    return jax.tree.unflatten(jax.tree.structure(shapes), jax.lax.map(alone, parts))


def in_branch(compute: Callable, *leaves: Array) -> list[Array]:
    """Calls `compute` in a branch, of which XLA does not know that it is the one always taken.

    So it is compiled by itself: a loop over time (long segments' advantages, recurrent networks)
    had other bits on a GPU in one program with what follows, though set apart. There the host waits
    for the condition: two H200s trained 1.85 times as fast as one, not 1.90, with one a step.
    """
    some = next(leaf for leaf in leaves if leaf.size)
    never = some.ravel()[0].astype(jnp.float32) < -jnp.inf

    def nothing(*leaves: Array) -> list[Array]:
        shapes = jax.eval_shape(compute, *leaves)
        return [jnp.zeros(x.shape, x.dtype) for x in shapes]

    return jax.lax.cond(never, nothing, compute, *leaves)


def set_apart(tree: PyTree) -> PyTree:
    """Returns arrays as they are, by a way on which XLA neither fuses nor simplifies anything.

    What it fuses with a sum decides in which order it adds, and it drops barriers before it fuses.
    Each is a row meanwhile, since XLA chooses a table's layout for those who make and who read it.
    """
    leaves, structure = jax.tree.flatten(tree)
    rows = [jnp.ravel(leaf) for leaf in leaves if leaf.size]
    passed = iter(pallas_calls.copy(rows) if pallas_calls.can_run() else through_loop(rows))
    apart = [next(passed).reshape(leaf.shape) if leaf.size else leaf for leaf in leaves]
    return jax.tree.unflatten(structure, apart)


def through_loop(rows: list[Array]) -> list[Array]:
    """Passes arrays through a loop. XLA keeps one of two rounds; here they undo each other."""

    def flip(x: Array) -> Array:
        return -x if jnp.issubdtype(x.dtype, jnp.floating) else ~x

    return jax.lax.fori_loop(0, 2, lambda _, rows: [flip(row) for row in rows], rows)


def move(shards: Shards, function: Callable, *parts: PyTree) -> PyTree:
    """Like `each`, at once: only for functions that move numbers or count, exact at any width."""
    return function(*parts) if shards.number == 1 else jax.vmap(function)(*parts)


def total(shards: Shards, function: Callable, *parts: PyTree) -> PyTree:
    """Returns the sum over all V shards of `function` of each, the same on every device."""
    return jax.tree.map(add_in_order, from_all(shards, function, *parts))


def from_all(shards: Shards, function: Callable, *parts: PyTree) -> PyTree:
    """Returns `function` of each of all V shards, stacked [V, ...], the same on every device."""
    if shards.number == 1:
        return jax.tree.map(lambda x: x[None], function(*parts))
    return gather(shards, each(shards, function, *parts))


def gather(shards: Shards, parts: PyTree) -> PyTree:
    """Returns what all shards have [V, ...], from this device's [v, ...], a message a dtype.

    A row, as it is sent, is set apart on one device too: XLA computed a gradient's norm from slices
    of a row by other kernels than from arrays, and in 800 steps one differed.
    """
    leaves, structure = jax.tree.flatten(parts)
    gathered: list[Array] = [jnp.empty(0)] * len(leaves)
    for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):
        places = [i for i, leaf in enumerate(leaves) if leaf.dtype == dtype]
        rows = [leaves[i].reshape(shards.local, -1) for i in places]
        everyone = jnp.concatenate(rows, axis=1)
        if shards.devices > 1:
            everyone = jax.lax.all_gather(everyone, AXIS, tiled=True)
        ends = np.cumsum([row.shape[1] for row in rows])
        columns = jnp.split(set_apart(everyone), ends[:-1], axis=1)
        for i, column in zip(places, columns, strict=True):
            gathered[i] = column.reshape(shards.number, *leaves[i].shape[1:])
    return jax.tree.unflatten(structure, gathered)


def add_in_order(x: Array) -> Array:
    """Returns the sum over the first axis, [V, ...] -> [...], by halves: one fixed tree."""
    while x.shape[0] > 1:
        half = x.shape[0] // 2
        x = jnp.concatenate([x[:half] + x[half : 2 * half], x[2 * half :]])
    return x[0]


def numbers(shards: Shards) -> Array:
    """Returns the numbers of this device's shards among all, [v] int32."""
    first = jax.lax.axis_index(AXIS) * shards.local if shards.devices > 1 else 0
    return jnp.arange(shards.local) + first
