"""Training on several devices: V shards of the environments, shared by D devices.

Two programs make an update. `collect` acts in one shard: a program of one device, the same on
each, called once for each shard. (A partitioned program's physics has other bits than that of an
unpartitioned one; measured: MJX with contacts.) `improve` learns, on all devices together.
Initialisation and evaluation are programs of one device too.
"""

import functools
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from purerl import exact
from purerl.core.env import Env
from purerl.core.records import Array, Metrics, Network, PyTree, TrainState
from purerl.devices.compilation import Compiling, compiled, portable, shapes, start, unordered
from purerl.devices.shards import AXIS, Shards, improve
from purerl.ppo import algorithm
from purerl.ppo.config import Config

# Fields of TrainState that are [B, ...].
PLACES = ("env_ids", "env_state", "memory", "episode", "discounted_return")
SAME = PartitionSpec()  # a copy on every device
SPLIT = PartitionSpec(AXIS)


class Spread(NamedTuple):
    """A TrainState on its devices; environments by shard, of this process's devices only."""

    learned: TrainState  # without PLACES; a copy on every device
    places: tuple[dict[str, PyTree], ...]  # of each shard, on its device

    @property
    def params(self) -> PyTree:
        """The parameters."""
        return self.learned.params

    @property
    def steps(self) -> PyTree:
        """Control steps taken."""
        return self.learned.steps


class Layout(NamedTuple):
    """Which device computes which shards."""

    shards: Shards
    size: int  # environments in a shard
    mesh: Mesh

    @property
    def here(self) -> list[tuple[Any, range]]:
        """This process's devices, each with the numbers of its shards."""
        local = self.shards.local
        return [
            (device, range(i * local, (i + 1) * local))
            for i, device in enumerate(self.mesh.devices)
            if device.process_index == jax.process_index()
        ]


# --- arrays ---


def on(device: Any, tree: PyTree) -> PyTree:
    """Returns the part of arrays of all devices that is on `device`, without a copy."""

    def one(x: Array) -> Array:
        return next(s.data for s in x.addressable_shards if s.device == device)

    return jax.tree.map(one, tree)


def assemble(layout: Layout, spec: PartitionSpec, trees: Sequence[PyTree]) -> PyTree:
    """Makes arrays of all devices out of those of each device here, without a copy."""
    sharding = NamedSharding(layout.mesh, spec)

    def one(*parts: Array) -> Array:
        shape = parts[0].shape
        if spec == SPLIT:
            shape = (shape[0] * layout.shards.devices, *shape[1:])
        return jax.make_array_from_single_device_arrays(shape, sharding, list(parts))

    return jax.tree.map(one, *trees)


@jax.jit
def join(trees: Sequence[PyTree]) -> PyTree:
    """Concatenates trees of one device along the first axis."""
    return trees[0] if len(trees) == 1 else jax.tree.map(lambda *x: jnp.concatenate(x), *trees)


@functools.partial(jax.jit, static_argnums=2)
def cut(places: PyTree, first: Array, size: int) -> PyTree:
    """Returns the environments from number `first` on."""
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, size), places)


@functools.cache
def gather_all(mesh: Mesh) -> Callable[[PyTree], PyTree]:
    """Returns a program that copies what is spread to every device."""
    return jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, SAME))


def spread(layout: Layout, state: TrainState) -> Spread:
    """Lays a state of one device, or of the host, out over the devices."""
    places = {name: getattr(state, name) for name in PLACES}
    learned = state.replace(**dict.fromkeys(PLACES))
    size, parts = layout.size, []
    for device, numbers in layout.here:
        for i in numbers:
            parts.append(jax.device_put(cut(places, np.int32(i * size), size), device))
    copies = [jax.device_put(learned, device) for device, _ in layout.here]
    return Spread(assemble(layout, SAME, copies), tuple(parts))


def fetch(layout: Layout, state: Spread) -> TrainState:
    """Returns the whole state on one device; all processes take part, and all get it."""
    local = layout.shards.local
    groups = [state.places[i : i + local] for i in range(0, len(state.places), local)]
    places = assemble(layout, SPLIT, [join(group) for group in groups])
    device = layout.here[0][0]
    everywhere = gather_all(layout.mesh)(places)
    return on(device, state.learned).replace(**on(device, everywhere))


# --- programs ---


