"""Splines through few knots: a plan's actions are linear in its knots, whatever the kind.

So a spline is a matrix, made once: actions [H, A] = weights [H, K] @ knots [K, A].
"""

import numpy as np
from scipy import interpolate

KINDS = ("zero", "linear", "cubic")  # the first two by their degree


def knot_times(kind: str, horizon: int, knots: int) -> np.ndarray:
    """Returns the times of K evenly spaced knots, [K] control steps from the plan's first action.

    The last knot of a zero-order spline lasts as long as the others; of the other kinds, it is the
    plan's last action.
    """
    end = horizon if kind == "zero" else max(horizon - 1, 1)
    return np.linspace(0.0, end, knots, endpoint=kind != "zero")


def weights(kind: str, times: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Returns the matrix that takes knots to the values of their spline at `times`, [H, K] float32.

    With u = (t - t_k) / (t_{k+1} - t_k), for t from t_k to t_{k+1}:

      zero:    y = y_k
      linear:  y = (1 - u) y_k + u y_{k+1}
      cubic:   y = (2u^3 - 3u^2 + 1) y_k + (3u^2 - 2u^3) y_{k+1}
                   + h (u^3 - 2u^2 + u) m_k + h (u^3 - u^2) m_{k+1}

    The slopes m of the cubic (Hermite) spline are finite differences: the mean of the slopes on
    both sides of a knot, one-sided at the ends, as in MuJoCo MPC. Beyond the last knot a spline
    keeps its value.

    Args:
      kind: of `KINDS`.
      times: [H] of the values.
      knots: [K] of the knots, increasing; at least 2.
    """
    times, one = np.clip(times, knots[0], knots[-1]), np.eye(len(knots))
    if kind == "cubic":
        secants = np.diff(one, axis=0) / np.diff(knots)[:, None]
        slopes = np.concatenate([secants[:1], (secants[:-1] + secants[1:]) / 2.0, secants[-1:]])
        spline = interpolate.CubicHermiteSpline(knots, one, slopes)
    else:
        spline = interpolate.make_interp_spline(knots, one, k=KINDS.index(kind))
    return spline(times).astype(np.float32)
