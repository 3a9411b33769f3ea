"""What there is to see in a model: its geoms as shapes, as they were compiled."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from purerl.core.errors import unknown_name
from purerl.core.records import Array
from purerl.eyes.eye import rotation
from purerl.eyes.shapes import FIELD, KINDS
from purerl.physics import drawing, lookup

GREY = np.array([0.299, 0.587, 0.114])  # of red, green and blue


class Shapes(NamedTuple):
    """Shapes in the frames of bodies, those of one kind together, in the order of `KINDS`."""

    body: np.ndarray  # [S]
    kind: np.ndarray  # [S] index in KINDS
    position: np.ndarray  # [S, 3] [m]
    axes: np.ndarray  # [S, 3, 3]; columns: the shape's x, y, z
    scale: np.ndarray  # [S, 3] what a unit shape is multiplied by [m]
    length: np.ndarray  # [S] of a capsule and a cylinder, half, over its radius
    radius: np.ndarray  # [S] of the bounding sphere [m]
    grey: np.ndarray  # [S] 0 to 1
    heights: Array | np.ndarray  # [R, C] of the height field, 0 by 0 if there is none [m]


def shapes_of(model: mujoco.MjModel, hide: Sequence[str] = ()) -> Shapes:
    """Returns a model's geoms that can be seen as shapes; `hide`: names of geoms and of bodies."""
    order, kinds = {int(kind): number for number, kind in enumerate(KINDS)}, [*KINDS.values()]
    seen = np.flatnonzero(~_hidden(model, hide))
    for i in seen:
        if model.geom_type[i] not in order:
            kind = mujoco.mjtGeom(model.geom_type[i]).name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"Eyes do not see a {kind}, and geom {model.geom(i).name or int(i)!r} is one: name "
                "it or its body in `hide`, or put a simpler geom in its place."
            )
    seen = np.array(sorted(seen, key=lambda i: order[model.geom_type[i]]), int)
    kind = np.array([order[model.geom_type[i]] for i in seen], int)
    size, heights = model.geom_size.copy(), np.zeros((0, 0))
    fields = seen[model.geom_type[seen] == FIELD]
    if len(fields) > 1:
        raise ValueError(f"Eyes see one height field, and {len(fields)} are here: `hide` others.")
    for geom in fields:
        field = model.hfield(model.geom_dataid[geom])
        heights, size[geom] = field.data * field.size[2], field.size[[0, 1, 3]]
    scale = np.array([kinds[kind[n]].scale(size[i]) for n, i in enumerate(seen)])
    scale, radius = scale.reshape(-1, 3), model.geom_rbound[seen]
    numbers = (
        model.geom_pos[seen],
        np.array([rotation(quat) for quat in model.geom_quat[seen]]).reshape(-1, 3, 3),
        scale,
        model.geom_size[seen, 1] / scale[:, 0],
        np.where(radius > 0.0, radius, np.inf),  # a plane has none
        np.array([drawing.color_of(model, int(i))[:3] @ GREY for i in seen]),
        heights,
    )
    return Shapes(model.geom_bodyid[seen], kind, *(x.astype(np.float32) for x in numbers))


def _hidden(model: mujoco.MjModel, hide: Sequence[str]) -> np.ndarray:
    """Tells which geoms are not seen, [ngeom] bool: named, on a named body, clear, or of group 3.

    MuJoCo draws none of groups 3 to 5 either.
    """
    bodies, geoms = lookup.names(model, "body"), lookup.names(model, "geom")
    for name in hide:
        if name not in bodies + geoms:
            raise ValueError(unknown_name("body or geom", name, bodies + geoms))
    below = np.isin(bodies, list(hide))
    for i in range(1, model.nbody):
        below[i] |= below[model.body_parentid[i]]
    named = below[model.geom_bodyid] | np.isin(geoms, list(hide))
    return named | (model.geom_group > 2) | (model.geom_rgba[:, 3] == 0.0)
