"""From the servo angles to the axle angles of the bicycle that moves like the body, and back.

An axle angle is everywhere that of an equivalent bicycle: its two wheels at these angles give the body's curvature and
sideslip exactly (``FourWheelSteering``). ``IdealAxles`` have wheels that share one ICR, so each axle's angle is its
own. The wheels of ``LinkedAxles`` share none: the body makes their least-squares motion (``linkage.common_motion``),
which turns less than the mean of the wheels' tangents says (4WS at full lock by a tenth), and each axle's angle depends
on the other a little. ``TurnDeficit`` refines that.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import (
    Array,
    KinematicsError,
    Real,
    atan,
    clip,
    interpolated,
    require_finite,
    require_within,
    smaller,
    tan,
    where_positive,
)
from monstertruck_kinematics.linkage import least_squares_motion
from monstertruck_kinematics.polynomials import SERVO_LIMIT, AxlePolynomials, SteeringPolynomials
from monstertruck_kinematics.truck import MAX_AXLE_ANGLE, FourWheelSteering

Range = tuple[float, float]
"""Least and greatest servo angle, rad: to the right (negative) and to the left."""

FULL: Final[Range] = (-SERVO_LIMIT, SERVO_LIMIT)

_ROUNDS: Final = 30
_CONVERGED: Final = 1e-11
_MISS: Final = 1e-3
"""Tangent by which a clamped servo may miss an axle angle on the edge of its reach."""


@dataclass(frozen=True, slots=True)
class TurnDeficit:
    """What the axles turn less than the linkage says: dimensionless, 0 = as it says.

    The tangent t of an axle angle becomes t (1 - c t^2), with a coefficient c for each axle and side; where the axles
    oppose each other, the turn becomes turn (1 + c t_f t_r), with a coefficient for each side to which the body turns.
    """

    front_left: float = 0.0
    front_right: float = 0.0
    rear_left: float = 0.0
    rear_right: float = 0.0
    counter_left: float = 0.0
    counter_right: float = 0.0

    def __post_init__(self) -> None:
        for coefficient in fields(self):
            require_finite(f"turn deficit {coefficient.name}", getattr(self, coefficient.name))

    def tangents(self, front: Real, rear: Real) -> tuple[Real, Real]:
        """Tangents of both axle angles (geometric centre), from those by the linkage."""
        front = front * (1.0 - where_positive(front, self.front_left, self.front_right) * (front * front))
        rear = rear * (1.0 - where_positive(rear, self.rear_left, self.rear_right) * (rear * rear))
        half = 0.5 * (front - rear)
        lost = half * where_positive(half, self.counter_left, self.counter_right) * smaller(front * rear, 0.0)
        return front + lost, rear - lost


@dataclass(frozen=True)
class Axles(ABC):
    """The steered axles of a body.

    Args:
        ranges: of the front and rear servo angle that the servo controller's pulses reach.
    """

    ranges: tuple[Range, Range] = field(default=(FULL, FULL), kw_only=True)

    @abstractmethod
    def angles(self, front_servo: Real, rear_servo: Real) -> tuple[Real, Real]:
        """Axle angles (front, rear) at servo angles, which are clamped to the linkage's range."""

    @abstractmethod
    def servos(self, front: float, rear: float) -> tuple[float, float]:
        """Servo angles for axle angles: exact inverse of ``angles``.

        Raises:
            KinematicsError: out of the linkage's reach, or NaN.
        """


@dataclass(frozen=True)
class IdealAxles(Axles):
    """Axles whose wheels share one ICR: the linkage decides the angle of each axle only.

    Args:
        polynomials: servo to axle.
    """

    polynomials: SteeringPolynomials

    def angles(self, front_servo: Real, rear_servo: Real) -> tuple[Real, Real]:
        """Mean of each axle's tangents."""
        front, rear = self.polynomials.front, self.polynomials.rear
        return (
            front.axle_from_servo(clip(front_servo, -front.servo_limit, front.servo_limit)),
            rear.axle_from_servo(clip(rear_servo, -rear.servo_limit, rear.servo_limit)),
        )

    def servos(self, front: float, rear: float) -> tuple[float, float]:
        """Of each axle by itself."""
        return self.polynomials.servo_from_axles(front, rear)


