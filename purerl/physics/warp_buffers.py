"""Calls of MJX-Warp's kernels from JAX, for a whole batch of simulations at once.

MJX's own way hands all of its model and data over at each physics step, some 330 arrays. Here they
stay where MJX-Warp has put them, outside of JAX: a call copies in what a control step begins with,
runs one CUDA graph of all its physics steps, and copies out what was asked for. (Ants over gaps,
4,096 on an H100: 1.67 times as fast.)

To JAX a call is a pure function: all that one could leave behind for the next is overwritten.
"""

import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp as mjw

from purerl.core.records import Array

Shapes = dict[str, tuple[int, ...]]  # of fields, for one simulation

# Room in the buffers: what the model can need at most, but no more than this for a simulation.
MOST_CONTACTS = 128  # simulations share it: one may have all contacts that the model allows
MOST_ROWS = 512  # of constraints; each simulation has its own

_GEOM = mujoco.mjtGeom
_ONE_POINT = (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_ELLIPSOID)


class Stage(NamedTuple):
    """A part of a call: kernels, and the fields of the data that are read after them."""

    run: Callable[[mjw.Model, mjw.Data], None]
    gives: Shapes


class Batch:
    """MJX-Warp's model and data of a batch on one device, and the graphs of its calls."""

    def __init__(
        self, model: mujoco.MjModel, size: int, contacts: int, rows: int, changed: tuple[str, ...]
    ):
        """Takes the memory, on Warp's current device; RuntimeError if there is not so much.

        `contacts`: as many as the model allows one simulation, of `size`; all share what room there
        is. `rows`: room for rows of constraints, of each. Of `changed` fields of the model each has
        its own value.
        """
        try:
            self.model = put_model(model, dict.fromkeys(changed, size))
            # One simulation may need all that the model allows; many have 128 each to share.
            number = min(size * contacts, max(contacts, size * MOST_CONTACTS))
            self.data = mjw.make_data(model, nworld=size, naconmax=number, njmax=rows)
        except RuntimeError as error:
            raise RuntimeError(
                f"MJX-Warp has no memory for {size} simulations beside what JAX takes of a GPU, "
                "three quarters unless XLA_PYTHON_CLIENT_MEM_FRACTION says less: set that to 0.5, "
                f"or take fewer environments. ({error})"
            ) from error
        self.changed = changed
        self.graphs: dict[str, list[Callable[[], None]]] = {}
        self.views: dict[str, wp.array] = {}  # of fields that calls take or give

    def call(
        self, name: str, stages: tuple[Stage, ...], takes: Iterable[str], arrays: Iterable[wp.array]
    ) -> None:
        """Runs a call's stages on the current stream; `arrays`: what it takes, then what it gives.

        Fields without numbers are in neither.
        """
        left = iter(arrays)
        for field in takes:
            array = next(left)
            wp.copy(self._numbers(field, array), array)
        self._clear()
        if name not in self.graphs:
            self.graphs[name] = [self._record(stage) for stage in stages]
        for stage, graph in zip(stages, self.graphs[name], strict=True):
            graph()
            for field in filled(stage.gives):
                array = next(left)
                wp.copy(array, self._numbers(field, array))

    def _clear(self) -> None:
        """Clears what kernels would read of an earlier call; all else they write first.

        A dense Newton step multiplies by 0 the rows of the Jacobian that are not in use, which
        leaves a NaN there what it is.
        """
        self.data.overflow.zero_()
        if not self.model.is_sparse:
            self.data.efc.J.zero_()

    def _record(self, stage: Stage) -> Callable[[], None]:
        """Returns a function that runs a stage: on a GPU one CUDA graph."""
        if not self.data.qpos.device.is_cuda:
            return lambda: stage.run(self.model, self.data)
        with wp.ScopedCapture() as capture:
            stage.run(self.model, self.data)
        return lambda: wp.capture_launch(capture.graph)

    def _numbers(self, field: str, like: wp.array) -> wp.array:
        """Returns a view of a field's numbers, [n] as `like`, whatever vectors they belong to."""
        if field in self.views:
            return self.views[field]
        array = getattr(self.model if field in self.changed else self.data, field)
        if array.capacity != like.capacity:
            raise ValueError(
                f"MJX-Warp keeps {field!r} in {array.capacity} bytes and not in {like.capacity}: "
                "this version of it is not one that purerl knows."
            )
        view: Any = wp.array(ptr=array.ptr, dtype=like.dtype, shape=like.shape, device=array.device)
        self.views[field] = view
        return view


