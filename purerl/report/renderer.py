"""Draws states with MuJoCo's own renderer, without a screen."""

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from purerl.core.errors import UserError
from purerl.physics import drawing

# The last one is for rooms that may not import physics.
from purerl.physics.drawing import Picture, Stage, add_scenery, color_of, root_body  # noqa: F401
from purerl.report.opengl import open_gl


def model_of(env: Any) -> mujoco.MjModel:
    """Returns the model of an environment that can be drawn; UserError if it cannot."""
    physics: Any = getattr(env, "physics", None)
    if not hasattr(physics, "model"):
        raise UserError(
            f"The environment {type(env).__name__} cannot be drawn: it has no `physics` of the "
            "type purerl.Physics."
        )
    return physics.model


class Renderer(contextlib.AbstractContextManager):
    """Draws pictures of one model; to be used in a `with`."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int, camera: str = "") -> None:
        """Prepares a copy of a model to be drawn, in frames of width x height [pixels].

        `camera` is its name or number; "": the one that shows the body best. RunError if there is
        no OpenGL; ValueError if there is no such camera.
        """
        self.stage = Stage(model, camera)
        model = self.stage.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
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
        self.stage.begin_episode()
        yield from map(self.draw, pictures)

    def draw(self, picture: Picture) -> np.ndarray:
        """Draws one state, given as numpy arrays; returns [height, width, 3] uint8."""
        stage, everything = self.stage, mujoco.mjtCatBit.mjCAT_ALL.value
        self.gl.make_current()  # another one may draw in the same process
        stage.pose(picture)
        mujoco.mjv_updateScene(
            stage.model, stage.data, self.option, None, stage.camera, everything, self.scene
        )
        add_scenery(self.scene, picture.scenery)
        if picture.ghost:
            drawing.add_ghost(self.scene, stage, self.option)
        mujoco.mjr_render(self.size, self.scene, self.context)
        frame = np.empty((self.size.height, self.size.width, 3), np.uint8)
        mujoco.mjr_readPixels(frame, None, self.size, self.context)
        return add_eyes(frame[::-1], picture)  # OpenGL counts rows from below


def seen_by_eyes(picture: Picture, width: int) -> np.ndarray:
    """Returns what the eyes see side by side, each pixel a square, [height, width, 3] uint8.

    The width is at most as asked for, or one for each of their pixels.
    """
    seen = np.concatenate(np.asarray(picture.eyes[0]), axis=1)
    edge = max(1, width // seen.shape[1])
    return seen.repeat(edge, 0).repeat(edge, 1)[:, :, None].repeat(3, 2)


def add_eyes(frame: np.ndarray, picture: Picture) -> np.ndarray:
    """Returns a frame [height, width, 3] with what the eyes see in its upper right corner."""
    if not picture.eyes:
        return frame
    height, width, _ = frame.shape
    seen, frame = seen_by_eyes(picture, width // 3)[:height, :width], frame.copy()
    frame[: seen.shape[0], -seen.shape[1] :] = seen
    return frame
