"""Planar poses (x, y, yaw) as arrays with a last axis of 3; m and rad; vectorised over the leading axes."""

import numpy as np

from monstertruck_kinematics.elementary import Array


def wrap(angle: Array | float) -> Array:
    """The same angles in [-pi, pi), rad."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def compose(outer: Array, inner: Array) -> Array:
    """Pose ``inner``, given in the frame of ``outer``, in the frame in which ``outer`` is given."""
    c, s = np.cos(outer[..., 2]), np.sin(outer[..., 2])
    return np.stack(
        (
            outer[..., 0] + c * inner[..., 0] - s * inner[..., 1],
            outer[..., 1] + s * inner[..., 0] + c * inner[..., 1],
            wrap(outer[..., 2] + inner[..., 2]),
        ),
        axis=-1,
    )


def inverse(pose: Array) -> Array:
    """Pose of the outer frame in the inner one."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = pose[..., 0], pose[..., 1]
    return np.stack((-c * x - s * y, s * x - c * y, wrap(-pose[..., 2])), axis=-1)


def between(origin: Array, target: Array) -> Array:
    """Pose ``target`` in the frame of ``origin``, both given in one frame."""
    c, s = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    dx, dy = target[..., 0] - origin[..., 0], target[..., 1] - origin[..., 1]
    return np.stack((c * dx + s * dy, -s * dx + c * dy, wrap(target[..., 2] - origin[..., 2])), axis=-1)


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


def interpolate(stamps: Array, poses: Array, at: Array) -> Array:
    """Poses at the times ``at``, straight between the samples of a trajectory (``stamps`` rising), held at its ends."""
    yaw = np.unwrap(poses[:, 2])
    columns = (poses[:, 0], poses[:, 1], yaw)
    result = np.stack([np.interp(at, stamps, column) for column in columns], axis=-1)
    result[:, 2] = wrap(result[:, 2])
    return result


def between_jacobians(origin: Array, target: Array) -> tuple[Array, Array]:
    """Derivatives, shape (3, 3), of ``between(origin, target)`` by ``origin`` and by ``target``."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    by_target = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
    x, y, _ = between(origin, target)
    by_origin = -by_target
    by_origin[0, 2], by_origin[1, 2] = y, -x
    return by_origin, by_target
