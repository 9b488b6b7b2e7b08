"""The truck: drivetrain, fitted steering and four-wheel-steer kinematics (thesis eqs. 2.1 and 2.27-2.56, corrected).

Frames: x forward, y left, angles positive to the left, rad. Wheels are ordered front left, front right, rear left,
rear right. Speed is signed along the direction of travel of the reference point C. Everything is in curvature form:
straight ahead and crab need no special cases. Every function takes floats or arrays.

An axle angle always belongs to an equivalent bicycle: its two wheels at these angles give the body's curvature and
sideslip exactly (``FourWheelSteering``). ``IdealAxles`` have wheels that share one ICR, so each axle's angle is its
own. The wheels of ``LinkedAxles`` share none: the body makes their least-squares motion (``least_squares_motion``),
which turns less than the mean of the wheels' tangents (4WS at full lock by a tenth), and each axle's angle depends
on the other a little. ``TurnDeficit`` refines that.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from typing import Final, Literal

import numpy as np

from monstertruck_kinematics.elementary import (
    Array,
    KinematicsError,
    Real,
    all_positive,
    any_zero,
    asin,
    atan,
    atan2,
    clip,
    cos,
    hypot,
    interpolated,
    larger,
    nonzero,
    require_finite,
    require_positive,
    require_within,
    secant,
    sign,
    signed_hypot,
    sin,
    smaller,
    tan,
    where_positive,
)
from monstertruck_kinematics.polynomials import SERVO_LIMIT, AxlePolynomials, SteeringPolynomials
from monstertruck_kinematics.se2 import integrate

SteeringModeName = Literal["front", "rear", "counter", "crab", "spot"]

MAX_AXLE_ANGLE = math.radians(89.0)
"""Largest axle angle that the bicycle form accepts (tangents stay meaningful)."""

Range = tuple[float, float]
"""Minimum and maximum servo angle, rad: to the right (negative) and to the left."""

FULL: Final[Range] = (-SERVO_LIMIT, SERVO_LIMIT)


@dataclass(frozen=True)
class DriveTrain:
    """Motor to wheel (eq. 2.1): one motor, a fixed ratio, wheels of one radius, no slip.

    Args:
        ratio: motor turns per wheel turn.
        wheel_radius: m.

    Raises:
        KinematicsError: a field is not above zero.
    """

    ratio: float = 644.0
    wheel_radius: float = 0.075

    def __post_init__(self) -> None:
        require_positive("ratio", self.ratio)
        require_positive("wheel_radius", self.wheel_radius)

    def speed(self, motor_rate: Real) -> Real:
        """Ground speed of the wheels, m/s, at a motor rate in rad/s."""
        return motor_rate * (self.wheel_radius / self.ratio)

    def motor_rate(self, speed: Real) -> Real:
        """Motor rate in rad/s for a ground speed in m/s."""
        return speed * (self.ratio / self.wheel_radius)

    def distance(self, motor_angle: Real) -> Real:
        """Distance rolled, m, for a motor angle in rad."""
        return motor_angle * (self.wheel_radius / self.ratio)

    def motor_angle(self, distance: Real) -> Real:
        """Motor angle, rad, for a distance rolled in m."""
        return distance * (self.ratio / self.wheel_radius)


@dataclass(frozen=True)
class FourWheelSteering:
    """Kinematics of a body with two steered axles.

    Args:
        wheelbase: L, m.
        track: w, m.
        cg_split: l_f / L: where the reference point C lies, 0 on the front axle, 0.5 at the geometric centre, 1 on the
            rear axle.

    Raises:
        KinematicsError: a length is not above zero, or the split is outside 0 to 1.
    """

    wheelbase: float = 0.32
    track: float = 0.26
    cg_split: float = 0.5

    def __post_init__(self) -> None:
        require_positive("wheelbase", self.wheelbase)
        require_positive("track", self.track)
        require_within("cg_split", self.cg_split, 0.0, 1.0)

    @property
    def l_f(self) -> float:
        """Distance of C behind the front axle, m."""
        return self.cg_split * self.wheelbase

    @property
    def l_r(self) -> float:
        """Distance of C before the rear axle, m."""
        return self.wheelbase - self.l_f

    @property
    def wheel_positions(self) -> tuple[tuple[float, float], ...]:
        """The wheels' (x, y) in C's frame, m."""
        half = self.track / 2.0
        return ((self.l_f, half), (self.l_f, -half), (-self.l_r, half), (-self.l_r, -half))

    def _tangents(self, front: Real, rear: Real) -> tuple[Real, Real]:
        require_within("front", front, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        require_within("rear", rear, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        return tan(front), tan(rear)

    def tan_sideslip(self, tan_f: Real, tan_r: Real) -> Real:
        """(l_r tan d_f + l_f tan d_r)/L from the two axles' tangents (eq. 2.34)."""
        return (1.0 - self.cg_split) * tan_f + self.cg_split * tan_r

    def sideslip(self, front: Real, rear: Real) -> Real:
        """Angle from the body's x axis to C's direction of travel (eq. 2.34)."""
        tan_f, tan_r = self._tangents(front, rear)
        return atan(self.tan_sideslip(tan_f, tan_r))

    def curvature(self, front: Real, rear: Real) -> Real:
        """Curvature of C's path, 1/m, left positive: cos(beta) (tan d_f - tan d_r) / L (eqs. 2.38, 2.56)."""
        tan_f, tan_r = self._tangents(front, rear)
        tan_b = self.tan_sideslip(tan_f, tan_r)
        return (tan_f - tan_r) / (self.wheelbase * secant(tan_b))

    def body_twist(self, speed: Real, front: Real, rear: Real) -> tuple[Real, Real, Real]:
        """Velocity (vx, vy, wz) of C in the body frame (eqs. 2.34, 2.54-2.56).

        Args:
            speed: speed of C along its direction of travel, m/s, negative backwards.
            front: bicycle angle of the front axle.
            rear: bicycle angle of the rear axle.

        Raises:
            KinematicsError: an angle of 89 deg or more, or NaN.
        """
        require_finite("speed", speed)
        tan_f, tan_r = self._tangents(front, rear)
        tan_b = self.tan_sideslip(tan_f, tan_r)
        vx = speed / secant(tan_b)
        return vx, vx * tan_b, vx * (tan_f - tan_r) / self.wheelbase

    def steer_for(self, curvature: Real, sideslip: Real) -> tuple[Real, Real]:
        """Axle angles (front, rear) for a path curvature (1/m) and sideslip at C: exact inverse of 2.34 and 2.38."""
        require_finite("curvature", curvature)
        require_within("sideslip", sideslip, -MAX_AXLE_ANGLE, MAX_AXLE_ANGLE)
        tan_b = tan(sideslip)
        turn = curvature / cos(sideslip)
        return atan(tan_b + self.l_f * turn), atan(tan_b - self.l_r * turn)

    def steer_for_twist(self, vx: Real, vy: Real, wz: Real) -> tuple[Real, Real, Real]:
        """Speed and axle angles (speed, front, rear) that give C the velocity (vx, vy, wz).

        Standing still needs no angle: a zero twist gives (0, 0, 0).

        Raises:
            KinematicsError: vx = 0 with vy or wz: two steered axles cannot move purely sideways nor turn on the spot.
        """
        require_finite("vx", vx)
        require_finite("vy", vy)
        require_finite("wz", wz)
        ahead = vx
        if any_zero(vx):
            if np.any((np.asarray(vx) == 0.0) & (np.abs(vy) + np.abs(wz) > 0.0)):
                raise KinematicsError("vx is 0 while vy or wz is not: two steered axles need a forward speed")
            ahead = nonzero(vx)
        return signed_hypot(vx, vy), atan((vy + self.l_f * wz) / ahead), atan((vy - self.l_r * wz) / ahead)

    def wheel_angles(self, front: Real, rear: Real) -> tuple[Real, Real, Real, Real]:
        """Angles of the four wheels through the common ICR (eqs. 2.27-2.30), within +-90 deg."""
        tan_f, tan_r = self._tangents(front, rear)
        left, right = self._sides(tan_f, tan_r)
        facing_left, facing_right = sign(left), sign(right)
        ahead_left, ahead_right = abs(left), abs(right)
        return (
            atan2(facing_left * tan_f, ahead_left),
            atan2(facing_right * tan_f, ahead_right),
            atan2(facing_left * tan_r, ahead_left),
            atan2(facing_right * tan_r, ahead_right),
        )

    def wheel_speeds(self, speed: Real, front: Real, rear: Real) -> tuple[Real, Real, Real, Real]:
        """Ground speeds of the four wheels along their own angle, m/s (eqs. 2.43-2.46).

        A wheel between the ICR and the body's middle rolls backwards: its speed has the other sign.
        """
        vx, _, _ = self.body_twist(speed, front, rear)
        tan_f, tan_r = tan(front), tan(rear)
        left, right = self._sides(tan_f, tan_r)
        from_left, from_right = vx * sign(left), vx * sign(right)
        return (
            from_left * hypot(left, tan_f),
            from_right * hypot(right, tan_f),
            from_left * hypot(left, tan_r),
            from_right * hypot(right, tan_r),
        )

    def drive_speed(self, speed: Real, front: Real, rear: Real) -> Real:
        """Ground speed, m/s, that the motor has at the wheels when C travels at ``speed``.

        Each open differential turns with the mean of its two wheels, which the truck's nearly parallel linkage makes
        the speed of the axle's middle along its wheels; the rigid transfer case turns with the mean of both axles.
        Proportional to ``speed``: divide by ``drive_speed(1.0, front, rear)`` for the inverse.
        """
        require_finite("speed", speed)
        travel, wheels = self.drive_secants(front, rear)
        return speed / travel * wheels

    def drive_secants(self, front: Real, rear: Real) -> tuple[Real, Real]:
        """``drive_speed`` is the speed over the first (of the sideslip) times the second (mean of the axle angles)."""
        tan_f, tan_r = self._tangents(front, rear)
        return secant(self.tan_sideslip(tan_f, tan_r)), 0.5 * (secant(tan_f) + secant(tan_r))

    def _sides(self, tan_f: Real, tan_r: Real) -> tuple[Real, Real]:
        """Forward speed of the left and of the right wheels, relative to C: 1 -+ (w/2)/R with the signed R of 2.37."""
        lean = (tan_f - tan_r) * (0.5 * self.track / self.wheelbase)
        return 1.0 - lean, 1.0 + lean

    def limit_keeping_curvature(
        self, front: Real, rear: Real, limit: float, rear_limit: float | None = None
    ) -> tuple[Real, Real]:
        """Axle angles within the limits that keep C's path curvature, then its sideslip, as far as possible.

        The curvature is kept exactly while any pair of angles within the limits has it, else the largest possible one
        is taken; the sideslip moves by no more than that needs. Angles within the limits come back as they were.

        Args:
            front: wanted front axle angle.
            rear: wanted rear axle angle.
            limit: largest front (and rear) axle angle.
            rear_limit: largest rear axle angle, if another; 0 is a front-steered truck.

        Raises:
            KinematicsError: a limit outside 0 to 89 deg.
        """
        far = limit if rear_limit is None else rear_limit
        require_within("limit", limit, 0.0, MAX_AXLE_ANGLE)
        require_within("rear_limit", far, 0.0, MAX_AXLE_ANGLE)
        tightest = self.curvature(limit, -far)
        curvature = clip(self.curvature(front, rear), -tightest, tightest)
        # tan(beta) + l_f kappa/cos(beta) = +-tan(limit) solved for beta, and the same at the rear.
        ahead = asin(clip(self.l_f * math.cos(limit) * curvature, -1.0, 1.0))
        behind = asin(clip(self.l_r * math.cos(far) * curvature, -1.0, 1.0))
        low = larger(-limit - ahead, -far + behind)
        high = smaller(limit - ahead, far + behind)
        wanted_f, wanted_r = self.steer_for(curvature, clip(self.sideslip(front, rear), low, high))
        return clip(wanted_f, -limit, limit), clip(wanted_r, -far, far)

    def minimum_radius(self, mode: SteeringModeName, limit: float, *, every_wheel: bool = False) -> float:
        """Minimum turning radius R (m): lateral distance of the ICR from the body's middle line (eq. 2.37).

        Front and rear steering have their ICR on the straight axle's line, counter steering on the line of the centre.

        Args:
            mode: steering mode; crab never turns (infinite), spot needs wheels steered one by one (0).
            limit: largest angle of the axles, or of every wheel.
            every_wheel: the limit holds for the inner wheels of an ideal linkage, not for the axle: adds half a track.

        Raises:
            KinematicsError: unknown mode, or a limit outside 0 to 89 deg.
        """
        require_within("limit", limit, 0.0, MAX_AXLE_ANGLE)
        if mode not in ("front", "rear", "counter", "crab", "spot"):
            raise KinematicsError(f"mode {mode!r}: expected front, rear, counter, crab or spot")
        if mode == "spot":
            return 0.0
        if mode == "crab" or limit == 0.0:
            return math.inf
        steered = 2.0 if mode == "counter" else 1.0
        return self.wheelbase / (steered * math.tan(limit)) + (0.5 * self.track if every_wheel else 0.0)

    def integrate(
        self, pose: tuple[Real, Real, Real], vx: Real, vy: Real, wz: Real, dt: float
    ) -> tuple[Real, Real, Real]:
        """Pose of C after dt at a constant twist: see ``elementary.integrate``."""
        return integrate(pose, vx, vy, wz, dt)


