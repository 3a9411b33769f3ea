"""The batch cut into V shards, so that bits do not depend on how many devices D share them.

A shard is always computed by a program of the same width, because a wider one adds in another
order. A device with v = V / D shards computes them one after another. What the shards have is
gathered, which moves numbers and adds none. Then every device adds it up in the order of shards.

`parts_of` makes of this the record `Parts`, through which the algorithm calls it. Arrays of a
device's shards are stacked, [v, ...]. The code runs inside `jax.shard_map` over a mesh with the
axis `AXIS` if there are several devices.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from purerl.core.parts import WHOLE, Parts, add_in_order
from purerl.core.records import Array, Metrics, Network, PyTree, TrainState
from purerl.devices import copies
from purerl.devices.slices import SIDE_BY_SIDE, count_slices, cut_in_slices
from purerl.exact import traces
from purerl.ppo import algorithm, learner
from purerl.ppo.algorithm import Experience
from purerl.ppo.config import Config

AXIS = "devices"


class Shards(NamedTuple):
    """How the batch is cut, and how many devices share it."""

    number: int = 1  # V
    devices: int = 1  # D

    @property
    def local(self) -> int:
        """Shards of one device, v."""
        return self.number // self.devices


def parts_of(shards: Shards, slices: int = 1) -> Parts:
    """Returns how the algorithm computes its parts: shards, each cut into `slices`.

    All arrays of parts are [v * slices, ...]; slices are computed side by side (`slices.py`).
    """
    inner = SIDE_BY_SIDE if slices > 1 else WHOLE
    if shards.number == 1:
        return inner

    def cut(trees: PyTree) -> PyTree:
        return jax.tree.map(lambda x: x.reshape(-1, slices, *x.shape[1:]), trees)

    def map_parts(function: Callable, *trees: PyTree) -> PyTree:
        found = each(functools.partial(inner.map, function), *cut(trees))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), found)

    def sum_parts(function: Callable, *trees: PyTree) -> PyTree:
        found = each(functools.partial(inner.sum, function), *cut(trees))
        return jax.tree.map(add_in_order, gather(shards, found))

    return Parts(map=map_parts, sum=sum_parts, gather=functools.partial(gather, shards))


def each(function: Callable, *parts: PyTree) -> PyTree:
    """Returns `function` of each shard of this device, one after another, stacked [v, ...]."""
    # A device with one shard must compute it as a device with several does. So everything that
    # `function` reads and makes is set apart, also the arrays that it closes over.
    first = jax.tree.map(lambda x: x[0], parts)
    closed, shapes = jax.make_jaxpr(function, return_shape=True)(*first)
    loops = traces.has_loop(closed)

    def alone(one: PyTree) -> list[Array]:
        consts, leaves = set_apart((closed.consts, jax.tree.leaves(one)))
        compute = core.jaxpr_as_fun(core.ClosedJaxpr(closed.jaxpr, consts))
        return set_apart(in_branch(compute, *leaves) if loops else compute(*leaves))

    return jax.tree.unflatten(jax.tree.structure(shapes), jax.lax.map(alone, parts))


def in_branch(compute: Callable, *leaves: Array) -> list[Array]:
    """Calls `compute` in a branch that is always taken; XLA does not know that it is.

    So XLA compiles it by itself. A loop over time (advantages of long rollouts, recurrent networks)
    had other bits on a GPU when it was one program with the code after it, though set apart. A
    branch makes the host wait: two H200s trained 1.85 instead of 1.90 times as fast as one.
    """
    some = next(leaf for leaf in leaves if leaf.size)
    never = some.ravel()[0].astype(jnp.float32) < -jnp.inf

    def nothing(*leaves: Array) -> list[Array]:
        return [jnp.zeros(x.shape, x.dtype) for x in jax.eval_shape(compute, *leaves)]

    return jax.lax.cond(never, nothing, compute, *leaves)


def set_apart(tree: PyTree) -> PyTree:
    """Returns arrays unchanged, and keeps XLA from fusing the code before and after them.

    The order of a sum depends on the code that XLA fuses with it, and XLA drops its own barriers
    before it fuses. Each array travels as a row: of a table, XLA would choose the layout by the
    code around it.
    """
    leaves, structure = jax.tree.flatten(tree)
    rows = [jnp.ravel(leaf) for leaf in leaves if leaf.size]
    passed = iter(copies.copy(rows) if copies.can_run() else through_loop(rows))
    apart = [next(passed).reshape(leaf.shape) if leaf.size else leaf for leaf in leaves]
    return jax.tree.unflatten(structure, apart)


def through_loop(rows: list[Array]) -> list[Array]:
    """Passes arrays through a loop of two rounds, of which the second undoes the first."""

    def flip(x: Array) -> Array:
        return -x if jnp.issubdtype(x.dtype, jnp.floating) else ~x

    return jax.lax.fori_loop(0, 2, lambda _, rows: [flip(row) for row in rows], rows)


def gather(shards: Shards, parts: PyTree) -> PyTree:
    """Returns what all devices have, [D * p, ...], from this one's [p, ...]: a message a dtype.

    The row that is sent is set apart on one device too. Else XLA computed a gradient's norm from
    pieces of the row by other kernels than from arrays: one of 800 steps differed.
    """
    leaves, structure = jax.tree.flatten(parts)
    gathered: list[Array] = [jnp.empty(0)] * len(leaves)
    for dtype in dict.fromkeys(leaf.dtype for leaf in leaves):
        places = [i for i, leaf in enumerate(leaves) if leaf.dtype == dtype]
        rows = [leaves[i].reshape(len(leaves[i]), -1) for i in places]
        everyone = jnp.concatenate(rows, axis=1)
        if shards.devices > 1:
            everyone = jax.lax.all_gather(everyone, AXIS, tiled=True)
        ends = np.cumsum([row.shape[1] for row in rows])
        columns = jnp.split(set_apart(everyone), ends[:-1], axis=1)
        for i, column in zip(places, columns, strict=True):
            gathered[i] = column.reshape(-1, *leaves[i].shape[1:])
    return jax.tree.unflatten(structure, gathered)


def improve(
    config: Config, network: Network, shards: Shards, state: TrainState, experience: Experience
) -> tuple[TrainState, Metrics]:
    """Learns from all shards, which on a GPU are cut into slices; as `algorithm.improve`."""
    recurrent, size = learner.is_recurrent(experience.memory), config.num_envs // shards.number
    number = count_slices(config, size, recurrent, jax.default_backend())
    parts = parts_of(shards, number)
    return algorithm.improve(config, network, state, cut_in_slices(number, experience), parts)
