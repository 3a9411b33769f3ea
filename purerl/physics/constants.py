"""Constants that MuJoCo derives from fields of a model, computed anew where those have changed."""

import contextlib
import copy
import functools
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from purerl.core.records import Array
from purerl.physics import host_calls, lookup, reasons


def derive(
    model: mujoco.MjModel, changes: dict[str, Any], wanted: tuple[str, ...]
) -> dict[str, Array]:
    """Returns the `wanted` constants of a model with changes: by mj_setConst, on the host."""
    names = tuple(sorted(changes))
    name = "-".join(["purerl-derive", lookup.hash_model(model, wanted), *names])
    host = functools.partial(_derive_rows, copy.copy(model), names, wanted)
    shapes = [getattr(model, n).shape for n in wanted]
    found = host_calls.run(name, host, [changes[n] for n in names], shapes)
    return dict(zip(wanted, found, strict=True))


def _derive_rows(
    model: mujoco.MjModel, names: tuple[str, ...], wanted: tuple[str, ...], rows: Any
) -> np.ndarray:
    """Derives packed rows: [..., changes] -> [..., constants]; NaN where MuJoCo refuses."""
    flat = np.asarray(rows).reshape(-1, np.shape(rows)[-1])
    batch = Batch(model, len(flat), nthread=host_calls.usable_cores())
    fields = [batch.expand(name) for name in names]
    host_calls.unpack(fields, flat)
    for name, field in zip(names, fields, strict=True):
        if name in ("body_pos", "body_quat"):  # a mocap body is where the state says
            field[:, model.body_mocapid >= 0] = getattr(model, name)[model.body_mocapid >= 0]
    with contextlib.suppress(SimulationError):  # `status` says which
        batch.set_const()
    for i in np.flatnonzero(batch.status):
        reasons.note(batch.error(int(i)))
    found = [batch.expand(name).reshape(len(flat), -1) for name in wanted]
    out = np.concatenate(found, axis=1, dtype=np.float32)
    out[batch.status != 0] = np.nan
    return out.reshape(*np.shape(rows)[:-1], out.shape[-1])
