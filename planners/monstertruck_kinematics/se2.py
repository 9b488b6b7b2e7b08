"""Poses and twists of the plane, and their algebra: the one home of SE(2).

A pose is x, y (m) and yaw (rad), a twist vx, vy (m/s) and wz (rad/s), either as a tuple or along the last axis of an
array. Functions of arrays are vectorised over the leading axes; ``compose``, ``inverse`` and ``between`` wrap the yaw,
the others keep full turns.
"""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array, Real, cos, sin, sinc, sinc_slope

Pose2 = tuple[float, float, float]
"""x, y (m) and yaw (rad) in a frame."""
Twist2 = tuple[float, float, float]
"""vx, vy (m/s) and wz (rad/s) of a point, in the body frame."""
TwistOf = tuple[Real, Real, Real]
"""The same for one state, or as arrays for many."""


def wrap(angle: Array | float) -> Array:
    """The same angles in [-pi, pi), rad."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def compose(outer: Array, inner: Array) -> Array:
    """Pose ``inner``, given in the frame of ``outer``, transformed to the parent frame of ``outer``."""
    c, s = np.cos(outer[..., 2]), np.sin(outer[..., 2])
    x = outer[..., 0] + c * inner[..., 0] - s * inner[..., 1]
    y = outer[..., 1] + s * inner[..., 0] + c * inner[..., 1]
    return _poses(x, y, wrap(outer[..., 2] + inner[..., 2]))


def inverse(pose: Array) -> Array:
    """Pose of the outer frame in the inner one."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = pose[..., 0], pose[..., 1]
    return _poses(-c * x - s * y, s * x - c * y, wrap(-pose[..., 2]))


def between(origin: Array, target: Array) -> Array:
    """Pose ``target`` in the frame of ``origin``, both given in one frame."""
    c, s = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    dx, dy = target[..., 0] - origin[..., 0], target[..., 1] - origin[..., 1]
    return _poses(c * dx + s * dy, -s * dx + c * dy, wrap(target[..., 2] - origin[..., 2]))


def _poses(x: Array, y: Array, yaw: Array) -> Array:
    """Poses from their columns; ``np.stack`` alone would take as long as all other work on a single pose."""
    return np.stack((x, y, yaw), axis=-1) if yaw.ndim else np.array((x, y, yaw))


def transform(pose: Array, points: Array) -> Array:
    """Points, shape (n, 2), of the frame at ``pose`` (shape (3,)) in the outer frame."""
    return points @ rotation(pose[2]).T + pose[:2]


def rotation(yaw: float) -> Array:
    """Matrix, shape (2, 2), that turns vectors by ``yaw``."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array(((c, -s), (s, c)))


def compose_jacobians(outer: Array, inner: Array) -> tuple[Array, Array]:
    """Derivatives, shape (3, 3), of ``compose(outer, inner)`` by ``outer`` and by ``inner``."""
    c, s = np.cos(outer[2]), np.sin(outer[2])
    by_outer = np.eye(3)
    by_outer[0, 2] = -s * inner[0] - c * inner[1]
    by_outer[1, 2] = c * inner[0] - s * inner[1]
    by_inner = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return by_outer, by_inner


def between_jacobians(origin: Array, target: Array) -> tuple[Array, Array]:
    """Derivatives, shape (3, 3), of ``between(origin, target)`` by ``origin`` and by ``target``."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    by_target = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
    x, y, _ = between(origin, target)
    by_origin = -by_target
    by_origin[0, 2], by_origin[1, 2] = y, -x
    return by_origin, by_target


def interpolate(stamps: Array, poses: Array, at: Array) -> Array:
    """Poses at the times ``at``, straight between the samples of a trajectory (``stamps`` rising), held at its ends."""
    yaw = np.unwrap(poses[:, 2])
    columns = (poses[:, 0], poses[:, 1], yaw)
    result = np.stack([np.interp(at, stamps, column) for column in columns], axis=-1)
    result[:, 2] = wrap(result[:, 2])
    return result


def points_placed(points: Array, at: Pose2) -> Array:
    """Points (n, 2) given in the frame of ``at``, in the frame that ``at`` is given in."""
    x, y, yaw = at
    c, s = math.cos(yaw), math.sin(yaw)
    return np.column_stack((x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]))


def placed(poses: Array, at: Pose2) -> Array:
    """Poses (n, 3) given in the frame of ``at``, in the frame that ``at`` is given in."""
    return np.column_stack((points_placed(poses, at), at[2] + poses[:, 2]))


def points_relative(points: Array, at: Pose2) -> Array:
    """Points (n, 2) in the frame of ``at``, both given in one frame."""
    x, y, yaw = at
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = points[:, 0] - x, points[:, 1] - y
    return np.column_stack((c * dx + s * dy, c * dy - s * dx))


def poses_relative(poses: Array, at: Pose2) -> Array:
    """Poses (n, 3) in the frame of ``at``, both given in one frame."""
    return np.column_stack((points_relative(poses, at), poses[:, 2] - at[2]))


def to_world(heading: Real, vx: Real, vy: Real) -> tuple[Real, Real]:
    """World components of a body-frame velocity (posture model in the world frame)."""
    c, s = cos(heading), sin(heading)
    return c * vx - s * vy, s * vx + c * vy


def to_body(heading: Real, x_rate: Real, y_rate: Real) -> tuple[Real, Real]:
    """Body components of a world-frame velocity (posture model in the robot's frame)."""
    c, s = cos(heading), sin(heading)
    return c * x_rate + s * y_rate, c * y_rate - s * x_rate


def twist_at(vx: Real, vy: Real, wz: Real, x: float, y: float) -> TwistOf[Real]:
    """Twist of the body's point (x, y), m, from the twist of its origin."""
    return vx - wz * y, vy + wz * x, wz


def integrate(pose: tuple[Real, Real, Real], vx: Real, vy: Real, wz: Real, dt: float) -> tuple[Real, Real, Real]:
    """Pose after holding the body twist (vx, vy, wz) for dt: an exact arc, a straight line for wz = 0.

    The chord of the arc has the length sinc(wz dt / 2) |v| dt and points along the heading at half time, so no case
    distinction by curvature is needed. The heading is not wrapped.

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
