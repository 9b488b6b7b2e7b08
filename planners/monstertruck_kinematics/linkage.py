"""The steering linkage (thesis eqs. 2.2-2.7, corrected and signed) and the steering errors of wheels that it moves.

Servo arm (Pitman) -> drag link -> left wheel's arm -> tie rod -> right wheel's arm. The drag link's far end is taken to
move only sideways, as the source does; the tie rod is exact. Angles rad, left positive, a positive servo angle steers
to the left; lengths m. The truck's real lengths are published nowhere.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from monstertruck_kinematics.elementary import (
    KinematicsError,
    Real,
    asin,
    atan,
    atan2,
    cos,
    require_finite,
    require_positive,
    require_within,
    sin,
    sqrt,
)
from monstertruck_kinematics.truck import FourWheelSteering, least_squares_motion


@dataclass(frozen=True)
class SteeringLinkage:
    """One axle's linkage.

    A linkage with rearward arms is one with forward arms mirrored front to back: every map f becomes -f(-x). So is the
    linkage of the rear axle.

    Args:
        pitman: l_PA, servo arm.
        drag_link: l_DL.
        arm: d, wheel arm.
        arm_angle: beta, inward from straight ahead (or straight back).
        king_pins: w_k, between the king-pins.
        arms: whether the wheel arms point forward or rearward; with rearward arms the inner wheel turns more.

    Raises:
        KinematicsError: a length is not above 0, the angle not in [0, 90 deg), or the arms leave no room for a tie rod.
    """

    pitman: float = 0.020
    drag_link: float = 0.060
    arm: float = 0.025
    arm_angle: float = math.radians(15.0)
    king_pins: float = 0.200
    arms: Literal["forward", "rearward"] = "rearward"

    def __post_init__(self) -> None:
        for name in ("pitman", "drag_link", "arm", "king_pins"):
            require_positive(name, getattr(self, name))
        require_within("arm_angle", self.arm_angle, 0.0, math.pi / 2.0 - 1e-6)
        if self.arms not in ("forward", "rearward"):
            raise KinematicsError(f"arms is {self.arms!r}: expected forward or rearward")
        if self.tie_rod <= 0.0:
            raise KinematicsError(
                f"king_pins is {self.king_pins}: expected more than 2 d sin(beta), because the arms overlap"
            )

    @property
    def tie_rod(self) -> float:
        """Length of the tie rod, w_k - 2 d sin(beta)."""
        return self.king_pins - 2.0 * self.arm * math.sin(self.arm_angle)

    @property
    def _side(self) -> float:
        return 1.0 if self.arms == "forward" else -1.0

    def shift(self, servo: Real) -> Real:
        """Sideways motion of the drag link's far end, m, left positive (2.2).

        S + l_PA sin(theta) - l_DL with S^2 = l_DL^2 - l_PA^2 (1 - cos theta)^2, for both signs of theta (for rearward
        arms of -theta, so that a positive servo angle always steers left).

        Raises:
            KinematicsError: the drag link cannot reach, or NaN.
        """
        require_finite("servo", servo)
        turned = self._side * servo
        lift = self.pitman * (1.0 - cos(turned))
        require_within("servo: l_PA (1 - cos theta)", lift, 0.0, self.drag_link)
        return sqrt(self.drag_link * self.drag_link - lift * lift) + self.pitman * sin(turned) - self.drag_link

    def left_from_servo(self, servo: Real) -> Real:
        """Angle of the driven, left wheel (2.3-2.6, one signed formula): d [sin(delta - beta) + sin(beta)] = shift.

        Raises:
            KinematicsError: the arm cannot follow that far, or NaN.
        """
        sine = self.shift(servo) / self.arm - math.sin(self.arm_angle)
        require_within("servo: sine of the wheel arm", sine, -1.0, 1.0)
        return self._side * (self.arm_angle + asin(sine))

    def right_from_left(self, left: Real) -> Real:
        """Angle of the right wheel through the tie rod (2.7), exact.

        The right arm's end lies on a circle about its king-pin and on one of the tie rod's length about the left
        arm's end; of their two intersections it is the one that is beta at straight ahead.

        Raises:
            KinematicsError: the tie rod cannot reach, or NaN.
        """
        require_finite("left", left)
        swung = self._side * left - self.arm_angle
        ahead, aside = self.arm * cos(swung), self.king_pins + self.arm * sin(swung)
        square = ahead * ahead + aside * aside
        reach = square + (self.arm + self.tie_rod) * (self.arm - self.tie_rod)
        cosine = reach / (2.0 * self.arm * sqrt(square))
        require_within("left: cosine between the right arm and the left arm's end", cosine, -1.0, 1.0)
        arm = atan2(aside, ahead) - (0.5 * math.pi - asin(cosine))
        return self._side * (arm - self.arm_angle)

    def wheels_from_servo(self, servo: Real) -> tuple[Real, Real]:
        """Left and right wheel angles at a servo angle."""
        left = self.left_from_servo(servo)
        return left, self.right_from_left(left)


def common_motion(
    geometry: FourWheelSteering, angles: tuple[Real, Real, Real, Real]
) -> tuple[Real, Real, tuple[Real, Real, Real, Real]]:
    """Least-squares planar motion of four wheels at any angles, and the steering error of each.

    Ideal wheels share one ICR; a linkage's do not. Least squares over the wheels' sideways speeds.

    Args:
        geometry: wheelbase, track, reference point.
        angles: front left, front right, rear left, rear right.

    Returns:
        tan(sideslip) v_y/v_x of the reference point, its turning w_z/v_x (1/m; the curvature over cos(sideslip)), and
        each wheel's steering error: its angle minus the direction of its drag.

    Raises:
        KinematicsError: NaN, or wheels that leave the motion undetermined.
    """
    for name, angle in zip(("front left", "front right", "rear left", "rear right"), angles, strict=True):
        require_within(f"wheel {name}: angle", angle, -math.radians(89.0), math.radians(89.0))
    slide, turn_rate = least_squares_motion(geometry, angles)
    errors = [
        angle - atan((slide + x * turn_rate) / (1.0 - y * turn_rate))
        for (x, y), angle in zip(geometry.wheel_positions, angles, strict=True)
    ]
    return slide, turn_rate, (errors[0], errors[1], errors[2], errors[3])


def dragged_speeds(
    geometry: FourWheelSteering, speed: Real, angles: tuple[Real, Real, Real, Real]
) -> tuple[Real, Real, Real, Real]:
    """Rolling speeds, m/s, of wheels that are not ideally steered: their dragged velocity times cos(steering error).

    Args:
        geometry: wheelbase, track, reference point.
        speed: speed of the reference point along its travel.
        angles: front left, front right, rear left, rear right.
    """
    slide, turn_rate, _ = common_motion(geometry, angles)
    vx = speed * cos(atan(slide))
    speeds = [
        vx * ((1.0 - y * turn_rate) * cos(angle) + (slide + x * turn_rate) * sin(angle))
        for (x, y), angle in zip(geometry.wheel_positions, angles, strict=True)
    ]
    return speeds[0], speeds[1], speeds[2], speeds[3]


def reachable_servo(linkage: SteeringLinkage, step: float = math.radians(0.1)) -> tuple[float, float]:
    """Limits of the servo angle (right, left), on a grid of ``step``, for linkage and tie rod to move without locking.

    Raises:
        KinematicsError: ``step`` is not above 0.
    """
    require_positive("step", step)
    ends = []
    for side in (-1.0, 1.0):
        end = 0.0
        for servo in side * np.arange(step, math.pi / 2.0, step):
            try:
                linkage.wheels_from_servo(float(servo))
            except KinematicsError:
                break
            end = float(servo)
        ends.append(end)
    return ends[0], ends[1]
