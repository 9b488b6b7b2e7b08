"""The map under the driven path: an occupancy grid of the log's scans, or the latest grid in the log."""

import io
import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from PIL import Image

from monstertruck_estimation.transforms import FrameTree, planar_pose
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import placed
from monstertruck_planners.collision import scan_points
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import NotFoundError
from monstertruck_schemas.sensor import LaserScan, SonarRanges
from monstertruck_schemas.state import Grid, Odometry, Transforms
from monstertruckd.gate.sonars import arc
from monstertruckd.recorder.occupancy import Area, OccupancyRaster

_MAX_TILT: Final = math.radians(3)
_STEP, _TURN, _REST = 0.08, 0.1, 20 * SECOND
"""Distance (m), turn (rad) or time (ns) since the previous scan at which the next one is added."""
_WALL, _FREE = 28.0, 255.0


@dataclass(frozen=True, slots=True)
class Picture:
    """Raster as PNG with transparency: unknown is transparent, free white, walls dark."""

    png: bytes
    area: Area


class PlacedScans:
    """Places scans at the poses given by the log."""

    def __init__(self) -> None:
        self._mounts = FrameTree()
        self._poses: deque[tuple[int, float, float, float]] = deque(maxlen=64)

    @property
    def newest(self) -> tuple[int, float, float, float] | None:
        """Stamp (ns) and latest pose (m, m, rad)."""
        return self._poses[-1] if self._poses else None

    def pose(self, odometry: Odometry) -> None:
        """Set the truck's latest pose in the map."""
        pose = odometry.pose
        self._poses.append((odometry.stamp, pose.x, pose.y, pose.yaw))

    def transforms(self, tree: Transforms) -> None:
        """Set the frame tree, for the lidar's mount."""
        self._mounts = FrameTree(tree.transforms)

    def place(self, scan: LaserScan) -> tuple[Array, Array]:
        """Return the position of the lidar, shape (2,), and its returns, shape (n, 2) (m); requires a known pose."""
        x, y, yaw = self._pose_at(scan.stamp + round(scan.scan_time / 2 * SECOND))
        mount = self._mount(scan.frame) or (0.0, 0.0, 0.0)
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = np.array([[cos, sin], [-sin, cos]])
        at = np.array([x, y])
        return at + np.array(mount[:2]) @ turn, at + scan_points(scan, mount) @ turn

    def arcs(self, ranges: SonarRanges) -> list[Array]:
        """Return the arc of each echo of a sonar with a known mount, (n, 2) (m); requires a known pose."""
        found = []
        for echo in ranges.sonars:
            mount = self._mount(f"sonar_{echo.name}")
            if echo.answered and echo.range is not None and mount is not None:
                points = arc(mount, echo.range, ranges.field_of_view / 2)
                found.append(placed(np.column_stack((points, np.zeros(len(points)))), self._pose_at(echo.stamp))[:, :2])
        return found

    def _mount(self, frame: str) -> tuple[float, float, float] | None:
        try:
            return planar_pose(self._mounts.lookup("base", frame))
        except NotFoundError:
            return None

    def _pose_at(self, stamp: int) -> tuple[float, float, float]:
        table = np.array(self._poses, np.float64)
        x, y, yaw = (float(np.interp(stamp, table[:, 0], column)) for column in (*table.T[1:3], np.unwrap(table[:, 3])))
        return x, y, yaw


class ScanMap:
    """Collects scans for a map; an occupancy grid in the log replaces it."""

    def __init__(self) -> None:
        self.scans = PlacedScans()
        self._raster = OccupancyRaster()
        self._grid: Grid | None = None
        self._taken: tuple[int, float, float, float] | None = None

    def grid(self, grid: Grid) -> None:
        """Set a newer occupancy grid."""
        self._grid = grid

    def scan(self, scan: LaserScan) -> None:
        """Add a scan if the truck has moved since the previous one."""
        newest = self.scans.newest
        if self._grid is not None or newest is None or (scan.tilt or 0.0) > _MAX_TILT:
            return
        if self._taken is not None and not _apart(self._taken, newest):
            return
        self._taken = newest
        self._raster.add(*self.scans.place(scan))

    def picture(self) -> Picture | None:
        """Return the map of the collected data; None without scans and grids."""
        if self._grid is not None:
            return _grid_picture(self._grid)
        occupancy = self._raster.occupancy()
        return _picture(occupancy, self._raster.area) if np.isfinite(occupancy).any() else None


def _apart(a: tuple[int, float, float, float], b: tuple[int, float, float, float]) -> bool:
    moved = math.dist(a[1:3], b[1:3]) > _STEP
    return moved or abs(math.remainder(b[3] - a[3], math.tau)) > _TURN or b[0] - a[0] > _REST


def _grid_picture(grid: Grid) -> Picture:
    cells = grid.cells.reshape(grid.height, grid.width).astype(np.float64)
    x, y = grid.origin.x, grid.origin.y
    area = Area(x, y, x + grid.width * grid.resolution, y + grid.height * grid.resolution)
    return _picture(np.where(cells < 0, np.nan, cells / 100.0), area)


def _picture(occupancy: Array, area: Area) -> Picture:
    """Return the map from fractions of hits, row 0 lowest, NaN unknown; cropped to the known cells."""
    known = np.isfinite(occupancy)
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    cell = (area.x1 - area.x0) / occupancy.shape[1]
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    wall = np.clip(np.nan_to_num(occupancy[part]) * 2.0, 0.0, 1.0)
    shade = np.stack([_FREE + (_WALL - _FREE) * wall, np.where(known[part], 255.0, 0.0)], axis=-1)
    image = Image.fromarray(np.flipud(shade).astype(np.uint8), "LA")
    greatest_side = 1400  # pixels of the picture's longer side
    image.thumbnail((greatest_side, greatest_side))
    data = io.BytesIO()
    image.save(data, "PNG", optimize=True)
    x0, y0 = area.x0 + columns[0] * cell, area.y0 + rows[0] * cell
    return Picture(data.getvalue(), Area(x0, y0, x0 + wall.shape[1] * cell, y0 + wall.shape[0] * cell))
