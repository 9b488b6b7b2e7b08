"""Planar poses (x, y, yaw) as arrays with a last axis of 3; m and rad; vectorised over the leading axes.

Also ``SmoothedCorrection``: odom in map as published, which approaches corrections at a limited rate.
"""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array

Vector = tuple[float, float, float]


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


class SmoothedCorrection:
    """Follows corrections at the robot's place, not at the origin of odom: a turn about a far origin would be a jump.

    Args:
        slew: greatest speed of the change, m/s and rad/s.
        jump: corrections of the robot's place beyond this, m, count at once.
        settle: time constant of the approach within that, s; 0 = none. Scans are deskewed by these poses: a correction
            must not look like motion.
    """

    def __init__(self, slew: tuple[float, float], jump: float, settle: float = 0.0) -> None:
        self._slew = slew
        self._settle = settle
        self._jump = jump
        self._target = np.zeros(3)
        self._shown = np.zeros(3)

    @property
    def value(self) -> Vector:
        """Odom in map, m and rad."""
        x, y, yaw = self._shown.tolist()
        return x, y, yaw

    def set_target(self, map_from_odom: Vector, *, at_once: bool = False) -> None:
        """Take a new correction; ``at_once``: apply it without a transition."""
        self._target = np.array(map_from_odom)
        if at_once:
            self._shown = self._target.copy()

    def pose(self, odom: Vector, dt: float) -> Vector:
        """Base in map for base in odom, ``dt`` seconds after the last call."""
        base = np.array(odom)
        now, then = compose(self._shown, base), compose(self._target, base)
        off = between(now, then)
        way, turn = math.hypot(off[0], off[1]), abs(float(off[2]))
        share = min(self._slew[0] * dt / max(way, 1e-12), self._slew[1] * dt / max(turn, 1e-12))
        if self._settle > 0:
            share = min(share, -math.expm1(-dt / self._settle))
        if way > self._jump or share >= 1.0:
            now, self._shown = then, self._target.copy()
        else:
            now = compose(now, off * share)
            self._shown = compose(now, inverse(base))
        x, y, yaw = now.tolist()
        return x, y, yaw
