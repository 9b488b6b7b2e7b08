"""Obstacles that can be added to and removed from a running world: discs and upright boxes."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import cos, hypot, sin

import numpy as np

from monstertruck_kinematics.elementary import Array


@dataclass(frozen=True, slots=True)
class Disc:
    """An upright cylinder: centre and radius in the map frame (m)."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box: centre (m) and yaw (rad) in the map frame, length along its own x, width along its own y (m)."""

    x: float
    y: float
    length: float
    width: float
    yaw: float = 0.0

    def corners(self) -> Array:
        """Corners in the map frame (m), counter-clockwise, shape (4, 2)."""
        c, s = cos(self.yaw), sin(self.yaw)
        local = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (self.length / 2, self.width / 2)
        corners: Array = local @ np.array([(c, s), (-s, c)]) + (self.x, self.y)
        return corners


Obstacle = Disc | Box


def discs_and_segments(obstacles: Iterable[Obstacle]) -> tuple[Array, Array]:
    """Return the ray caster's input: discs (n, 3) of x, y, radius and segments (m, 4) of x0, y0, x1, y1."""
    discs: list[tuple[float, float, float]] = []
    segments: list[Array] = []
    for obstacle in obstacles:
        if isinstance(obstacle, Disc):
            discs.append((obstacle.x, obstacle.y, obstacle.radius))
        else:
            corners = obstacle.corners()
            segments.append(np.hstack([corners, np.roll(corners, -1, axis=0)]))
    return np.array(discs).reshape(-1, 3), np.vstack(segments) if segments else np.zeros((0, 4))


def penetration(footprint: Box, obstacle: Obstacle) -> float:
    """Return the depth of a footprint's overlap with an obstacle (m); 0 if they are apart."""
    if isinstance(obstacle, Disc):
        return _disc_penetration(footprint, obstacle)
    return _box_penetration(footprint.corners(), obstacle.corners())


def _disc_penetration(box: Box, disc: Disc) -> float:
    c, s = cos(box.yaw), sin(box.yaw)
    dx, dy = disc.x - box.x, disc.y - box.y
    outside_x = abs(c * dx + s * dy) - box.length / 2
    outside_y = abs(c * dy - s * dx) - box.width / 2
    signed_distance = hypot(max(outside_x, 0.0), max(outside_y, 0.0)) + min(max(outside_x, outside_y), 0.0)
    return max(0.0, disc.radius - signed_distance)


def _box_penetration(a: Array, b: Array) -> float:
    """Minimum overlap over the four edge normals (separating axis theorem)."""
    edges = np.array([a[1] - a[0], a[2] - a[1], b[1] - b[0], b[2] - b[1]])
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    on_a, on_b = normals @ a.T, normals @ b.T
    overlap = np.minimum(on_a.max(axis=1), on_b.max(axis=1)) - np.maximum(on_a.min(axis=1), on_b.min(axis=1))
    return max(0.0, float(overlap.min()))
