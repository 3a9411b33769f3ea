"""Draws states with MuJoCo's own renderer, without a screen."""

import ctypes.util
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from purerl.core.errors import RunError, UserError

INSTALL = (
    "Install a software renderer with `apt-get install libosmesa6`, or, on a machine with an "
    "NVIDIA GPU, the EGL part of its driver (libnvidia-gl; in a container: "
    "NVIDIA_DRIVER_CAPABILITIES=all)."
)
BACKENDS = ("egl", "osmesa")  # glfw draws only where there is a screen


# --- OpenGL without a screen ---


def choose_gl(find: Callable[[str], str | None] = ctypes.util.find_library) -> str:
    """Chooses how to draw without a screen, and says so in MUJOCO_GL; the user's own choice wins.

    To be called before the first import of mujoco or dm_control, which look for a screen.

    Raises:
      RunError: there is no OpenGL; the message says what to install.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if not chosen:
        if Path("/dev/nvidiactl").exists() and find("EGL_nvidia"):
            chosen = "egl"
        elif find("OSMesa"):
            chosen = "osmesa"
        elif find("EGL"):  # Mesa's, which can draw on a CPU too
            chosen = "egl"
        else:
            raise RunError(f"There is no OpenGL to draw with. {INSTALL}")
    if chosen not in BACKENDS:
        raise RunError(
            f"MUJOCO_GL is {chosen!r}, with which nothing can be drawn without a screen; unset it, "
            f"or set one of {', '.join(BACKENDS)}."
        )
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = chosen
    return chosen


def open_gl(width: int, height: int) -> Any:
    """Makes an OpenGL context current for frames of up to width x height [pixels].

    Raises:
      RunError: it cannot be had; the message says what to install.
    """
    backend = choose_gl()
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # each backend has its own kinds, some without a printable message
        raise RunError(
            f"OpenGL does not start by {backend} ({type(error).__name__}). {INSTALL}"
        ) from error
    return context


def parse_size(size: str) -> tuple[int, int]:
    """Returns (width, height) [pixels] of "640x480"."""
    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise UserError(f"size is {size!r}; give width x height in pixels, such as 640x480.")
    width, height = map(int, parts)
    if width % 2 or height % 2 or not 16 <= min(width, height) <= max(width, height) <= 4096:
        raise UserError(
            f"size is {size}; width and height must be even and from 16 to 4096 pixels."
        )
    return width, height


# --- drawing ---


class Renderer:
    """Draws pictures of one model; `close` it, or use it in a `with`."""

    def __init__(self, model: Any, width: int, height: int, camera: str = "") -> None:
        """Prepares a model to be drawn.

        Args:
          model: mujoco.MjModel; it is copied, since pictures change its fields.
          width: of a frame [pixels].
          height: of a frame [pixels].
          camera: a camera's name in the model; "": see `default_camera`.

        Raises:
          RunError: there is no OpenGL.
          ValueError: there is no such camera; the message lists those there are.
        """
        import copy

        import mujoco

        from purerl.physics.lookup import find

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

    def __enter__(self) -> "Renderer":
        """Returns itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Closes."""
        self.close()

    def close(self) -> None:
        """Gives the OpenGL context back."""
        self.context.free()
        self.gl.free()
        self.gl = None  # its destructor, run when Python ends, would complain

    def start_episode(self) -> None:
        """Lets the following camera take its height and distance anew."""
        self.followed_height = None

    def draw(self, picture: Any) -> Any:
        """Draws one state.

        Args:
          picture: `video.Picture` of one state, with numpy arrays.

        Returns:
          [height, width, 3] uint8.
        """
        import mujoco
        import numpy as np

        self._place(picture)
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

    def _place(self, picture: Any) -> None:
        """Sets model and data to the state, and computes where everything is."""
        import mujoco

        for name, values in picture.changes.items():
            getattr(self.model, name)[...] = values
        self.data.qpos[:] = picture.qpos
        self.data.mocap_pos[:] = picture.mocap_pos
        self.data.mocap_quat[:] = picture.mocap_quat
        mujoco.mj_fwdPosition(self.model, self.data)

    def _aim(self) -> None:
        """Points the camera at the followed body, or leaves it to the model."""
        import mujoco

        if self.fixed is not None:
            self.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self.camera.fixedcamid = self.fixed
            return
        center = self.data.subtree_com[self.root]
        if self.followed_height is None:
            # The height stays that of the episode's start, or the ground would bob with each step.
            self.followed_height = float(center[2])
            # A view of 45 degrees is as high as 0.8 of the distance: room for body and ground.
            self.camera.distance = 3.2 * subtree_radius(self.model, self.data, self.root)
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self.camera.azimuth, self.camera.elevation = 90.0, -15.0  # from the side: x to the right
        self.camera.lookat[:] = center[0], center[1], self.followed_height

    def _add_box(self, center: Any, half_size: Any) -> None:
        import mujoco
        import numpy as np

        if self.scene.ngeom >= self.scene.maxgeom:
            return
        # 2 mm smaller: where the model has the same box, its surface and not this one is seen.
        half_size = np.maximum(half_size - 0.002, 1e-4)
        mujoco.mjv_initGeom(
            self.scene.geoms[self.scene.ngeom],
            mujoco.mjtGeom.mjGEOM_BOX,
            half_size,
            center,
            np.eye(3).ravel(),
            np.array([0.4, 0.45, 0.5, 1.0], np.float32),
        )
        self.scene.ngeom += 1


# --- cameras ---


def default_camera(model: Any) -> int | None:
    """Returns the id of the camera that shows the body best; None: follow it from the side.

    Where something can travel (a free or slide joint), a camera that tracks a body, best one named
    "side" or "track". Else, but for free bodies, the first camera that stands in the world.
    """
    import mujoco

    from purerl.physics.lookup import names

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
    standing = [i for i in range(model.ncam) if model.cam_bodyid[i] == 0]
    return standing[0] if standing else None


def root_body(model: Any) -> int:
    """Returns the child of the world with the most moving bodies; the heaviest of equals."""
    below = [0] * model.nbody
    for body in range(1, model.nbody):
        below[model.body_rootid[body]] += int(model.body_weldid[body] != 0)
    return max(range(model.nbody), key=lambda i: (below[i], model.body_subtreemass[i]))


def subtree_radius(model: Any, data: Any, root: int) -> float:
    """Returns how far a body's parts reach from its centre of mass [m]; at least 1 cm."""
    import numpy as np

    own = model.body_rootid[model.geom_bodyid] == root
    away = np.linalg.norm(data.geom_xpos[own] - data.subtree_com[root], axis=1)
    return float(max(0.01, *(away + model.geom_rbound[own]), 0.01))
