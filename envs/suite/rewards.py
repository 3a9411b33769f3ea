"""How near a value is to where it should be, from 0 to 1: the shape of all suite rewards."""

import jax.numpy as jnp
import numpy as np

from purerl import Array

SIGMOIDS = ("gaussian", "hyperbolic", "linear", "long_tail", "quadratic")


def tolerance(
    x: Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> Array:
    """Returns 1 within bounds, falling towards 0 outside.

    With d the distance to the bounds in units of the margin, and v = `value_at_margin` (Tassa et
    al. 2018, DeepMind Control Suite, section 3):

      gaussian    exp(-(d s)^2 / 2), s = sqrt(-2 ln v)
      hyperbolic  1 / cosh(d s),     s = arccosh(1 / v)
      long_tail   1 / (1 + (d s)^2), s = sqrt(1 / v - 1)
      linear      max(0, 1 - d s),   s = 1 - v
      quadratic   max(0, 1 - (d s)^2), s = sqrt(1 - v)

    Args:
      x: [...] the value.
      bounds: (least, greatest) where it is worth 1; they can be infinite or equal.
      margin: the distance at which it is worth v, in units of x; 0 is a step.
      sigmoid: the shape, of `SIGMOIDS`.
      value_at_margin: v; may be 0 for linear and quadratic.

    Raises:
      ValueError: bounds in the wrong order, a negative margin, an unknown shape, v out of range.
    """
    low, high = bounds
    if low > high or margin < 0:
        raise ValueError(f"bounds {bounds}, margin {margin}: give least <= greatest, margin >= 0.")
    _check_sigmoid(sigmoid, value_at_margin)
    inside = (low <= x) & (x <= high)
    if margin == 0:
        return jnp.where(inside, 1.0, 0.0)
    away = jnp.where(x < low, low - x, x - high) / margin
    return jnp.where(inside, 1.0, _fall(away, value_at_margin, sigmoid))


def _fall(d: Array, v: float, sigmoid: str) -> Array:
    if sigmoid == "gaussian":
        return jnp.exp(-0.5 * (d * np.sqrt(-2 * np.log(v))) ** 2)
    if sigmoid == "hyperbolic":
        return 1 / jnp.cosh(d * np.arccosh(1 / v))
    if sigmoid == "long_tail":
        return 1 / (1 + (d * np.sqrt(1 / v - 1)) ** 2)
    if sigmoid == "linear":
        return jnp.maximum(0.0, 1 - d * (1 - v))
    return jnp.maximum(0.0, 1 - (1 - v) * d**2)


def _check_sigmoid(sigmoid: str, v: float) -> None:
    if sigmoid not in SIGMOIDS:
        raise ValueError(f"There is no sigmoid {sigmoid!r}. There are: {', '.join(SIGMOIDS)}.")
    if not (0 < v < 1 or v == 0 and sigmoid in ("linear", "quadratic")):
        raise ValueError(
            f"value_at_margin is {v}: it lies between 0 and 1, and may be 0 for linear and "
            "quadratic only."
        )
