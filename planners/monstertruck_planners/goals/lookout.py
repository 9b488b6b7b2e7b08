"""Whether the newest scan shows something on the way ahead."""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import Footprint, first_contact

STEP = 0.05
"""Metres between two poses looked at."""


def way_ahead(poses: Array, travelled: Array, along: float, reach: float, pose: Array) -> Array:
    """Present pose, then the path's poses from ``along`` to ``along + reach``, one every few centimetres.

    Args:
        poses: shape (n, 3), of the base.
        travelled: shape (n,), metres from the path's start.
        along: where the truck is, m.
        reach: m.
        pose: shape (3,), the truck's own.
    """
    first, last = np.searchsorted(travelled, (along, along + reach), side="right")
    chosen = poses[first : last + 1]
    if len(chosen) > 2:
        spacing = max(round(STEP * (len(chosen) - 1) / max(travelled[min(last, len(poses) - 1)] - along, STEP)), 1)
        chosen = np.vstack((chosen[:-1:spacing], chosen[-1]))
    return np.vstack((pose, chosen))


def blocked(footprint: Footprint, way: Array, points: Array, at: tuple[float, float, float]) -> bool:
    """Whether driving along ``way`` (m, 3) the footprint comes upon a point of a scan.

    Args:
        footprint: the truck.
        way: in the map's frame, the present pose first.
        points: shape (n, 2), returns in the base frame.
        at: present pose of the base in the map's frame.
    """
    x, y, yaw = at
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = way[:, 0] - x, way[:, 1] - y
    seen = np.column_stack((c * dx + s * dy, c * dy - s * dx, way[:, 2] - yaw))
    return first_contact(footprint, seen, points) is not None


def cut(poses: Array, travelled: Array, along: float, rest: float) -> int:
    """How many of a path's poses are kept if it is to end ``rest`` metres behind ``along``; two at least."""
    return max(int(np.searchsorted(travelled, along + rest)) + 1, 2)
