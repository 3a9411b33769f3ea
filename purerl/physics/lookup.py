"""Questions to a `mujoco.MjModel` by name.

Everything that a reward or an observation reads is looked up here once, when the environment is
built: never by a literal index.
"""

import hashlib
from collections.abc import Iterable

import jax.numpy as jnp
import mujoco
import numpy as np

from purerl.core.errors import unknown_name
from purerl.core.records import Array

# Kinds of objects, and how a model counts them.
_COUNTS = {"body": "nbody", "joint": "njnt", "geom": "ngeom", "site": "nsite", "sensor": "nsensor"}
_COUNTS |= {"actuator": "nactuator", "tendon": "ntendon", "camera": "ncam"}


def hash_model(model: mujoco.MjModel, rest: tuple = ()) -> str:
    """Returns a sha256 of a model, all of it, and of the `rest`, as text."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.sha256(content.tobytes() + repr(rest).encode()).hexdigest()


def reading_shapes(model: mujoco.MjModel, names: tuple[str, ...]) -> dict[str, tuple[int, ...]]:
    """Returns each reading's shape: of rotation matrices [n, 3, 3], of "overflow" []."""
    data = mujoco.MjData(model)
    shapes = {name: np.shape(getattr(data, name, 0.0)) for name in names}
    return {n: (s[0], 3, 3) if n.endswith("mat") else s for n, s in shapes.items()}


def names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Returns the names of all objects of a kind ("body", "joint", "sensor", ...), by id.

    Those of actuators are by control, [nu]: one of several controls is there several times.
    """
    found = [getattr(model, kind)(i).name for i in range(getattr(model, _COUNTS[kind]))]
    return np.repeat(found, model.actuator_ctrlnum).tolist() if kind == "actuator" else found


def find(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Returns the id of an object; of an actuator, its first place in ctrl.

    Args:
      model: the model.
      kind: "body", "joint", "geom", "site", "sensor", "actuator", "tendon" or "camera".
      name: its full name, scopes included ("walker/torso").

    Raises:
      ValueError: there is none of that name; the message lists those there are.
    """
    if kind not in _COUNTS:
        raise ValueError(unknown_name("kind of object", kind, _COUNTS))
    try:
        number = getattr(model, kind)(name).id
        return int(model.actuator_ctrladr[number]) if kind == "actuator" else number
    except KeyError as error:
        raise ValueError(unknown_name(kind, name, names(model, kind))) from error


def qpos_indices(model: mujoco.MjModel, joints: Iterable[str]) -> np.ndarray:
    """Returns where the positions of the joints stand in qpos, in the order given, [n] int."""
    return _indices(model, joints, model.jnt_qposadr, model.nq)


def qvel_indices(model: mujoco.MjModel, joints: Iterable[str]) -> np.ndarray:
    """Returns where the velocities of the joints stand in qvel, in the order given, [n] int."""
    return _indices(model, joints, model.jnt_dofadr, model.nv)


def _indices(model, joints: Iterable[str], starts: np.ndarray, number: int) -> np.ndarray:
    ids = [find(model, "joint", name) for name in joints]
    ends = [*starts[1:], number]
    return np.concatenate([*(np.arange(starts[i], ends[i]) for i in ids), np.zeros(0, int)])


def sensor_slice(model: mujoco.MjModel, name: str) -> slice:
    """Returns where the values of a sensor stand in sensordata."""
    i = find(model, "sensor", name)
    return slice(int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i]))


def scale_action(model: mujoco.MjModel, action: Array) -> Array:
    """Maps an action [nu] in [-1, 1] to controls over each actuator's ctrlrange.

    Raises:
      ValueError: an actuator has no ctrlrange, so that -1 and 1 mean nothing.
    """
    limited = model.actuator_ctrllimited
    open_ended = [n for n, ok in zip(names(model, "actuator"), limited, strict=True) if not ok]
    if open_ended:
        raise ValueError(
            f"Actuators without a ctrlrange: {', '.join(dict.fromkeys(open_ended))}. Give them "
            "one, so that an action in [-1, 1] has a meaning."
        )
    low, high = jnp.asarray(model.actuator_ctrlrange, jnp.float32).T
    return low + 0.5 * (action + 1.0) * (high - low)