def least_squares_motion(geometry: FourWheelSteering, angles: tuple[Real, Real, Real, Real]) -> tuple[Real, Real]:
    """Tan(sideslip) and turning of ``common_motion``, for wheel angles known to be below 89 deg.

    Raises:
        KinematicsError: wheels that leave the motion undetermined.
    """
    zero = 0.0 * angles[0]
    bb, bk, kk, bs, ks = zero, zero, zero, zero, zero
    for (x, y), angle in zip(geometry.wheel_positions, angles, strict=True):
        side, drive = cos(angle), sin(angle)
        turn = y * drive + x * side
        bb, bk, kk = bb + side * side, bk + side * turn, kk + turn * turn
        bs, ks = bs + side * drive, ks + turn * drive
    determinant = bb * kk - bk * bk
    if not all_positive(determinant - 1e-12 * (bb * geometry.wheelbase) ** 2):
        raise KinematicsError("angles: all wheels roll towards one point, so the yaw rate is undetermined")
    return (bs * kk - ks * bk) / determinant, (bb * ks - bk * bs) / determinant


@dataclass(frozen=True, slots=True)
class TurnDeficit:
    """Turn that the axles lack compared with the linkage: dimensionless, 0 for none.

    The tangent t of an axle angle becomes t (1 - c t^2), with a coefficient c for each axle and side; where the axles
    oppose each other, the turn becomes turn (1 + c t_f t_r), with a coefficient for each direction of turn.
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
        ranges: ranges of the front and rear servo angle that the servo controller's pulses reach.
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
        """Angles of each axle by itself."""
        return self.polynomials.servo_from_axles(front, rear)


@dataclass(frozen=True)
class LinkedAxles(Axles):
    """Axles with wheel angles by the fitted polynomials.

    Args:
        geometry: geometry of the body; its reference point is the middle between the axles.
        front: servo to wheels.
        rear: servo to wheels; None if its wheels are fixed straight ahead, and the rear axle angle is 0: the front one
            gives the turn, the sideslip of the rear axle's middle (0.5 deg at full lock) is neglected.
        deficit: turn that the axles lack.
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
        """Angles of the bicycle with the wheels' least-squares motion."""
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
        """Solve by Broyden's method from the slopes of the mean tangents."""
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
        for _ in range(30):
            off_f, off_r = target_f - got_f, target_r - got_r
            if abs(off_f) + abs(off_r) < 1e-11:  # rad
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
        # 1e-3: tolerance (tangent) of a clamped servo for an axle angle on the edge of its reach
        if not abs(target_f - got_f) + abs(target_r - got_r) < 1e-3:
            raise KinematicsError(f"front is {front:.6g}, rear is {rear:.6g}: out of the steering linkage's reach")
        return servo_f, servo_r


class Reach:
    """Motions that two steered axles reach: the sideslips of every curvature.

    The ranges of the servos are a rectangle, its picture in curvature and sideslip of the base a region between two
    curves over the curvature, each along two of the rectangle's edges.

    Args:
        geometry: geometry of the body, its reference point the base.
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
