"""Ground of zones: boundary points for sweeps, limits at points, and cells of grids."""

import math
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, points_placed, points_relative
from monstertruck_planners.collision import Footprint, on_body
from monstertruck_schemas.zones import Zone, ZoneMask, Zones

SPACING: Final = 0.02
"""Distance between the points of a boundary (m); the padding of a footprint covers half of it."""


class Boundary(NamedTuple):
    """Points on boundaries of zones."""

    points: Array
    """Points, shape (n, 2) (m)."""
    limits: Array
    """Maximum speed on the slower side of each point, shape (n,) (m/s); 0 for keepout."""
    zones: NDArray[np.intp]
    """Index of each point's zone, shape (n,)."""

    def of(self, which: NDArray[np.bool_]) -> "Boundary":
        """Return the points selected by a mask of shape (n,)."""
        return Boundary(self.points[which], self.limits[which], self.zones[which])


class ZoneShape:
    """Ground of one zone.

    Args:
        zone: polygon or mask.
    """

    def __init__(self, zone: Zone) -> None:
        self.zone = zone
        self._limit = 0.0 if zone.limit is None else zone.limit
        if zone.mask is None:
            self._corners = np.array(zone.corners)
            self.points: Array = _along(self._corners)
            self.limits: Array = np.full(len(self.points), self._limit)
        else:
            self._cells = limits_of(zone.mask)
            self.points, self.limits = _edges(self._cells, zone.mask)

    def same_ground(self, zone: Zone) -> bool:
        """Whether another version of the zone covers the same ground with the same limits."""
        mine = self.zone
        return (mine.corners, mine.limit) == (zone.corners, zone.limit) and mine.mask is zone.mask

    def limits_at(self, points: Array) -> Array:
        """Return the maximum speeds at points, shape (..., 2) (m), as shape (...) (m/s); +inf outside the zone."""
        mask = self.zone.mask
        if mask is None:
            return np.where(inside(points, self._corners), self._limit, np.inf)
        column, row = (np.floor((points[..., i] - (mask.x, mask.y)[i]) / mask.resolution).astype(int) for i in (0, 1))
        rows, columns = self._cells.shape
        there = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.where(there, self._cells[np.where(there, row, 0), np.where(there, column, 0)], np.inf)


class ZoneLayer:
    """Ground of several zones.

    Args:
        zones: zones in force.
        before: previous layer, whose shapes of unchanged zones are reused.
    """

    def __init__(self, zones: Iterable[Zone] = (), before: "ZoneLayer | None" = None) -> None:
        known = {} if before is None else {shape.zone.name: shape for shape in before.shapes}
        self.shapes: list[ZoneShape] = [
            shape if (shape := known.get(zone.name)) is not None and shape.same_ground(zone) else ZoneShape(zone)
            for zone in zones
        ]
        empty = np.empty((0, 2))
        counts = [len(shape.points) for shape in self.shapes]
        self.boundary = Boundary(
            np.concatenate([empty, *(shape.points for shape in self.shapes)]),
            np.concatenate([empty[:, 0], *(shape.limits for shape in self.shapes)]),
            np.repeat(np.arange(len(counts)), counts),
        )

    def near(self, place: tuple[float, float], reach: float) -> Boundary:
        """Return the boundary points in a square around a place, ``reach`` (m) to each side."""
        x, y = self.boundary.points.T
        return self.boundary.of((np.abs(x - place[0]) <= reach) & (np.abs(y - place[1]) <= reach))

    def reached(self, footprint: Footprint, pose: Pose2, margin: float = 0.0) -> Iterator[tuple[ZoneShape, float]]:
        """Return the zones overlapped by a footprint, each with its lowest limit there (m/s).

        Args:
            footprint: footprint of the robot.
            pose: pose of the base in map.
            margin: distance from the outline that counts as inside (m).
        """
        close = self.near(pose[:2], footprint.circumscribed_radius + margin)
        close = close.of(on_body(footprint, points_relative(close.points, pose), margin))
        (centre,) = points_placed(np.array([[footprint.offset, 0.0]]), pose)
        for index, shape in enumerate(self.shapes):
            lowest = float(close.limits[close.zones == index].min(initial=float(shape.limits_at(centre))))
            if math.isfinite(lowest):
                yield shape, lowest

    def keepout_near(self, place: tuple[float, float], reach: float) -> Array:
        """Return the boundary points of keepout zones in a square around a place, shape (n, 2) (m)."""
        near = self.near(place, reach)
        return near.of(near.limits == 0.0).points

    def keepout_at(self, place: tuple[float, float]) -> str | None:
        """Return the name of a keepout zone at a place in map (m); None without one."""
        at = np.array(place)
        return next((shape.zone.name for shape in self.shapes if float(shape.limits_at(at)) == 0.0), None)

    def outside(self, footprint: Footprint, pose: Pose2) -> "ZoneLayer":
        """Return the layer without the keepout zones that contain the robot, so that no boundary encloses it."""
        inside = {shape.zone.name for shape, limit in self.reached(footprint, pose) if limit == 0.0}
        return self if not inside else ZoneLayer([s.zone for s in self.shapes if s.zone.name not in inside], self)

    def keepout(self, footprint: Footprint, pose: Pose2, margin: float = 0.0) -> str | None:
        """Return the name of a keepout zone overlapped by a footprint; None without one."""
        reached = self.reached(footprint, pose, margin)
        return next((shape.zone.name for shape, limit in reached if limit == 0.0), None)

    def keepout_cells(
        self, shape: tuple[int, ...], resolution: float, origin: Pose2, margin: float
    ) -> NDArray[np.bool_]:
        """Return the cells of a grid nearer than ``margin`` (m) to keepout zones. For workers: it loads scipy.

        Args:
            shape: rows and columns.
            resolution: side of a cell (m).
            origin: pose of the outer corner of cell (0, 0).
            margin: minimum clearance (m).

        Returns:
            Shape (rows, columns).
        """
        from scipy.spatial import cKDTree  # noqa: PLC0415  # workers only

        cells = np.zeros(shape, np.bool_)
        far = margin + resolution * math.sqrt(0.5)
        for ground in self.shapes:
            edge = ground.points[ground.limits == 0.0]
            if not len(edge):
                continue
            there = points_relative(edge, origin)
            low = np.floor((there.min(axis=0) - far) / resolution).astype(int)
            high = np.ceil((there.max(axis=0) + far) / resolution).astype(int)
            left, bottom = np.clip(low, 0, shape[::-1]).tolist()
            right, top = np.clip(high, 0, shape[::-1]).tolist()
            row, column = np.mgrid[bottom:top, left:right].reshape(2, -1)
            if not len(row):
                continue
            centres = points_placed((np.column_stack((column, row)) + 0.5) * resolution, origin)
            distance, _ = cKDTree(edge).query(centres, distance_upper_bound=far)
            taken = (distance <= far) | (ground.limits_at(centres) == 0.0)
            cells[row[taken], column[taken]] = True
        return cells


