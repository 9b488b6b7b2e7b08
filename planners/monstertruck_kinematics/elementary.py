"""Elementary functions and rigid motion in the plane, for a float or an array.

Floats go through ``math`` (fast enough for a control tick), arrays through numpy.
"""

import bisect
import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Floats, of the shape that is stated where it is used."""
Real = TypeVar("Real", float, Array)
"""Float or array of any shape; all arguments of one call are of the same kind or broadcast."""


class KinematicsError(ValueError):
    """Impossible argument, wheel or parameter; the text gives its name, its value and the expected value."""


def sin(x: Real) -> Real:
    """Sine."""
    if isinstance(x, np.ndarray):
        return np.sin(x)
    return math.sin(x)


def cos(x: Real) -> Real:
    """Cosine."""
    if isinstance(x, np.ndarray):
        return np.cos(x)
    return math.cos(x)


def tan(x: Real) -> Real:
    """Tangent."""
    if isinstance(x, np.ndarray):
        return np.tan(x)
    return math.tan(x)


def atan(x: Real) -> Real:
    """Arc tangent in (-pi/2, pi/2)."""
    if isinstance(x, np.ndarray):
        return np.arctan(x)
    return math.atan(x)


def atan2(y: Real, x: Real) -> Real:
    """Angle of (x, y) in [-pi, pi]."""
    if isinstance(y + x, np.ndarray):
        return np.arctan2(y, x)
    return math.atan2(y, x)


def asin(x: Real) -> Real:
    """Arc sine in [-pi/2, pi/2]."""
    if isinstance(x, np.ndarray):
        return np.arcsin(x)
    return math.asin(x)


def sqrt(x: Real) -> Real:
    """Square root."""
    if isinstance(x, np.ndarray):
        return np.sqrt(x)
    return math.sqrt(x)


def hypot(x: Real, y: Real) -> Real:
    """Length of (x, y)."""
    if isinstance(x + y, np.ndarray):
        return np.hypot(x, y)
    return math.hypot(x, y)


def secant(tangent: Real) -> Real:
    """1/cos of the angle in (-90, 90) deg that has this tangent."""
    square = tangent * tangent
    square += 1.0
    if isinstance(square, np.ndarray):
        return np.sqrt(square, out=square)
    return math.sqrt(square)


def signed_hypot(x: Real, y: Real) -> Real:
    """Length of (x, y) with the sign of x."""
    length = hypot(x, y)
    if isinstance(length, np.ndarray):
        return np.copysign(length, x, out=length)
    return math.copysign(length, x)


def sign(x: Real) -> Real:
    """+1 for x >= 0 (and +0.0), -1 otherwise: never 0, so that a product keeps its size."""
    if isinstance(x, np.ndarray):
        return np.copysign(1.0, x)
    return math.copysign(1.0, x)


def clip(x: Real, low: Real | float, high: Real | float) -> Real:
    """X limited to [low, high]."""
    return smaller(larger(x, low), high)


def larger(a: Real, b: Real | float) -> Real:
    """Maximum, element by element."""
    if isinstance(a + b, np.ndarray):
        return np.maximum(a, b)
    return max(a, b)


def smaller(a: Real, b: Real | float) -> Real:
    """Minimum, element by element."""
    if isinstance(a + b, np.ndarray):
        return np.minimum(a, b)
    return min(a, b)


def where_positive(x: Real, positive: float, other: float) -> Real:
    """``positive`` where x is above 0, ``other`` elsewhere."""
    if isinstance(x, np.ndarray):
        return np.where(x > 0.0, positive, other)
    return positive if x > 0.0 else other


def sinc(x: Real) -> Real:
    """sin(x)/x, 1 at 0."""
    if isinstance(x, np.ndarray):
        return np.sinc(x / np.pi)
    return math.sin(x) / x if abs(x) > 1e-4 else 1.0 - x * x / 6.0


def sinc_slope(x: Real) -> Real:
    """Derivative of sinc, (cos x - sinc x)/x, by its series where that cancels."""
    if isinstance(x, np.ndarray):
        small = np.abs(x) < 1e-3
        away = np.where(small, 1.0, x)
        return np.where(small, -x / 3.0 * (1.0 - x**2 / 10.0), (np.cos(away) - np.sinc(away / np.pi)) / away)
    return (math.cos(x) - math.sin(x) / x) / x if abs(x) >= 1e-3 else -x / 3.0 * (1.0 - x**2 / 10.0)


def polynomial(coefficients: tuple[float, ...], x: Real) -> Real:
    """Value of the polynomial at x, highest power first (Horner)."""
    value = 0.0 * x + coefficients[0]
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value


def interpolated(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Interpolate linearly between points (as ``np.interp`` for one value, at lower cost).

    Args:
        x: position; beyond the ends the value at the end is used.
        xs: positions of the points, not decreasing.
        ys: values of the points.
    """
    i = bisect.bisect_right(xs, x)
    if i == 0 or i == len(xs):
        return ys[max(i - 1, 0)]
    slope = (ys[i] - ys[i - 1]) / (xs[i] - xs[i - 1])
    return slope * (x - xs[i - 1]) + ys[i - 1]


def require_finite(name: str, x: Real) -> None:
    """Refuse NaN and infinity.

    Raises:
        KinematicsError: naming the argument, and the first bad element of an array.
    """
    if isinstance(x, np.ndarray):
        if x.size and not (-np.inf < x.min() and x.max() < np.inf):
            first = int(np.flatnonzero(~np.isfinite(x))[0])
            raise KinematicsError(f"{name}[{first}] is {x.flat[first]}: expected a finite number")
    elif not math.isfinite(x):
        raise KinematicsError(f"{name} is {x}: expected a finite number")


def require_within(name: str, x: Real, low: float, high: float) -> None:
    """Refuse values outside [low, high], NaN included.

    Raises:
        KinematicsError: naming the argument, the value and the range.
    """
    if isinstance(x, np.ndarray):
        if x.size and not (low <= x.min() and x.max() <= high):
            first = int(np.flatnonzero(~((x >= low) & (x <= high)))[0])
            raise KinematicsError(f"{name}[{first}] is {x.flat[first]}: expected {low:.6g} to {high:.6g}")
    elif not low <= x <= high:
        raise KinematicsError(f"{name} is {x}: expected {low:.6g} to {high:.6g}")


def require_positive(name: str, value: float) -> None:
    """Refuse a length, ratio or count that is not finite and above zero.

    Raises:
        KinematicsError: naming the field.
    """
    if not (math.isfinite(value) and value > 0.0):
        raise KinematicsError(f"{name} is {value}: expected a finite number above 0")


def nonzero(x: Real) -> Real:
    """X with every 0 replaced by 1: a safe divisor where the numerator is 0 as well."""
    if isinstance(x, np.ndarray):
        return np.where(x == 0.0, 1.0, x)
    return x if x != 0.0 else 1.0


def all_positive(x: Real) -> bool:
    """Whether x, or every element of it, is above 0."""
    if isinstance(x, np.ndarray):
        return bool((x > 0.0).all())
    return x > 0.0


def any_zero(x: Real) -> bool:
    """Whether x, or any element of it, is exactly 0."""
    if isinstance(x, np.ndarray):
        return not x.all()
    return x == 0.0


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Rotation from a device's axes to its body's, (3, 3): yaw, then pitch, then roll (REP 103), rad."""
    cy, sy, cp, sp, cr, sr = (f(v) for v in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )
