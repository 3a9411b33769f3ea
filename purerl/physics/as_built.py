"""Mistakes with a model and its first state that no engine would tell, found when it is traced."""

import operator
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.records import Array

_DRAWN = ("light_", "cam_", "mat_", "geom_rgba")  # what one edits to draw
ZERO_ROTATION = (
    "A simulation starts with a quaternion of zeros, in qpos of a free or ball joint or in "
    "body_quat, which is no rotation: write 1 0 0 0 for none, as model.qpos0 has it."
)


def numbers(model: mujoco.MjModel, fields: Iterable[str]) -> dict[str, Any]:
    """Returns copies of all options and of those `fields` that are not only drawn."""
    names = [f"opt.{name}" for name in dir(model.opt) if not name.startswith("_")]
    names += [name for name in fields if not name.startswith(_DRAWN)]
    return {name: np.copy(operator.attrgetter(name)(model)) for name in names}


def check_unedited(model: mujoco.MjModel, built: dict[str, Any]) -> None:
    """Raises ValueError for a model whose `numbers` are no more those that an engine has."""
    for name, value in built.items():
        if not np.array_equal(value, operator.attrgetter(name)(model)):
            raise ValueError(
                f"The model's {name} was edited after its Physics was built, which has no effect: "
                "edit the model before, or build another Physics of a copy (copy.copy(model)); "
                "what differs between simulations goes into changes=."
            )


def refuse_zero_rotations(model: mujoco.MjModel, qpos: Array, changes: dict[str, Array]) -> Array:
    """Raises ValueError for quaternions of zeros; returns qpos [nq].

    Where only a program will know them, it is NaN then. MuJoCo takes them for no rotation, MJX for
    NaN, MJX-Warp for half a turn.
    """
    given: Any = qpos if isinstance(qpos, jax.core.Tracer) else np.asarray(qpos)
    zero = has_zero_rotation(model, given, changes)
    if isinstance(zero, jax.core.Tracer):
        return jnp.where(zero, jnp.nan, qpos)
    if zero:
        raise ValueError(ZERO_ROTATION)
    return qpos


def has_zero_rotation(model: mujoco.MjModel, qpos: Array, changes: dict[str, Array]) -> Any:
    """Tells whether qpos [nq], or a changed body_quat, has a quaternion of zeros, [] bool."""
    kinds = (mujoco.mjtJoint.mjJNT_FREE, 3), (mujoco.mjtJoint.mjJNT_BALL, 0)
    starts = [i + skip for kind, skip in kinds for i in model.jnt_qposadr[model.jnt_type == kind]]
    quats = [*(qpos[i : i + 4] for i in starts), *changes.get("body_quat", ())]
    return sum((quat == 0).all() for quat in quats) > 0
