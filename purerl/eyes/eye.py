"""Eyes on a body: where they are, and the rays of their pixels."""

import dataclasses
import math

import mujoco
import numpy as np

from purerl.physics import lookup

Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Eye:
    """A camera on a body; its picture is upright where the body is."""

    body: str
    """Name of the body that carries it."""
    position: Vector = (0.0, 0.0, 0.0)
    """In the body's frame [m]."""
    direction: Vector = (1.0, 0.0, 0.0)
    """Along which it looks, in the body's frame, of any length."""
    up: Vector = (0.0, 0.0, 1.0)
    """What is above in its picture, in the body's frame, of any length."""
    fovy: float = 80.0
    """Angle between the picture's upper and lower edge [degrees]."""

    def __post_init__(self) -> None:
        """Refuses what sees nothing."""
        if not 5.0 <= self.fovy < 180.0:  # no angle in radians is as much
            raise ValueError(f"fovy is {self.fovy}; give degrees, 5 to less than 180.")
        for name in ("position", "direction", "up"):
            if np.shape(given := getattr(self, name)) != (3,) or not np.isfinite(given).all():
                raise ValueError(f"{name} is {given}; give three finite numbers.")
        if np.linalg.norm(np.cross(self.direction, self.up)) < 1e-6:
            raise ValueError(
                f"direction {self.direction} and up {self.up} are parallel or 0: the picture has "
                "no upper side. Give two different directions."
            )

    @property
    def axes(self) -> np.ndarray:
        """[3, 3] in the body's frame; columns: right, up, backwards, as of MuJoCo's cameras."""
        back = -np.array(self.direction) / np.linalg.norm(self.direction)
        right = np.cross(self.up, back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(back, right), back], axis=1)


def of_camera(model: mujoco.MjModel, name: str) -> Eye:
    """Returns the eye of an MJCF camera, which is fixed to its body.

    Raises:
      ValueError: there is none of that name (the message lists them), or it follows something.
    """
    i = lookup.find(model, "camera", name)
    if model.cam_mode[i] != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
        raise ValueError(f"Camera {name!r} follows a body; an eye needs one of mode 'fixed'.")
    _, up, back = rotation(model.cam_quat[i]).T
    body, fovy = model.body(model.cam_bodyid[i]).name, float(model.cam_fovy[i])
    return Eye(body, _vector(model.cam_pos[i]), _vector(-back), _vector(up), fovy)


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
    right, up, back = eye.axes.T

    def turned(side: int) -> Eye:
        direction = side * math.sin(outwards) * right - math.cos(outwards) * back
        position = eye.position + side * distance / 2 * right
        return Eye(eye.body, _vector(position), _vector(direction), _vector(up), eye.fovy)

    return turned(-1), turned(1)


def rays(fovy: float, size: tuple[int, int]) -> np.ndarray:
    """Returns [2, H * W] float32: how far right and up each pixel's ray goes in 1 m ahead [m].

    Rays go through the middle of their pixels, by rows from the upper left.
    """
    height, width = size
    half = math.tan(math.radians(fovy) / 2)
    right = (2 * np.arange(width) + 1 - width) / height
    up = (height - 1 - 2 * np.arange(height)) / height
    return half * np.stack(np.meshgrid(right, up)).reshape(2, -1).astype(np.float32)


def rotation(quat: np.ndarray) -> np.ndarray:
    """Returns the rotation of a quaternion [4] as a matrix [3, 3]."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _vector(x: np.ndarray) -> Vector:
    first, second, third = x.tolist()
    return first, second, third
