"""Fitted steering polynomials of the truck (thesis eq. 2.8): servo angle, wheel angles and the axle's bicycle angle.

Angles in rad. A positive servo angle turns its axle's wheels to the left, on both axles. Only servo -> left wheel (f)
and left -> right wheel (g) are used as fitted; the other direction is their exact inverse, so a round trip is exact.
The rear axle is the front one mirrored front to back with its servo reversed: both the value and the argument
change sign, delta_LR = -f(-theta_R), delta_RR = -g(-delta_LR).
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from monstertruck_kinematics.elementary import KinematicsError, Real, atan, clip, polynomial, require_within, tan

Coefficients = tuple[float, ...]
PolynomialSet = Literal["corrected", "as_published", "2016"]

SERVO_LIMIT = math.pi / 4.0
"""The servo command is clamped to +-45 deg; no polynomial of the sources is valid beyond."""

F_CORRECTED: Coefficients = (-0.0082, -0.0162, -0.0605, -0.0192, 0.6691, 0.0)
F_PRINTED: Coefficients = (*F_CORRECTED[:2], F_CORRECTED[2] / 10, *F_CORRECTED[3:])


def mirrored(coefficients: Coefficients) -> Coefficients:
    """Coefficients of -p(-x): the even powers change sign."""
    top = len(coefficients) - 1
    return tuple(c if (top - i) % 2 else -c for i, c in enumerate(coefficients))


def derivative(coefficients: Coefficients) -> Coefficients:
    """Coefficients of the derivative, highest power first."""
    top = len(coefficients) - 1
    return tuple(c * (top - i) for i, c in enumerate(coefficients[:-1]))


@dataclass(frozen=True)
class AxlePolynomials:
    """Steering of one axle.

    Args:
        left_from_servo: f, highest power first.
        right_from_left: g, highest power first.
        servo_limit: largest servo angle to either side, rad; larger ones raise.

    Raises:
        KinematicsError: f or the axle angle is not strictly increasing over the servo's range.
    """

    left_from_servo: Coefficients
    right_from_left: Coefficients
    servo_limit: float = SERVO_LIMIT
    axle_limits: tuple[float, float] = field(init=False)
    """Axle angles at the servo's two ends, (right, left) = (negative, positive)."""
    _slopes: tuple[Coefficients, Coefficients] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        slopes = (derivative(self.left_from_servo), derivative(self.right_from_left))
        object.__setattr__(self, "_slopes", slopes)
        servo = np.linspace(-self.servo_limit, self.servo_limit, 181)
        left = polynomial(self.left_from_servo, servo)
        axle = self.axle_from_left(left)
        if not (np.diff(left) > 0.0).all() or not (np.diff(axle) > 0.0).all():
            raise KinematicsError(
                "left_from_servo, right_from_left: expected angles that increase with the servo angle"
            )
        object.__setattr__(self, "axle_limits", (float(axle[0]), float(axle[-1])))

    def left_of(self, servo: Real) -> Real:
        """Left wheel angle at a servo angle (f)."""
        require_within("servo", servo, -self.servo_limit, self.servo_limit)
        return polynomial(self.left_from_servo, servo)

    def right_of(self, left: Real) -> Real:
        """Right wheel angle at the left wheel angle ``left`` (g)."""
        return polynomial(self.right_from_left, left)

    def wheels_from_servo(self, servo: Real) -> tuple[Real, Real]:
        """Left and right wheel angles at a servo angle."""
        left = self.left_of(servo)
        return left, self.right_of(left)

    def axle_from_left(self, left: Real) -> Real:
        """Bicycle angle of the axle at the left wheel angle ``left``.

        Mean of the two wheels' tangents: the average of both no-slip conditions at the axle's middle. The mean
        of cotangents (eq. 2.35) is the same for ideal wheels near straight and has a pole here, because g(0) is not 0.
        """
        return atan(0.5 * (tan(left) + tan(polynomial(self.right_from_left, left))))

    def axle_from_servo(self, servo: Real) -> Real:
        """Bicycle angle of the axle at a servo angle.

        Raises:
            KinematicsError: |servo| beyond ``servo_limit``, or NaN.
        """
        return self.axle_from_left(self.left_of(servo))

    def mirrored(self) -> "AxlePolynomials":
        """Return the polynomials of an axle that turns the other way."""
        return AxlePolynomials(mirrored(self.left_from_servo), mirrored(self.right_from_left), self.servo_limit)

    def servo_from_axle(self, axle: Real) -> Real:
        """Exact inverse of ``axle_from_servo``.

        Raises:
            KinematicsError: outside ``axle_limits``, or NaN.
        """
        require_within("axle", axle, *self.axle_limits)
        target = tan(axle)
        f, g = self.left_from_servo, self.right_from_left
        df, dg = self._slopes
        servo = clip(axle / f[-2], -self.servo_limit, self.servo_limit)
        for _ in range(30):  # Newton steps
            left = polynomial(f, servo)
            left_tangent, right_tangent = tan(left), tan(polynomial(g, left))
            error = 0.5 * (left_tangent + right_tangent) - target
            slope = 1.0 + left_tangent * left_tangent + (1.0 + right_tangent * right_tangent) * polynomial(dg, left)
            moved = clip(servo - 2.0 * error / (slope * polynomial(df, servo)), -self.servo_limit, self.servo_limit)
            done = _converged(moved, servo)
            servo = moved
            if done:
                break
        return servo


def _printed(left_from_servo: Coefficients) -> AxlePolynomials:
    """Front axle with the right wheel as printed."""
    return AxlePolynomials(left_from_servo, (0.0126, -0.0432, 0.0067, -0.0851, 0.9997, 0.0035))


def _converged(new: Real, old: Real) -> bool:
    """Whether Newton's method has converged (quadratic, so the error of the last iterate is below rounding)."""
    change = new - old
    if isinstance(change, np.ndarray):
        return bool((np.abs(change) < 1e-9).all())
    return abs(change) < 1e-9


@dataclass(frozen=True)
class SteeringPolynomials:
    """Both steered axles of the truck; ``named`` builds the sources' sets, the default is the corrected one."""

    front: AxlePolynomials = field(default_factory=lambda: _printed(F_CORRECTED))
    rear: AxlePolynomials = field(default_factory=lambda: _printed(F_CORRECTED).mirrored())

    @classmethod
    def named(cls, name: PolynomialSet) -> "SteeringPolynomials":
        """One of the sources' sets.

        ``corrected``: eq. 2.8 with the cubic term of f at -0.0605. ``as_published``: with the printed -0.00605 (the
        rear axle still properly mirrored: the printed rear lines turn the two rear wheels apart). ``2016``: the
        robot's quadratics of October 2016, the front one with its sign error corrected (-0.029).

        Raises:
            KinematicsError: no such set.
        """
        if name == "corrected":
            return cls()
        if name == "as_published":
            return cls(_printed(F_PRINTED), _printed(F_PRINTED).mirrored())
        if name == "2016":
            right_from_left = (-0.0058, 1.0203, 0.0)
            return cls(
                AxlePolynomials((-0.029, 0.6515, 0.0006), right_from_left),
                AxlePolynomials((-0.014, 0.6515, -0.0002), right_from_left),
            )
        raise KinematicsError(f"polynomials {name!r}: expected corrected, as_published or 2016")

    def servo_from_axles(self, front: Real, rear: Real) -> tuple[Real, Real]:
        """Servo angles (front, rear) for the two axle angles."""
        return self.front.servo_from_axle(front), self.rear.servo_from_axle(rear)
