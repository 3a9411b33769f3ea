"""Recorded episodes in HDF5, as netCDF has it: xarray and h5netcdf read their axes' names.

metadata                      attributes: whose episodes these are
qpos_layout, qvel_layout      the joint of each number; actuator: the name of each action
episodes/I                    attributes n_steps, total_reward, terminated; of imitation its clip
episodes/I/timesteps          [T, ...] qpos, qvel, action, reward, value, done, ...
    observations, task, metrics, memory
    activations/LAYER         what each layer returned; one with layers in it is LAYER/__call__
    world/BODY_xpos, _xmat    where each part of the body was [m], and how it was turned
"""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from purerl.clips import body
from purerl.machine import files
from purerl.physics import lookup

UNITS = {"time": "s", "qpos": "m, rad", "qvel": "m/s, rad/s", "xpos": "m"}
ROOMS = {"network": "activations", "observation": "observations", "physics": ""}
LAYOUTS = {"qpos": "qpos_layout", "qvel": "qvel_layout", "action": "actuator"}


def write(path: Path, arrays: dict[str, np.ndarray], env: Any, **about: Any) -> None:
    """Writes episodes.

    Args:
      path: the file, written whole or not at all.
      arrays: as `episode_arrays.record` returns them.
      env: the environment.
      about: whose they are.

    Raises:
      UserError: the file cannot be written.
    """
    import h5py

    content, model = io.BytesIO(), getattr(getattr(env, "physics", None), "model", None)
    with h5py.File(content, "w") as file:
        file.create_group("metadata").attrs.update(about, timestep=env.control_timestep)
        for name, words in layouts(model).items() if model else ():
            scale(file, name, np.array(words, h5py.string_dtype()))
        for i, length in enumerate(arrays["length"].tolist()):
            names = [name for name in arrays if name != "length"]
            rows = {place_of(name, names): arrays[name][i, :length] for name in names}
            rows |= world(model, rows["qpos"]) if model else {}
            rows["done"] = np.arange(length) == length - 1
            group = file.create_group(f"episodes/{i}/timesteps")
            total = {"total_reward": rows["reward"].sum(), "terminated": rows["terminated"].sum()}
            group.parent.attrs.update(total, n_steps=length)
            if "task/clip" in rows and hasattr(env, "names"):
                group.parent.attrs["clip"] = env.names[arrays["task/clip"][i, 0]]
            times = np.arange(length) * env.control_timestep
            scale(group, "time", rows.pop("time", times)).attrs["units"] = UNITS["time"]
            for name, x in rows.items():
                put(group, name, x)
    files.write_answer(path, content.getvalue())


def place_of(name: str, names: Iterable[str]) -> str:
    """Returns where an array of a recording is in a group of steps; `names` are those of all.

    >>> place_of("network/policy", ["network/policy", "network/policy/Dense_0"])
    'activations/policy/__call__'
    """
    room, _, rest = name.partition("/")
    rest = rest or "policy" * (room == "observation")
    inner = "__call__" * any(other.startswith(f"{name}/") for other in names)
    return "/".join(filter(None, (ROOMS.get(room, room), rest, inner))) or room


def layouts(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Returns the name of each number of qpos and of qvel, and of each actuator."""
    found = {"actuator": lookup.names(model, "actuator")}
    ends = {"qpos": [*model.jnt_qposadr, model.nq], "qvel": [*model.jnt_dofadr, model.nv]}
    for name, starts in ends.items():
        each = zip(lookup.names(model, "joint"), np.diff(starts).tolist(), strict=True)
        parts = [[joint] if n == 1 else [f"{joint}.{i}" for i in range(n)] for joint, n in each]
        found[LAYOUTS[name]] = sum(parts, [])
    return found


def world(model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Returns where each part of the body is in a track [L, nq], [L, 3] [m], and turned [L, 3, 3].

    Parts without a name are left out.
    """
    own = np.flatnonzero(model.body_rootid == body.root_body(model))
    rows = [np.hstack([data.xpos, data.xmat]) for data in body.posed(model, qpos)]
    x = np.array(rows, np.float32).reshape(len(qpos), model.nbody, 12)
    parts = {name: i for i in own.tolist() if (name := body.bare(model.body(i).name))}
    places = {f"world/{name}_xpos": x[:, i, :3] for name, i in parts.items()}
    turned = {f"world/{n}_xmat": x[:, i, 3:].reshape(-1, 3, 3) for n, i in parts.items()}
    return places | turned


def scale(home: Any, name: str, values: np.ndarray) -> Any:
    """Returns a scale of HDF5, the numbers or names along an axis, made where it is missing."""
    if name not in home:
        home[name] = values
        home[name].make_scale(name)
    return home[name]


def put(group: Any, name: str, x: np.ndarray) -> None:
    """Writes an array [T, ...] into a group, each axis with its scale; but for time's all share it.

    What is no joint, actuator or time is numbered.
    """
    made = group.create_dataset(name, data=x.astype(np.int8) if x.dtype == bool else x)
    made.attrs["units"] = UNITS.get(name.rpartition("_")[2], "")
    layout = LAYOUTS.get(name, "")
    named = layout in group.file and group.file[layout].shape == x.shape[1:]
    made.dims[0].attach_scale(group["time"])
    for axis, length in enumerate(x.shape[1:], 1):
        own = layout if named else f"axis{axis}_{length}"
        made.dims[axis].attach_scale(scale(group.file, own, np.arange(length)))
