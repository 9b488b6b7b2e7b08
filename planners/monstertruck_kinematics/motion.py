"""Rigid motion in the plane: frames, exact integration of a constant body twist and its Jacobians."""

import numpy as np

from monstertruck_kinematics.elementary import Array, Real, cos, sin, sinc, sinc_slope


def to_world(heading: Real, vx: Real, vy: Real) -> tuple[Real, Real]:
    """World components of a body-frame velocity (posture model in the world frame)."""
    c, s = cos(heading), sin(heading)
    return c * vx - s * vy, s * vx + c * vy


def to_body(heading: Real, x_rate: Real, y_rate: Real) -> tuple[Real, Real]:
    """Body components of a world-frame velocity (posture model in the robot's frame)."""
    c, s = cos(heading), sin(heading)
    return c * x_rate + s * y_rate, c * y_rate - s * x_rate


def twist_at(vx: Real, vy: Real, wz: Real, x: float, y: float) -> tuple[Real, Real, Real]:
    """Twist of the body's point (x, y), m, from the twist of its origin."""
    return vx - wz * y, vy + wz * x, wz


def integrate(pose: tuple[Real, Real, Real], vx: Real, vy: Real, wz: Real, dt: float) -> tuple[Real, Real, Real]:
    """Pose after holding the body twist (vx, vy, wz) for dt: an exact arc, a straight line for wz = 0.

    The chord of the arc has the length sinc(wz dt / 2) |v| dt and points along the heading at half time, so no case
    distinction by curvature is needed. The heading is not wrapped (it counts turns).

    Args:
        pose: x, y (m) and heading (rad) in the world frame; three floats, three (N,) arrays or one (3, N) array.
        vx: forward speed in the body frame, m/s.
        vy: leftward speed in the body frame, m/s.
        wz: yaw rate, rad/s.
        dt: duration, s; negative runs backwards.
    """
    x, y, heading = pose
    half = wz * (0.5 * dt)
    chord = sinc(half) * dt
    dx, dy = to_world(heading + half, vx, vy)
    return x + chord * dx, y + chord * dy, heading + 2.0 * half


def integration_jacobians(
    pose: tuple[Real, Real, Real], vx: Real, vy: Real, wz: Real, dt: float
) -> tuple[Array, Array]:
    """Derivatives (3, 3, ...) of ``integrate`` by the pose and by the twist, to propagate covariances."""
    heading = pose[2]
    half = wz * (0.5 * dt)
    c, s = cos(heading + half), sin(heading + half)
    chord = sinc(half) * dt
    dx, dy = c * vx - s * vy, s * vx + c * vy
    bend = sinc_slope(half)
    zero = 0.0 * (dx + heading)
    one = zero + 1.0
    by_pose = np.array([[one, zero, -chord * dy + zero], [zero, one, chord * dx + zero], [zero, zero, one]])
    by_turn_x = 0.5 * dt * (bend * dt * dx - chord * dy)
    by_turn_y = 0.5 * dt * (bend * dt * dy + chord * dx)
    by_twist = np.array(
        [
            [chord * c + zero, -chord * s + zero, by_turn_x + zero],
            [chord * s + zero, chord * c + zero, by_turn_y + zero],
            [zero, zero, one * dt],
        ]
    )
    return by_pose, by_twist