def in_force(zones: Zones) -> list[Zone]:
    """Return the enabled zones."""
    return [zone for zone in zones.zones if zone.off_until is None]


def changed(newest: Zones | None, before: Zones | None) -> Zones | None:
    """Return the latest message if its zones differ from the previous ones, else None."""
    same = newest is None or (before is not None and newest.zones == before.zones)
    return None if same else newest


def inside(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Return which points lie inside a polygon, by the even-odd rule.

    Args:
        points: points, shape (..., 2) (m).
        corners: corners of the polygon, shape (n, 2) (m).

    Returns:
        Shape (...,).
    """
    x, y = points[..., 0, None], points[..., 1, None]
    (x0, y0), (x1, y1) = corners.T, np.roll(corners, -1, axis=0).T
    crosses = (y0 > y) != (y1 > y)
    rise = np.where(y1 == y0, 1.0, y1 - y0)
    left = x < x0 + (y - y0) / rise * (x1 - x0)
    return np.asarray((crosses & left).sum(axis=-1) % 2 == 1)


def limits_of(mask: ZoneMask) -> Array:
    """Return the maximum speed of each cell of a mask, shape (rows, columns) (m/s); +inf without a limit."""
    levels, counts = np.array(mask.runs, np.intp).reshape(-1, 2).T
    return np.repeat(np.array((np.inf, *mask.limits))[levels], counts).reshape(mask.height, mask.width)


def mask_of(limits: Array, resolution: float, origin: tuple[float, float]) -> ZoneMask | None:
    """Return the mask of speed limits, trimmed to the cells with a limit; None without any.

    Args:
        limits: limits, shape (rows, columns), row 0 at the lowest y (m/s); +inf without a limit.
        resolution: side of a cell (m).
        origin: x, y of the outer corner of cell (0, 0) (m).
    """
    rows, columns = np.isfinite(limits).nonzero()
    if not len(rows):
        return None
    bottom, left = int(rows.min()), int(columns.min())
    part = limits[bottom : rows.max() + 1, left : columns.max() + 1]
    different, levels = np.unique(part, return_inverse=True)
    known = different[np.isfinite(different)]
    levels = np.where(levels < len(known), levels + 1, 0).ravel()
    starts = np.flatnonzero(np.diff(levels, prepend=-1))
    runs = np.column_stack((levels[starts], np.diff(starts, append=len(levels))))
    return ZoneMask(
        resolution=resolution,
        width=part.shape[1],
        height=part.shape[0],
        x=origin[0] + left * resolution,
        y=origin[1] + bottom * resolution,
        limits=tuple(known.tolist()),
        runs=tuple(runs.ravel().tolist()),
    )


def _along(corners: Array) -> Array:
    """Return points on the edges of a polygon including its corners, shape (n, 2)."""
    edges = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = max(math.ceil(math.dist(start, end) / SPACING), 1)
        edges.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate(edges)


def _edges(limits: Array, mask: ZoneMask) -> tuple[Array, Array]:
    """Return points on edges between cells of different limits, (n, 2), and the lower limit at each, (n,)."""
    padded = np.pad(limits, 1, constant_values=np.inf)
    res = mask.resolution
    count = math.ceil(res / SPACING)
    shares = (np.arange(count) + 0.5) / count
    points, lower = [], []
    for axis in (0, 1):  # edges along x, between rows; edges along y, between columns
        grid = padded if axis == 0 else padded.T
        row, column = np.nonzero(grid[1:] != grid[:-1])
        across = np.repeat(row.astype(float), count)
        along = (column[:, None] - 1.0 + shares).ravel()
        pair = np.column_stack((along, across) if axis == 0 else (across, along))
        points.append(pair * res + (mask.x, mask.y))
        lower.append(np.repeat(np.minimum(grid[1:], grid[:-1])[row, column], count))
    return np.concatenate(points), np.concatenate(lower)
