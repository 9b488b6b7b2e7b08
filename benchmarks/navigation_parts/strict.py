"""A strict judge of routes, based on shapely polygons, that shares no code with any planner.

It integrates a path's segments itself, takes a pose every centimetre and both ends of every segment, and looks for
overlaps of the footprint's polygons with the squares of occupied and unknown cells and with everything off the map.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely

EVERY = 0.01
SLIVER = 1e-9
"""Overlaps of a smaller area than this (m^2) are rounding."""


@dataclass(frozen=True)
class Rule:
    """Constraints on a path."""

    discs: tuple[float, ...]
    disc_radius: float
    turning_radius: float
    crab_angle: float
    position: float
    yaw: float


class World:
    """Occupied squares of a grid: cells (rows, columns) bool, row 0 at y = 0."""

    def __init__(self, occupied, resolution: float) -> None:  # noqa: ANN001
        self.size = (occupied.shape[1] * resolution, occupied.shape[0] * resolution)
        inner = np.zeros_like(occupied)
        inner[1:-1, 1:-1] = (
            occupied[:-2, 1:-1] & occupied[2:, 1:-1] & occupied[1:-1, :-2] & occupied[1:-1, 2:] & occupied[1:-1, 1:-1]
        )
        # A cell among occupied ones is met only after one of them.
        rows, columns = np.nonzero(occupied & ~inner)
        squares = shapely.box(
            columns * resolution, rows * resolution, (columns + 1) * resolution, (rows + 1) * resolution
        )
        self.squares = squares
        self.tree = shapely.STRtree(squares)


def poses_of(start, segments):  # noqa: ANN001, ANN201
    """Return poses at most EVERY apart along (length, direction, curvature, sideslip) segments."""
    poses = [tuple(start)]
    x, y, yaw = start
    for length, direction, curvature, sideslip in segments:
        count = max(math.ceil(length / EVERY), 1)
        for k in range(1, count + 1):
            s = direction * length * k / count
            if curvature:
                turned = yaw + curvature * s
                px = x + (math.sin(turned + sideslip) - math.sin(yaw + sideslip)) / curvature
                py = y - (math.cos(turned + sideslip) - math.cos(yaw + sideslip)) / curvature
            else:
                turned, px, py = yaw, x + s * math.cos(yaw + sideslip), y + s * math.sin(yaw + sideslip)
            poses.append((px, py, turned))
        x, y, yaw = poses[-1]
    return np.array(poses)


def faults(world: World, rule: Rule, start, goal, segments) -> list[str]:  # noqa: ANN001
    """Describe all faults of a path; a valid path has none."""
    found = []
    poses = poses_of(start, segments)
    for length, direction, curvature, sideslip in segments:
        if length < 0 or direction not in (-1, 1):
            found.append("a segment without length or direction")
        if abs(curvature) > (1 + 1e-9) / rule.turning_radius:
            found.append(f"curvature {curvature:.4f}")
        if abs(sideslip) > rule.crab_angle + 1e-9 or (sideslip and curvature):
            found.append(f"sideslip {sideslip:.4f}")
    off = poses[-1] - np.asarray(goal)
    if math.hypot(off[0], off[1]) > rule.position or abs(math.remainder(off[2], math.tau)) > rule.yaw:
        found.append("does not end at the goal")
    centres = np.concatenate(
        [poses[:, :2] + d * np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2]))) for d in rule.discs]
    )
    reach = rule.disc_radius
    if (centres < reach).any() or (centres > np.array(world.size) - reach).any():
        found.append("off the map")
    discs = shapely.buffer(shapely.points(centres), rule.disc_radius, quad_segs=32)
    which, square = world.tree.query(discs, predicate="intersects")
    if len(which):
        area = shapely.area(shapely.intersection(discs[which], world.squares[square]))
        if (area > SLIVER).any():
            found.append(f"{len(set(which[area > SLIVER].tolist()))} footprints overlap obstacles")
    return found