def put_model(model: mujoco.MjModel, sizes: dict[str, int]) -> mjw.Model:
    """Puts a model on Warp's current device, with so many values of some of its fields."""
    put = mjw.put_model(model, batch_sizes=sizes)
    put.opt.warn_overflow = 0  # or it prints
    return put


def room(model: mujoco.MjModel, put: mjw.Model) -> tuple[int, int]:
    """Returns how many contacts and rows of constraints one simulation gets room for.

    The first is all that the model allows (pairs of geoms that can touch, times the points of
    each), the second what all of them, all equalities, limits and frictions need, or `MOST_ROWS`.
    """
    if model.nflex or model.nhfield or (model.geom_type == _GEOM.mjGEOM_SDF).any():
        return MOST_CONTACTS, MOST_ROWS  # as many points as there are cells: no useful bound
    pairs = put.nxn_geom_pair_filtered.numpy().reshape(-1, 2)
    contacts = int(_points(model.geom_type[pairs]).sum())
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    each = put.nmaxpyramid if pyramidal else put.nmaxcondim
    # A weld has 6 rows. MJX-Warp drops an equality that would end where the buffer ends: 8 more.
    others = 6 * model.neq + model.nv + 2 * model.ntendon + model.njnt + 8
    rows = contacts * max(1, int(each)) + others
    return contacts, min(rows, MOST_ROWS)


def _points(types: np.ndarray) -> np.ndarray:
    """Returns how many points pairs of geoms, types [n, 2], can touch in at most, [n]."""
    one = np.isin(types, [int(g) for g in _ONE_POINT]).any(axis=1)
    two = (types == _GEOM.mjGEOM_CAPSULE).any(axis=1)
    return np.where(one, 1, np.where(two, 2, 8))


def filled(shapes: Shapes) -> Shapes:
    """Leaves out the fields that have no numbers."""
    return {field: shape for field, shape in shapes.items() if math.prod(shape)}


def make_call(
    name: str, stages: tuple[Stage, ...], takes: Shapes, size: int, batch_on: Callable[[Any], Batch]
) -> Callable[[dict[str, Array]], list[dict[str, Array]]]:
    """Returns a function for JAX that runs stages on a batch of `size` simulations.

    It takes a dict of fields [size, ...] (of the data, or of the model if they are `changed`) and
    returns what each stage gives. A batch records the graphs of a `name` once. `batch_on` returns
    the batch on Warp's current device; Warp keeps it as long as the process lasts.
    """
    inputs = list(filled(takes))
    lengths = {
        (i, field): size * math.prod(shape)
        for i, stage in enumerate(stages)
        for field, shape in filled(stage.gives).items()
    }

    def empty(shape: tuple[int, ...]) -> Array:
        return jnp.zeros((size, *shape), jnp.float32)

    if not lengths:  # Warp refuses a call that gives nothing
        return lambda _: [{f: empty(s) for f, s in stage.gives.items()} for stage in stages]

    def run(*arrays: wp.array) -> None:
        batch_on(wp.get_device()).call(name, stages, inputs, arrays)

    dtypes: dict[str, Any] = {f"in_{field}": wp.float32 for field in inputs}
    dtypes |= {f"{f}_{i}": wp.int32 if f == "overflow" else wp.float32 for i, f in lengths}
    _declare(run, dtypes)
    call = wp.jax_callable(
        run,
        num_outputs=len(lengths),
        output_dims={f"{f}_{i}": length for (i, f), length in lengths.items()},
        graph_mode=wp.JaxCallableGraphMode.NONE,  # a batch records its own graphs
    )

    def of_fields(given: dict[str, Array]) -> list[dict[str, Array]]:
        call.call_id = 0  # or programs are not found in JAX's cache: it counts traces
        numbers = call(*(given[field].reshape(-1) for field in inputs))
        found = dict(zip(lengths, numbers, strict=True))
        return [
            {
                f: found[i, f].reshape(size, *s) if (i, f) in found else empty(s)
                for f, s in stage.gives.items()
            }
            for i, stage in enumerate(stages)
        ]

    return of_fields


def _declare(function: Any, dtypes: dict[str, Any]) -> None:
    """Gives a function of any number of arrays [n] the names and types that Warp asks it for."""
    types: dict[str, Any] = {n: wp.array(dtype=kind, ndim=1) for n, kind in dtypes.items()}
    named = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter(name, named, annotation=one) for name, one in types.items()]
    function.__signature__ = inspect.Signature(parameters)
    function.__annotations__ = types
