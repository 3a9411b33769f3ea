"""How a state looks: what of it is put into MuJoCo's model and scene before a picture is drawn.

An environment that can be drawn has `physics: Physics`, and its states a PhysicsState as `physics`.
It may have three methods:

- `model_changes(state) -> {field: array}`: the model fields of this episode, as its own `step`
  gives them to `Physics.step`. They are drawn as they were.
- `scenery(state) -> (centers [P, 3], half_sizes [P, 3])` [m]: boxes that belong to the episode but
  are not all in the model at once, such as the far platforms of a corridor. Only drawn.
- `ghost(state) -> qpos [nq]`: where the body ought to be. Only drawn, so that one sees through it.

What its eyes see, the observation's entry "eyes" [E, H, W] uint8, is drawn beside it.

OpenGL is the caller's.
"""

import copy
from typing import Any, NamedTuple

import mujoco
import numpy as np

from purerl.core.env import State
from purerl.core.errors import unknown_name
from purerl.core.records import Array
from purerl.physics.lookup import names

GHOST = np.array([0.2, 0.6, 1.0, 0.3], np.float32)  # its color


class Picture(NamedTuple):
    """All that decides how one state looks; leading axes are the caller's."""

    qpos: Array  # [..., nq]
    mocap_pos: Array  # [..., nmocap, 3] [m]
    mocap_quat: Array  # [..., nmocap, 4]
    changes: dict[str, Array]  # MjModel field -> its values
    scenery: tuple[Array, ...]  # () or centers and half sizes of boxes, [..., P, 3] each [m]
    eyes: tuple[Array, ...] = ()  # () or one array of what they see, [..., E, H, W] uint8
    ghost: tuple[Array, ...] = ()  # () or the ghost's qpos, [..., nq]


def take_picture(env: Any, state: State) -> Picture:
    """Keeps what decides how one environment's state looks."""
    changes = env.model_changes(state) if hasattr(env, "model_changes") else {}
    scenery = env.scenery(state) if hasattr(env, "scenery") else ()
    p, seen = state.physics, state.observation
    eyes = (seen["eyes"],) if isinstance(seen, dict) and "eyes" in seen else ()
    ghost = (env.ghost(state),) if hasattr(env, "ghost") else ()
    return Picture(p.qpos, p.mocap_pos, p.mocap_quat, changes, tuple(scenery), eyes, ghost)


class Stage:
    """A copy of a model, its data and a camera, posed as each picture says."""

    def __init__(self, model: mujoco.MjModel, camera: str = "") -> None:
        """Copies the model. ValueError if there is no such camera; "": `default_camera`."""
        self.model = model = copy.copy(model)
        # The compiler marks geoms that coincide with their body, and MuJoCo then never reads their
        # own place, so that a changed one would not show.
        model.geom_sameframe[:] = model.site_sameframe[:] = model.body_sameframe[:] = 0
        self.data, self.ghost = mujoco.MjData(model), mujoco.MjData(model)
        self.fixed = find_camera(model, camera) if camera else default_camera(model)
        self.camera = mujoco.MjvCamera()
        self.root = root_body(model)
        self.followed_height: float | None = None

    def begin_episode(self) -> None:
        """Lets the camera take its height and distance anew."""
        self.followed_height = None

    def pose(self, picture: Picture) -> None:
        """Puts everything where it is in a picture of numpy arrays, and aims the camera.

        The camera points at the followed body, or where the model has it.
        """
        for name, values in picture.changes.items():
            getattr(self.model, name)[...] = values
        self.data.qpos[:] = picture.qpos
        self.data.mocap_pos[:] = picture.mocap_pos
        self.data.mocap_quat[:] = picture.mocap_quat

        mujoco.mj_fwdPosition(self.model, self.data)
        for self.ghost.qpos[:] in picture.ghost:
            mujoco.mj_kinematics(self.model, self.ghost)
        if self.fixed is not None:
            self.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self.camera.fixedcamid = self.fixed
            return
        center = self.data.subtree_com[self.root]
        if self.followed_height is None:
            # The height stays that of the episode's start, or the ground would bob with each step.
            self.followed_height = float(center[2])
            # A view of 45 degrees is as high as 0.8 of the distance: room for body and ground.
            self.camera.distance = 3.2 * self.radius(0.01)
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.camera.azimuth, self.camera.elevation = 90.0, -15.0  # from the side: x to the right
        self.camera.lookat[:] = center[0], center[1], self.followed_height

    def radius(self, least: float) -> float:
        """Returns how far the body reaches from its centre of mass, at `least` so far [m]."""
        own = self.model.body_rootid[self.model.geom_bodyid] == self.root
        away = np.linalg.norm(self.data.geom_xpos[own] - self.data.subtree_com[self.root], axis=1)
        return float(np.max(away + self.model.geom_rbound[own], initial=least))


