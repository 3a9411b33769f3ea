"""The `c` engine: MuJoCo's own C code on a thread pool, as a pure function inside jit.

This is the one call to the host of the library. `mujoco.batch.Batch` loads a state row, steps and
saves the row, and its results do not depend on the number of threads: it is a pure function of its
arguments, which is what `jax.pure_callback` and `host_calls` ask for.
"""

import contextlib
import copy
import functools
import threading
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from purerl.core.records import Array, PyTree
from purerl.physics import host_calls, lookup, reasons

_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{x}")) for x in ("QPOS", "QVEL", "QACC", "CTRL")]
# Contacts or constraints that MuJoCo left out, as the model's memory was full.
_FULL = [int(getattr(mujoco.mjtWarning, f"mjWARN_{x}FULL")) for x in ("CONTACT", "CNSTR")]


# Simulations, and their live arrays, [N, ...] each: state, ctrl and changed fields of the model,
# which a row brings; state and readings, which a row takes away, in the order of packed rows; and
# [N] 1 where contacts were left out, the reading "overflow".
Rows = tuple[Batch, list[np.ndarray], list[np.ndarray], np.ndarray]


class CEngine:
    """Steps a model with MuJoCo's C code; `interface.Physics` says what the functions promise."""

    def __init__(self, model: mujoco.MjModel, record: Any, stage: int, substeps: int):
        """Copies the model; simulations are allocated when the batch size is known.

        Args:
          model: the model.
          record: the NamedTuple of readings.
          stage: `mujoco.mjtStage` to compute at the new state, the least that the readings need.
          substeps: physics steps in one control step.
        """
        # A copy, since programs know the engine by its name. With the bit `energy` a sensor of
        # energy would read that of another simulation of the batch; without, it computes its own.
        self.model, self.record = copy.copy(model), record
        self.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self.stage, self.substeps = stage, substeps
        # All that results depend on, but what is asked of a call.
        self.name = f"purerl-{lookup.hash_model(self.model, (*record._fields, stage))}"
        self.shapes = list(lookup.reading_shapes(model, record._fields).values())
        self.rows: dict[tuple, Rows] = {}  # by number, fields and changed fields
        # XLA may run the callbacks of independent programs on several threads at once.
        self.lock = threading.Lock()

    def init(self, state: PyTree, changes: dict[str, Array], ctrl: Array | None = None) -> tuple:
        """Returns the readings at `state` under ctrl [nu], by default zeros."""
        ctrl = jnp.zeros(self.model.nu, jnp.float32) if ctrl is None else ctrl
        return self._call(state, ctrl, changes, 0)[1]

    def step(self, state: PyTree, ctrl: Array, changes: dict[str, Array]) -> tuple[PyTree, tuple]:
        """Advances one control step."""
        return self._call(state, ctrl, changes, self.substeps)

    def _call(self, state, ctrl, changes, substeps: int) -> tuple[PyTree, tuple]:
        """One packed row in, one packed row out: the cost of a callback is per argument."""
        leaves, structure = jax.tree.flatten(state)
        names = tuple(sorted(changes))
        given = [*leaves, ctrl, *(changes[n] for n in names)]
        fields = tuple(state.__dataclass_fields__)
        host = functools.partial(_run_rows, self, fields, names, substeps)
        name = "-".join([self.name, str(substeps), *fields, *names])
        out = host_calls.run(name, host, given, [leaf.shape for leaf in leaves] + self.shapes)
        state = jax.tree.unflatten(structure, out[: len(leaves)])
        return state, self.record(*out[len(leaves) :])

    def rows_of(self, number: int, fields: tuple[str, ...], names: tuple[str, ...]) -> Rows:
        """Returns the simulations of `number` environments, and where their packed rows go."""
        if (number, fields, names) not in self.rows:
            batch = Batch(_movable(self.model, names), number, nthread=host_calls.usable_cores())
            full, state = np.zeros(number, np.float32), [batch.bind(n) for n in fields]
            out = [full if n == "overflow" else batch.bind(n) for n in self.record._fields]
            targets = [*state, batch.bind("ctrl"), *(batch.expand(n) for n in names)]
            self.rows[number, fields, names] = batch, targets, [*state, *out], full
        return self.rows[number, fields, names]


def _movable(model: mujoco.MjModel, names: tuple[str, ...]) -> mujoco.MjModel:
    """Returns a model that heeds changed frames, sizes and margins.

    The compiler marks geoms and sites that coincide with their body (`geom_sameframe`), and MuJoCo
    then never reads their own frame, which would make a change of it do nothing. It also bounds the
    geoms of a body by volumes of its own, and finds no contact outside of those (midphase)
    and no hit of a camera's rays.
    """
    if not any(n.endswith(("pos", "quat", "_size", "_margin", "_gap")) for n in names):
        return model
    model = copy.copy(model)
    model.geom_sameframe[:] = model.site_sameframe[:] = model.body_sameframe[:] = 0
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    model.bvh_aabb[: model.body_bvhnum.sum(), 3:] = mujoco.mjMAXVAL
    return model


def _run_rows(
    engine: CEngine, fields: tuple[str, ...], names: tuple[str, ...], substeps: int, rows: Any
) -> np.ndarray:
    """Steps packed rows, [..., state + ctrl + changes] -> [..., state + readings] (host, numpy).

    `fields` of the state and changed `names` of the model are in the order of a row. 0 substeps
    compute the readings at the state as it is. A simulation that blew up is all NaN.
    """
    flat = np.asarray(rows).reshape(-1, np.shape(rows)[-1])
    with engine.lock:
        batch, targets, sources, full = engine.rows_of(len(flat), fields, names)
        bad = ~np.isfinite(flat).all(axis=1)
        _load(targets, flat, bad, engine.model)
        batch.warning[...] = 0
        bad |= _advance(batch, engine.stage, substeps)
        full[:] = (batch.warning[:, _FULL, 1] > 0).any(axis=1)
        if "overflow" not in engine.record._fields:
            bad |= full > 0  # nobody looks
        read = [source.reshape(len(flat), source[0].size) for source in sources]
        out = np.concatenate(read, axis=1, dtype=np.float32)
    out[bad] = np.nan
    return out.reshape(*np.shape(rows)[:-1], out.shape[-1])


def _load(targets: list[np.ndarray], rows: np.ndarray, bad: np.ndarray, model) -> None:
    """Writes packed rows into the simulations.

    A row with a NaN would make MuJoCo warn and reset by itself: it steps the model's rest
    position instead, and its result is thrown away.
    """
    if bad.any():
        rest = np.append(model.qpos0, np.zeros(rows.shape[1] - model.nq))
        rows = np.where(bad[:, None], rest, rows)
    host_calls.unpack(targets, rows)


def _advance(batch: Batch, stage: int, substeps: int) -> np.ndarray:
    """Steps all simulations; returns which of them blew up, [N] bool."""
    with contextlib.suppress(SimulationError):  # `status` says which; the others ran on
        batch.step(nstep=substeps, stage=stage) if substeps else batch.forward()
    for i, kind in np.argwhere(batch.warning[..., 1]):
        reasons.note(mujoco.mju_warningText(int(kind), int(batch.warning[i, kind, 0])))
    for i in np.flatnonzero(batch.status):
        reasons.note(batch.error(int(i)))
    # MuJoCo answers a blow-up with a warning and a silent reset of that simulation.
    return (batch.status != 0) | (batch.warning[:, _BAD, 1] > 0).any(axis=1)
