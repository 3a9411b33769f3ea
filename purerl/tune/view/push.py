"""A push or a pull at a point of a body, as a change of velocities; pure."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

# How fast a pull draws its point to the pointer, and that no faster than it can settle [rad/s].
PULL_RATE = 8.0


class Grip(NamedTuple):
    """A point of a body, held by the pointer."""

    body: int
    point: np.ndarray  # [3] in the body's own frame [m]
    target: np.ndarray  # [3] where the pointer is, in the world [m]


def place(model: mujoco.MjModel, qpos: Any, qvel: Any) -> mujoco.MjData:
    """Returns MuJoCo's data with all that a push needs: frames, velocities and the mass matrix."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return data


def push(model: mujoco.MjModel, data: mujoco.MjData, body: int, point: Any, dv: Any) -> np.ndarray:
    """Returns the change of `qvel` [nv] by the impulse that moves a point by a velocity.

    With the point's Jacobian J the impulse p solves (J M^-1 J') p = dv, by least squares where the
    body cannot move so (a cart on its rail), and qvel changes by M^-1 J' p. So a push is given in
    m/s, for a rat as for a human.

    Args:
      model: the model.
      data: of `place`.
      body: the body that is pushed.
      point: [3] where, in the world [m].
      dv: [3] the wished change of that point's velocity [m/s].
    """
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, np.asarray(point, float), body)
    moved = np.zeros((3, model.nv))
    mujoco.mj_solveM(model, data, moved, jacobian)  # rows of M^-1 J'
    # Directions in which the point hardly yields are left out: they would take huge impulses.
    impulse = np.linalg.lstsq(jacobian @ moved.T, np.asarray(dv, float), rcond=1e-3)[0]
    return moved.T @ impulse


def pull(model: mujoco.MjModel, data: mujoco.MjData, grip: Grip, seconds: float) -> np.ndarray:
    """Returns the change of `qvel` [nv] as a damped spring to the pointer acts for `seconds`."""
    point = data.xpos[grip.body] + data.xmat[grip.body].reshape(3, 3) @ grip.point
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jacobian, None, point, grip.body)
    rate = min(PULL_RATE, 0.5 / seconds)
    wanted = rate**2 * (grip.target - point) - 2 * rate * (jacobian @ data.qvel)
    return push(model, data, grip.body, point, wanted * seconds)


def grip(data: mujoco.MjData, body: int, start: Any, target: Any) -> Grip:
    """Returns a hold of a body at the point `start`, drawn to `target`, [3] in the world [m]."""
    rotation = data.xmat[body].reshape(3, 3)
    return Grip(body, rotation.T @ (np.asarray(start) - data.xpos[body]), np.asarray(target, float))