def add_scenery(scene: mujoco.MjvScene, scenery: tuple[Array, ...]) -> None:
    """Adds a picture's boxes to a scene that MuJoCo has updated."""
    for center, half_size in zip(*scenery, strict=True) if scenery else ():
        if scene.ngeom >= scene.maxgeom:
            return
        # 2 mm smaller: where the model has the same box, its surface and not this one is seen.
        size = np.maximum(np.asarray(half_size, float) - 0.002, 1e-4)
        geom, box = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX
        color, upright = np.array([0.4, 0.45, 0.5, 1.0], np.float32), np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, box, size, np.asarray(center, float), upright, color)
        # MuJoCo leaves these as they were in memory, and draws nothing for some of their values.
        geom.category, geom.transparent = int(mujoco.mjtCatBit.mjCAT_DECOR), 0
        scene.ngeom += 1


def add_ghost(scene: mujoco.MjvScene, stage: Stage, option: mujoco.MjvOption) -> None:
    """Adds the moving bodies of a stage's ghost to a scene, so that one sees through them."""
    first, moving = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC.value
    mujoco.mjv_addGeoms(stage.model, stage.ghost, option, mujoco.MjvPerturb(), moving, scene)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:], geom.matid, geom.transparent = GHOST, -1, 1


def color_of(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns a geom's color [4]: its own, else its material's, and of a texture the mean."""
    material, own = model.geom_matid[geom], model.geom_rgba[geom]
    if material < 0 or not np.allclose(own, [0.5, 0.5, 0.5, 1.0]):
        return own
    color, texture = model.mat_rgba[material], model.mat_texid[material].max()
    if texture < 0 or model.tex_nchannel[texture] < 3:
        return color
    start, depth = model.tex_adr[texture], model.tex_nchannel[texture]
    size = model.tex_height[texture] * model.tex_width[texture] * depth
    pixels = model.tex_data[start : start + size].reshape(-1, depth)
    return np.append(color[:3] * pixels[:, :3].mean(0) / 255.0, color[3])


def find_camera(model: mujoco.MjModel, camera: str) -> int:
    """Returns the id of a camera by its name or its number; ValueError if there is none."""
    numbers = {str(i): i for i in range(model.ncam)}
    known = numbers | {name: i for i, name in enumerate(names(model, "camera")) if name}
    if camera not in known:
        raise ValueError(unknown_name("camera", camera, known))
    return known[camera]


def default_camera(model: mujoco.MjModel) -> int | None:
    """Returns the id of the camera that shows the body best; None: follow it from the side.

    Where something can travel (a free or slide joint), a camera that tracks a body, best one named
    "side" or "track". Else, but for free bodies, the first camera that stands in the world.
    """
    modes, joints = mujoco.mjtCamLight, set(model.jnt_type.tolist())
    tracks = (int(modes.mjCAMLIGHT_TRACK), int(modes.mjCAMLIGHT_TRACKCOM))
    tracking = [i for i in range(model.ncam) if model.cam_mode[i] in tracks]
    called = names(model, "camera")
    named = [i for i in tracking if "side" in called[i] or "track" in called[i]]
    free, slide = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    if tracking and joints & {free, slide}:
        return (named or tracking)[0]
    if free in joints:
        return None
    return next((i for i in range(model.ncam) if model.cam_bodyid[i] == 0), None)


def root_body(model: mujoco.MjModel) -> int:
    """Returns the child of the world with the most moving bodies; the heaviest of equals."""
    below = [0] * model.nbody
    for body in range(1, model.nbody):
        below[model.body_rootid[body]] += int(model.body_weldid[body] != 0)
    return max(range(model.nbody), key=lambda i: (below[i], model.body_subtreemass[i]))
