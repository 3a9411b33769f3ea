"""Draws states with MuJoCo's own renderer, without a screen."""

import contextlib
import copy
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from purerl.physics.lookup import find, names
from purerl.report.episode_pictures import Picture
from purerl.report.opengl import open_gl


class Renderer(contextlib.AbstractContextManager):
    """Draws pictures of one model; to be used in a `with`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, camera: str = "") -> None:
        """Prepares a copy of a model to be drawn, in frames of width x height [pixels].

        Without a `camera`'s name: `default_camera`. RunError if there is no OpenGL; ValueError if
        there is no such camera.
        """
        self.model = model = copy.copy(model)
        # The compiler marks geoms that coincide with their body, and MuJoCo then never reads their
        # own place, so that a changed one would not show.
        model.geom_sameframe[:] = model.site_sameframe[:] = model.body_sameframe[:] = 0
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self.data = mujoco.MjData(model)
        self.fixed = find(model, "camera", camera) if camera else default_camera(model)
        self.camera = mujoco.MjvCamera()
        self.root = root_body(model)
        self.followed_height: float | None = None
        self.gl = open_gl(width, height)
        self.scene = mujoco.MjvScene(model, maxgeom=10_000)
        self.option = mujoco.MjvOption()
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self.size = mujoco.MjrRect(0, 0, width, height)

    def __exit__(self, *_: Any) -> None:
        """Gives the OpenGL context back."""
        self.context.free()
        self.gl.free()
        self.gl = None  # its destructor, run when Python ends, would complain

    def draw_episode(self, pictures: Iterable[Picture]) -> Iterator[np.ndarray]:
        """Yields the frame of each state; the camera takes its height and distance anew."""
        self.followed_height = None
        yield from map(self.draw, pictures)

    def draw(self, picture: Picture) -> np.ndarray:
        """Draws one state, given as numpy arrays; returns [height, width, 3] uint8."""
        for name, values in picture.changes.items():
            getattr(self.model, name)[...] = values
        self.data.qpos[:] = picture.qpos
        self.data.mocap_pos[:] = picture.mocap_pos
        self.data.mocap_quat[:] = picture.mocap_quat
        mujoco.mj_fwdPosition(self.model, self.data)
        self._aim()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self.model, self.data, self.option, None, self.camera, everything, self.scene
        )
        for center, half_size in zip(*picture.scenery, strict=True) if picture.scenery else ():
            self._add_box(np.asarray(center, float), np.asarray(half_size, float))
        mujoco.mjr_render(self.size, self.scene, self.context)
        frame = np.empty((self.size.height, self.size.width, 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, self.size, self.context)
        return frame[::-1]  # OpenGL counts rows from below

    def _aim(self) -> None:
        """Points the camera at the followed body, or leaves it to the model."""
        if self.fixed is not None:
            self.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self.camera.fixedcamid = self.fixed
            return
        center = self.data.subtree_com[self.root]
        if self.followed_height is None:
            # The height stays that of the episode's start, or the ground would bob with each step.
            self.followed_height = float(center[2])
            own = self.model.body_rootid[self.model.geom_bodyid] == self.root
            away = np.linalg.norm(self.data.geom_xpos[own] - center, axis=1)
            radius = np.max(away + self.model.geom_rbound[own], initial=0.01)  # [m]
            # A view of 45 degrees is as high as 0.8 of the distance: room for body and ground.
            self.camera.distance = 3.2 * radius
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.camera.azimuth, self.camera.elevation = 90.0, -15.0  # from the side: x to the right
        self.camera.lookat[:] = center[0], center[1], self.followed_height

    def _add_box(self, center: np.ndarray, half_size: np.ndarray) -> None:
        if self.scene.ngeom >= self.scene.maxgeom:
            return
        # 2 mm smaller: where the model has the same box, its surface and not this one is seen.
        half_size = np.maximum(half_size - 0.002, 1e-4)
        geom, box = self.scene.geoms[self.scene.ngeom], mujoco.mjtGeom.mjGEOM_BOX
        color = np.array([0.4, 0.45, 0.5, 1.0], np.float32)
        mujoco.mjv_initGeom(geom, box, half_size, center, np.eye(3).ravel(), color)
        self.scene.ngeom += 1


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
