"""Eyes on a body: where they are, and the rays of their pixels."""

import dataclasses
import math
from typing import NamedTuple

import mujoco
import numpy as np

from purerl.physics import lookup


@dataclasses.dataclass(frozen=True)
class Eye:
    """A camera on a body; its picture is square, and upright where the body is."""

    body: str
    """Name of the body that carries it."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the body's frame [m]."""
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0)
    """Along which it looks, in the body's frame, of any length."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """What is above in its picture, in the body's frame, of any length."""
    fovy: float = 80.0
    """Angle between the picture's upper and lower edge [degrees]."""

    def __post_init__(self) -> None:
        """Refuses what sees nothing."""
        if not 0.0 < self.fovy < 180.0:
            raise ValueError(f"fovy is {self.fovy}; give degrees, more than 0 and less than 180.")
        if np.linalg.norm(np.cross(self.direction, self.up)) < 1e-6:
            raise ValueError(
                f"direction {self.direction} and up {self.up} are parallel or 0: the picture has "
                "no upper side. Give two different directions."
            )


class Place(NamedTuple):
    """Where an eye is in the frame of its body."""

    body: int
    position: np.ndarray  # [3] [m]
    axes: np.ndarray  # [3, 3]; columns: right, up, backwards, as of MuJoCo's cameras


def of_camera(model: mujoco.MjModel, name: str) -> Eye:
    """Returns the eye of an MJCF camera, which is fixed to its body.

    Raises:
      ValueError: there is none of that name (the message lists them), or it follows something.
    """
    i = lookup.find(model, "camera", name)
    if model.cam_mode[i] != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
        raise ValueError(f"Camera {name!r} follows a body; an eye needs one of mode 'fixed'.")
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.cam_quat[i])
    _, up, back = axes.reshape(3, 3).T
    body = model.body(model.cam_bodyid[i]).name
    position = tuple(model.cam_pos[i].tolist())
    return Eye(
        body, position, tuple((-back).tolist()), tuple(up.tolist()), float(model.cam_fovy[i])
    )


def pair(eye: Eye, distance: float = 0.008, overlap: float = 57.0) -> tuple[Eye, Eye]:
    """Returns a left and a right eye on both sides of one, turned outwards about its `up`.

    Args:
      eye: in the middle.
      distance: between the two [m].
      overlap: of their fields of view [degrees]; `eye.fovy` if they look the same way.

    Raises:
      ValueError: the overlap is not 0 to `eye.fovy`.
    """
    if not 0.0 <= overlap <= eye.fovy:
        raise ValueError(f"overlap is {overlap}; give degrees, 0 to the eye's fovy, {eye.fovy}.")
    outwards = math.radians(eye.fovy - overlap) / 2
    right, up, back = axes_of(eye).T

    def turned(side: int) -> Eye:
        direction = side * math.sin(outwards) * right - math.cos(outwards) * back
        position = np.array(eye.position) + side * distance / 2 * right
        return dataclasses.replace(
            eye,
            position=tuple(position.tolist()),
            direction=tuple(direction.tolist()),
            up=tuple(up.tolist()),
        )

    return turned(-1), turned(1)


def axes_of(eye: Eye) -> np.ndarray:
    """Returns an eye's axes in its body's frame, [3, 3]; columns: right, up, backwards."""
    back = -np.array(eye.direction) / np.linalg.norm(eye.direction)
    right = np.cross(eye.up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


def place(model: mujoco.MjModel, eye: Eye) -> Place:
    """Looks an eye's body up."""
    body = lookup.find(model, "body", eye.body)
    return Place(body, np.array(eye.position, np.float32), axes_of(eye).astype(np.float32))


def rays(fovy: float, size: tuple[int, int]) -> np.ndarray:
    """Returns [2, H * W] float32: how far right and up each pixel's ray goes in 1 m ahead [m].

    Rays go through the middle of their pixels, by rows from the upper left.
    """
    height, width = size
    half = math.tan(math.radians(fovy) / 2)
    right = (np.arange(width) + 0.5) * 2 / width - 1
    up = 1 - (np.arange(height) + 0.5) * 2 / height
    grid = np.meshgrid(half * width / height * right, half * up)
    return np.stack([x.ravel() for x in grid]).astype(np.float32)