@dataclass(frozen=True)
class LinkedAxles(Axles):
    """Axles whose wheels stand as the fitted polynomials say.

    Args:
        geometry: of the body; its reference point is the middle between the axles.
        front: servo to wheels.
        rear: servo to wheels; None = its wheels are fixed straight ahead, and the rear axle angle is 0: the front one
            gives the turn, the sideslip of the rear axle's middle (0.5 deg at full lock) is neglected.
        deficit: what the axles turn less.
    """

    geometry: FourWheelSteering
    front: AxlePolynomials
    rear: AxlePolynomials | None
    deficit: TurnDeficit | None = None

    def wheel_angles(self, front_servo: Real, rear_servo: Real) -> tuple[Real, Real, Real, Real]:
        """Angles of the four wheels, front left, front right, rear left, rear right, at clamped servo angles."""
        front = clip(front_servo, -self.front.servo_limit, self.front.servo_limit)
        left, right = self.front.wheels_from_servo(front)
        axle = self.rear
        if axle is None:
            return left, right, 0.0 * left, 0.0 * left
        rear_left, rear_right = axle.wheels_from_servo(clip(rear_servo, -axle.servo_limit, axle.servo_limit))
        return left, right, rear_left, rear_right

    def angles(self, front_servo: Real, rear_servo: Real) -> tuple[Real, Real]:
        """Of the bicycle that makes the wheels' least-squares motion."""
        front, rear = self._tangents(front_servo, rear_servo)
        return atan(front), atan(rear)

    def _tangents(self, front_servo: Real, rear_servo: Real) -> tuple[Real, Real]:
        slide, turn = least_squares_motion(self.geometry, self.wheel_angles(front_servo, rear_servo))
        if self.rear is None:
            front, rear = self.geometry.wheelbase * turn, 0.0 * turn
        else:
            front, rear = slide + self.geometry.l_f * turn, slide - self.geometry.l_r * turn
        return (front, rear) if self.deficit is None else self.deficit.tangents(front, rear)

    def servos(self, front: float, rear: float) -> tuple[float, float]:
        """By Broyden's method from the slopes of the mean tangents."""
        require_within("front", front, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        require_within("rear", rear, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        target_f, target_r = tan(front), tan(rear)
        limit_f = self.front.servo_limit
        limit_r = 0.0 if self.rear is None else self.rear.servo_limit
        slope_f = self.front.left_from_servo[-2]
        slope_r = slope_f if self.rear is None else self.rear.left_from_servo[-2]
        # Inverse of the Jacobian by the servo angles.
        ff, fr, rf, rr = 1.0 / slope_f, 0.0, 0.0, 1.0 / slope_r
        servo_f, servo_r = 0.0, 0.0
        got_f, got_r = self._tangents(servo_f, servo_r)
        for _ in range(_ROUNDS):
            off_f, off_r = target_f - got_f, target_r - got_r
            if abs(off_f) + abs(off_r) < _CONVERGED:
                break
            new_f = min(max(servo_f + ff * off_f + fr * off_r, -limit_f), limit_f)
            new_r = min(max(servo_r + rf * off_f + rr * off_r, -limit_r), limit_r)
            step_f, step_r = new_f - servo_f, new_r - servo_r
            if step_f == 0.0 == step_r:
                break
            then_f, then_r = got_f, got_r
            servo_f, servo_r = new_f, new_r
            got_f, got_r = self._tangents(servo_f, servo_r)
            change_f, change_r = got_f - then_f, got_r - then_r
            ahead_f, ahead_r = ff * change_f + fr * change_r, rf * change_f + rr * change_r
            scale = step_f * ahead_f + step_r * ahead_r
            if scale == 0.0:
                break
            left_f, left_r = (step_f - ahead_f) / scale, (step_r - ahead_r) / scale
            row_f, row_r = step_f * ff + step_r * rf, step_f * fr + step_r * rr
            ff, fr = ff + left_f * row_f, fr + left_f * row_r
            rf, rr = rf + left_r * row_f, rr + left_r * row_r
        if not abs(target_f - got_f) + abs(target_r - got_r) < _MISS:
            raise KinematicsError(f"front is {front:.6g}, rear is {rear:.6g}: out of the steering linkage's reach")
        return servo_f, servo_r


class Reach:
    """Motions that two steered axles reach: the sideslips of every curvature.

    The ranges of the servos are a rectangle, its picture in curvature and sideslip of the base a region between two
    curves over the curvature, each along two of the rectangle's edges.

    Args:
        geometry: of the body, its reference point the base.
        axles: with their ranges.
    """

    _POINTS: Final = 33

    def __init__(self, geometry: FourWheelSteering, axles: Axles) -> None:
        self._geometry = geometry
        (low_f, high_f), (low_r, high_r) = axles.ranges
        forth_f, forth_r = np.linspace(low_f, high_f, self._POINTS), np.linspace(low_r, high_r, self._POINTS)
        stay = np.ones(self._POINTS)

        def curve(front: Array, rear: Array) -> tuple[list[float], list[float]]:
            angles = axles.angles(front, rear)
            curvature = np.maximum.accumulate(geometry.curvature(*angles))
            return curvature.tolist(), geometry.sideslip(*angles).tolist()

        # From the tightest curve to the right to the tightest to the left, past the crab to the right and to the left.
        self._right = curve(np.append(low_f * stay, forth_f), np.append(forth_r[::-1], low_r * stay))
        self._left = curve(np.append(forth_f, high_f * stay), np.append(high_r * stay, forth_r[::-1]))
        self.curvatures = self._right[0][0], self._right[0][-1]
        """Tightest to the right (negative) and to the left, 1/m."""

    def limited(self, front: float, rear: float) -> tuple[float, float]:
        """Axle angles within reach that keep the curvature, then the sideslip, as far as possible.

        Angles within reach come back as they were.
        """
        wanted, slip = self._geometry.curvature(front, rear), self._geometry.sideslip(front, rear)
        curvature = clip(wanted, *self.curvatures)
        low, high = interpolated(curvature, *self._right), interpolated(curvature, *self._left)
        kept = clip(slip, low, high)
        if curvature == wanted and kept == slip:
            return front, rear
        return self._geometry.steer_for(curvature, kept)