def collect(
    config: Config, env: Env, network: Network, learned: TrainState, places: dict[str, PyTree]
) -> tuple[dict[str, PyTree], algorithm.Experience]:
    """Moves one shard on; returns its places and, as one part [1, ...], what it saw."""
    state, experience = algorithm.collect(config, env, network, learned.replace(**places))
    return {name: getattr(state, name) for name in PLACES}, experience


def update(
    layout: Layout,
    collects: Sequence[Callable],
    improve: Callable,
    told_by: ThreadPoolExecutor,
    state: Spread,
) -> tuple[Spread, Metrics]:
    """Makes one update. A thread of its own tells each device what to do.

    On a GPU, a program with a loop that the host steers returns only when it is done. So devices
    that are told one after another work one after another (measured: four H200s as fast as one).
    """
    local = layout.shards.local
    # Taken apart in this thread: several at a time now and then found an array without its parts.
    learned = [on(device, state.learned) for device, _ in layout.here]

    def act(i: int) -> tuple[list[dict[str, PyTree]], PyTree]:
        mine = state.places[i * local : (i + 1) * local]
        pairs = [collects[i](learned[i], places) for places in mine]
        return [places for places, _ in pairs], join([seen for _, seen in pairs])

    places, experience = zip(*told_by.map(act, range(len(collects))), strict=True)
    improved, metrics = improve(state.learned, assemble(layout, SPLIT, experience))
    return Spread(improved, tuple(one for some in places for one in some)), metrics


def compile_update(
    shards: Shards, config: Config, env: Env, network: Network, abstract: TrainState
) -> Compiling:
    """Compiles an update of several shards, from the `abstract` shapes of the whole state."""
    begin, devices = time.perf_counter(), np.array(jax.devices()[: shards.devices])
    mesh = Mesh(devices, (AXIS,), axis_types=(AxisType.Auto,))
    layout = Layout(shards, config.num_envs // shards.number, mesh)
    learned = abstract.replace(**dict.fromkeys(PLACES))
    collects, experience, sums = compile_collects(layout, config, env, network, abstract)
    improving = jax.jit(
        jax.shard_map(
            portable(functools.partial(improve, config, network, shards)),
            mesh=mesh, in_specs=(SAME, SPLIT), out_specs=SAME, check_vma=False,
        ),
        compiler_options=exact.equal_passes(),
    )  # fmt: skip
    whole = resized(experience, shards.number)
    traced = improving.trace(
        shapes(learned, NamedSharding(mesh, SAME)), shapes(whole, NamedSharding(mesh, SPLIT))
    )
    started = start("update", traced)

    def finish() -> tuple[Callable[[Spread], tuple[Spread, Metrics]], dict[str, float]]:
        compiled, _ = started.result()
        seconds = {"update": time.perf_counter() - begin}
        workers = ThreadPoolExecutor(len(collects))
        return functools.partial(update, layout, collects, compiled, workers), seconds

    return Compiling(
        finish=finish,
        unordered=sorted({*sums, *unordered(traced)}),
        judged=shapes(
            learned.replace(memory=abstract.memory), SingleDeviceSharding(layout.here[0][0])
        ),
        spread=functools.partial(spread, layout),
        fetch=functools.partial(fetch, layout),
        to_judge=functools.partial(one_copy, layout, abstract.memory),
    )


def resized(tree: PyTree, size: int) -> PyTree:
    """Returns the shapes of a tree with a first axis of another size."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((size, *x.shape[1:]), x.dtype), tree)


def compile_collects(
    layout: Layout, config: Config, env: Env, network: Network, abstract: TrainState
) -> tuple[list[Callable], PyTree, list[str]]:
    """Compiles `collect` for each device here; returns also its result's shapes, its loose sums."""
    program = jax.jit(portable(functools.partial(collect, config, env, network)), donate_argnums=1)
    learned = abstract.replace(**dict.fromkeys(PLACES))
    places = resized({name: getattr(abstract, name) for name in PLACES}, layout.size)

    def build(device: Any) -> Any:
        return compiled(program.lower(*shapes((learned, places), SingleDeviceSharding(device))))

    (device, _), *others = layout.here
    # The first alone: where the persistent cache serves all devices, the others find it there.
    collects = [build(device)]
    with ThreadPoolExecutor() as pool:
        collects += pool.map(build, [device for device, _ in others])
    traced = program.trace(learned, places)
    return collects, traced.out_info[1], unordered(traced)


def one_copy(layout: Layout, memory: PyTree, state: Spread) -> TrainState:
    """Returns what an evaluation needs of a state, on one device; `memory`: its shapes."""
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), memory)
    return on(layout.here[0][0], state.learned).replace(memory=zeros)
