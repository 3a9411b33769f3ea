"""A model's geoms as few batches of equal shapes, which a browser draws at once; pure.

A batch is one mesh, drawn many times, each with a place, a rotation and a size of its own. So a
body is a handful of messages a frame, and a corridor whose boxes move and stretch from step to
step costs no more than one that does not. (mjviser, which draws MuJoCo's models in the same
browser page, bakes every geom into a mesh when it starts. To show another gap it would make all
meshes anew: 0.3 s for an ant, 0.9 s for a rodent, against 0.2 ms, as
lab/2026-11-23-window-beside-mjviser.md has it.)
"""

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from purerl.report import episode_pictures, renderer

SPHERE, ROD, BOX = "sphere", "rod", "box"
GHOST = "ghost/"  # before the names of its batches
_GEOM = mujoco.mjtGeom
_PARTS = {  # a capsule is a rod and two spheres: it cannot be stretched as a whole
    int(_GEOM.mjGEOM_SPHERE): (SPHERE,),
    int(_GEOM.mjGEOM_ELLIPSOID): (SPHERE,),
    int(_GEOM.mjGEOM_CAPSULE): (ROD, SPHERE, SPHERE),
    int(_GEOM.mjGEOM_CYLINDER): (ROD,),
    int(_GEOM.mjGEOM_BOX): (BOX,),
}
# From -1 to 1 along each axis. `smooth_shaded` gives the sides of an edge corners of their own, so
# that it is seen to be sharp.
UNIT_MESHES = {
    SPHERE: trimesh.creation.icosphere(subdivisions=3),
    ROD: trimesh.creation.cylinder(radius=1.0, height=2.0, sections=24).smooth_shaded,
    BOX: trimesh.creation.box(extents=(2.0, 2.0, 2.0)).smooth_shaded,
}
SHOWN_GROUPS = 3  # MuJoCo's own viewers show geoms of groups 0, 1 and 2
SCENERY_COLOR = np.array([102, 115, 128])


class Batch(NamedTuple):
    """One mesh that stands for N parts of geoms."""

    mesh: trimesh.Trimesh
    shape: str  # SPHERE, ROD, BOX, or a mesh's name
    geoms: np.ndarray  # [N] int
    sides: np.ndarray  # [N] of a capsule's spheres: 1 above, -1 below; 0 in the middle
    colors: np.ndarray  # [N, 3] uint8, as a screen shows them
    opacities: np.ndarray  # [N] in [0, 1]
    moving: bool  # whether they belong to a body that can move


class Layout(NamedTuple):
    """Where the N parts of a batch are."""

    positions: np.ndarray  # [N, 3] [m]
    wxyzs: np.ndarray  # [N, 4]
    scales: np.ndarray  # [N, 3]


def batches(model: mujoco.MjModel) -> dict[str, Batch]:
    """Returns a model's visible geoms as batches, by name; planes and height fields are none."""
    found: dict[str, Batch] = {}
    for moving in (False, True):
        parts: dict[str, list[tuple[int, int]]] = {}
        for geom in filter(lambda i: _is_shown(model, i), range(model.ngeom)):
            if (model.body_weldid[model.geom_bodyid[geom]] != 0) == moving:
                for number, name in enumerate(_part_names(model, geom)):
                    parts.setdefault(name, []).append((geom, (0, 1, -1)[number]))
        for name, chosen in parts.items():
            geoms, sides = (np.array(column) for column in zip(*chosen, strict=True))
            rgba = np.clip([renderer.color_of(model, geom) for geom in geoms], 0.0, 1.0)
            colors, opacities = (255 * rgba[:, :3]).astype(np.uint8), rgba[:, 3].astype(np.float32)
            batch = Batch(_mesh(model, name), name, geoms, sides, colors, opacities, moving)
            found[f"{'body' if moving else 'ground'}/{name}"] = batch
    return found


def ghosts(body: dict[str, Batch]) -> dict[str, Batch]:
    """Returns the moving batches of `batches` as a ghost's: no mouse can draw at them."""
    rgba = renderer.drawing.GHOST
    color, opacity = (255 * rgba[:3]).astype(np.uint8), rgba[3]
    return {
        GHOST + name: batch._replace(
            colors=np.tile(color, (len(batch.geoms), 1)),
            opacities=np.full_like(batch.opacities, opacity),
            moving=False,
        )
        for name, batch in body.items()
        if batch.moving
    }


def layout(model: mujoco.MjModel, data: mujoco.MjData, batch: Batch) -> Layout:
    """Returns where a batch's parts are in a model that a `Stage` has put into place."""
    geoms, size = batch.geoms, model.geom_size[batch.geoms]
    rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
    along = (batch.sides * size[:, 1])[:, None] * rotations[:, :, 2]
    return Layout(
        positions=np.asarray(data.geom_xpos[geoms] + along, np.float32),
        wxyzs=Rotation.from_matrix(rotations).as_quat(scalar_first=True).astype(np.float32),
        scales=np.asarray(_scales(batch.shape, model.geom_type[geoms], size), np.float32),
    )


def scenery_layout(picture: episode_pictures.Picture) -> Layout | None:
    """Returns the boxes of an episode that are only drawn; None if there are none."""
    if not picture.scenery or not len(picture.scenery[0]):
        return None
    centers, half = (np.asarray(x, np.float32) for x in picture.scenery)
    # 2 mm smaller: where the model has the same box, its surface and not this one is seen.
    upright = np.tile(np.asarray([1, 0, 0, 0], np.float32), (len(centers), 1))
    return Layout(centers, upright, np.maximum(half - 0.002, 1e-4))


def as_light(colors: np.ndarray) -> np.ndarray:
    """Returns a screen's colors [..., 3] in proportion to light: viser takes a batch's so."""
    return np.asarray(255 * (colors / 255) ** 2.2, np.uint8)


def planes(model: mujoco.MjModel) -> list[int]:
    """Returns the visible planes, which are drawn as grids."""
    kind = int(_GEOM.mjGEOM_PLANE)
    return [i for i in range(model.ngeom) if model.geom_type[i] == kind and _is_shown(model, i)]


def _is_shown(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_group[geom] < SHOWN_GROUPS and renderer.color_of(model, geom)[3] > 0)


def _part_names(model: mujoco.MjModel, geom: int) -> tuple[str, ...]:
    kind = int(model.geom_type[geom])
    if kind == int(_GEOM.mjGEOM_MESH):
        return (f"mesh{model.geom_dataid[geom]}",)
    return _PARTS.get(kind, ())


def _scales(shape: str, kinds: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Returns the sizes [N, 3] of unit meshes of a shape, which are parts of geoms."""
    radius, half = size[:, :1], size[:, 1:2]
    if shape == SPHERE:
        ellipsoid = (kinds == int(_GEOM.mjGEOM_ELLIPSOID))[:, None]
        return np.where(ellipsoid, size, radius)
    if shape == ROD:
        return np.concatenate([radius, radius, half], axis=1)
    return size if shape == BOX else np.ones_like(size)


def _mesh(model: mujoco.MjModel, name: str) -> trimesh.Trimesh:
    if name in UNIT_MESHES:
        return UNIT_MESHES[name]
    mesh = int(name.removeprefix("mesh"))
    vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    return trimesh.Trimesh(model.mesh_vert[vertices], model.mesh_face[faces], process=False)
