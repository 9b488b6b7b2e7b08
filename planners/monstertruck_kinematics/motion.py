"""Rigid motion in the plane: exact integration of a constant body twist."""

from monstertruck_kinematics.elementary import Real, cos, sin, sinc


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
    c, s = cos(heading + half), sin(heading + half)
    return x + chord * (vx * c - vy * s), y + chord * (vx * s + vy * c), heading + 2.0 * half
