"""Collision checks of the truck's footprint against scan points and occupancy grids, for gate, trackers and planners.

Poses are (x, y, yaw) in the same frame as the points or the grid; distances are metres, negative inside the footprint.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import integrate
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan

if TYPE_CHECKING:
    from monstertruck_planners.collision_kernels import FieldData, FootprintData
    from monstertruck_planners.distance_kernels import Box
    from monstertruck_schemas.state import Grid


OCCUPIED = 50
"""Minimum occupancy of an obstacle cell, percent."""


UnitTwist = tuple[float, float, float]
"""Twist of the base (vx, vy, wz) per metre of distance travelled: m/m, m/m, rad/m."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """Rectangle around the reference point of poses (the base), grown by ``padding`` on every side.

    Args:
        length: length along x, m.
        width: width along y, m.
        padding: distance added on each side, m.
        offset: distance of the rectangle's centre ahead of the reference point, m; half a wheelbase for poses of the
            rear axle.

    Raises:
        InputError: length or width not above zero, or negative padding.
    """

    length: float = 0.47
    width: float = 0.34
    padding: float = 0.01
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not (self.length > 0 and self.width > 0 and self.padding >= 0):
            msg = (
                f"footprint {self.length} x {self.width} m, padding {self.padding} m: expected length and "
                "width above 0 and padding of at least 0"
            )
            raise InputError(msg)

    @property
    def half_length(self) -> float:
        """Half the padded length, m."""
        return self.length / 2 + self.padding

    @property
    def half_width(self) -> float:
        """Half the padded width, m."""
        return self.width / 2 + self.padding

    @property
    def circumscribed_radius(self) -> float:
        """Radius of the circle around the poses' point that contains the padded rectangle, m."""
        return math.hypot(self.half_length + abs(self.offset), self.half_width)

    @property
    def inscribed_radius(self) -> float:
        """Radius of the largest circle around the poses' point inside the padded rectangle, m."""
        return max(min(self.half_length - abs(self.offset), self.half_width), 0.0)

    def corner_speed(self, twist: UnitTwist) -> float:
        """Upper bound of the speed of its points at a twist of the base, m/s; of a unit twist m/m."""
        return math.hypot(twist[0], twist[1]) + abs(twist[2]) * self.circumscribed_radius

    def edge_points(self, along: int, across: int) -> Array:
        """Points on its edges in base, shape (n, 2), m: ``along`` on each side, ``across`` on each end."""
        half_length, half_width = self.half_length, self.half_width
        x, y = np.linspace(-half_length, half_length, along), np.linspace(-half_width, half_width, across)
        ends, sides = np.full(across, half_length), np.full(along, half_width)
        return np.column_stack(
            (np.concatenate((x, x, ends, -ends)) + self.offset, np.concatenate((sides, -sides, y, y)))
        )

    def covering_discs(self, count: int = 3) -> tuple[Array, float]:
        """``count`` discs along x that together cover the rectangle.

        Returns:
            Their centres on the x axis, shape (count,), m, and their common radius, m.
        """
        half = self.half_length / count
        centres = np.array([self.offset - self.half_length + half * (2 * i + 1) for i in range(count)])
        return centres, math.hypot(half, self.half_width)

    def data(self) -> "FootprintData":
        """Arguments of the numba functions."""
        from monstertruck_planners.collision_kernels import FootprintData  # noqa: PLC0415 - workers only

        discs, radius = self.covering_discs()
        reach = float(np.abs(discs).max())
        return FootprintData(
            discs, radius, self.half_length, self.half_width, self.offset, self.inscribed_radius, reach
        )


@dataclass(frozen=True, slots=True)
class DiscFootprint:
    """Union of equal discs on the x axis.

    Args:
        centres: x of each, m.
        radius: m.

    Raises:
        InputError: no disc, or a radius not above zero.
    """

    centres: tuple[float, ...]
    radius: float

    def __post_init__(self) -> None:
        if not (self.centres and self.radius > 0):
            raise InputError(
                f"footprint of {len(self.centres)} discs of {self.radius} m: expected a disc, radius above 0 m"
            )

    @property
    def circumscribed_radius(self) -> float:
        """Radius of the circle around the poses' point that contains all discs, m."""
        return max(map(abs, self.centres)) + self.radius

    @property
    def inscribed_radius(self) -> float:
        """Radius of the largest circle around the poses' point inside one of the discs, m."""
        return max(self.radius - min(map(abs, self.centres)), 0.0)

    def data(self) -> "FootprintData":
        """Arguments of the numba functions."""
        from monstertruck_planners.collision_kernels import FootprintData  # noqa: PLC0415 - workers only

        reach = max(map(abs, self.centres))
        return FootprintData(np.array(self.centres), self.radius, 0.0, 0.0, 0.0, self.inscribed_radius, reach)


def rectangle_distance(footprint: Footprint, poses: Array, points: Array) -> Array:
    """Signed distance of every point from the footprint at every pose, exact.

    Args:
        footprint: the rectangle.
        poses: shape (m, 3).
        points: shape (n, 2), same frame.

    Returns:
        Shape (m, n), m; negative inside.
    """
    return _distance(*beyond(footprint, poses, points))


def beyond(footprint: Footprint, poses: Array, points: Array) -> tuple[Array, Array]:
    """Return the distances of points beyond the footprint's ends and sides at every pose, each of shape (m, n), m."""
    x, y = relative(points, poses)
    return np.abs(x - footprint.offset) - footprint.half_length, np.abs(y) - footprint.half_width


def relative(points: Array, poses: Array) -> tuple[Array, Array]:
    """X and y of points (n, 2) in the frame of every pose (m, 3), each of shape (m, n)."""
    at_x, at_y, yaw = poses.T
    c, s = np.cos(yaw), np.sin(yaw)
    x: Array = np.column_stack((c, s)) @ points.T - (c * at_x + s * at_y)[:, None]
    y: Array = np.column_stack((-s, c)) @ points.T - (c * at_y - s * at_x)[:, None]
    return x, y


def _distance(beyond_x: Array, beyond_y: Array) -> Array:
    out_x, out_y = np.maximum(beyond_x, 0.0), np.maximum(beyond_y, 0.0)
    distance: Array = np.sqrt(out_x * out_x + out_y * out_y) + np.minimum(np.maximum(beyond_x, beyond_y), 0.0)
    return distance


def clearance_to_points(footprint: Footprint, poses: Array, points: Array) -> Array:
    """Signed distance from the footprint to the nearest point, for every pose.

    Args:
        footprint: the rectangle.
        poses: shape (m, 3).
        points: shape (n, 2), same frame.

    Returns:
        Shape (m,), m; +inf where there are no points.
    """
    if len(points) == 0:
        return np.full(len(poses), np.inf)
    return np.asarray(rectangle_distance(footprint, poses, points).min(axis=1))


def points_near(points: Array, poses: Array, reach: float) -> Array:
    """Points within the bounding box of the poses, grown by ``reach``.

    Args:
        points: shape (n, 2).
        poses: shape (m, 3), same frame.
        reach: m.

    Returns:
        Shape (k, 2).
    """
    low, high = poses[:, :2].min(axis=0) - reach, poses[:, :2].max(axis=0) + reach
    x, y = points[:, 0], points[:, 1]
    near: Array = points[(x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])]
    return near


def on_body(body: Footprint, points: Array, margin: float) -> NDArray[np.bool_]:
    """Return which points (n, 2) in base lie on the body or within ``margin`` of it, m."""
    on: NDArray[np.bool_] = (np.abs(points[:, 0] - body.offset) < body.half_length + margin) & (
        np.abs(points[:, 1]) < body.half_width + margin
    )
    return on


def first_contact(
    footprint: Footprint, poses: Array, points: Array, margin: float = 0.0, leaving: Array | None = None
) -> int | None:
    """Return the index of the first pose whose footprint comes within ``margin`` of a point.

    A point whose distance does not fall below its distance at the first pose does not obstruct the motion: a truck that
    stands at a wall may leave it. A sideways motion still comes closer to points of the wall that were ahead. With
    ``leaving``, the footprint must keep the distance that the nearest of them had at the first pose (at least half of
    the padding), plus the value of ``leaving`` at each pose.

    Args:
        footprint: the rectangle.
        poses: shape (m, 3), in driving order, starting with the current pose.
        points: shape (n, 2), same frame.
        margin: m.
        leaving: shape (m,), m; None: the margin applies to all points that come nearer.

    Returns:
        The index, at least 1, or None if all poses are free.
    """
    near = points_near(points, poses, footprint.circumscribed_radius + margin)
    if len(near) == 0:
        return None
    beyond_x, beyond_y = beyond(footprint, poses, near)
    # The exact distance is computed only for points that are touched.
    touching = (beyond_x < margin) & (beyond_y < margin)
    points_touched = touching.any(axis=0)
    if not points_touched.any():
        return None
    distance = _distance(beyond_x[:, points_touched], beyond_y[:, points_touched])
    kept: float | Array = margin
    if leaving is not None:
        outside = distance[0][distance[0] >= -footprint.padding]  # deeper ones are parts of the robot itself
        nearest = max(float(outside.min(initial=margin)), -footprint.padding / 2)
        kept = np.minimum(margin, nearest + leaving)[:, None]
    hits = ((distance < kept) & (distance < distance[0] - 1e-9)).any(axis=1)
    return int(np.argmax(hits)) if hits.any() else None


def free_distance(
    footprint: Footprint, twist: UnitTwist, points: Array, reach: float, step: float, margin: float
) -> float:
    """Distance that a footprint can travel with a constant twist before it touches a point, m; +inf beyond ``reach``.

    Args:
        footprint: outline.
        twist: twist of the base.
        points: obstacles in base, shape (n, 2), m.
        reach: distance checked, m.
        step: greatest motion of the outline between two poses checked, m.
        margin: see ``first_contact``, m.
    """
    distances = np.linspace(0.0, reach, max(2, math.ceil(reach * max(footprint.corner_speed(twist), 1.0) / step) + 1))
    contact = first_contact(footprint, swept_poses(twist, distances), points, margin)
    return math.inf if contact is None else float(distances[contact - 1])


def swept_poses(twist: UnitTwist, distances: Array) -> Array:
    """Poses of the base, starting at the origin, on the arc of a constant twist.

    Args:
        twist: twist of the base.
        distances: travelled, shape (m,), m; negative backwards.

    Returns:
        Shape (m, 3).
    """
    still = np.zeros_like(distances)
    vx, vy, wz = (component * distances for component in twist)
    return np.column_stack(integrate((still, still, still), vx, vy, wz, 1.0))


def scan_points(scan: LaserScan, mount: tuple[float, float, float]) -> Array:
    """Valid returns of a scan in the base frame.

    Args:
        scan: the revolution.
        mount: pose (x, y, yaw) of the lidar in base, m, m, rad.

    Returns:
        Shape (n, 2), m.
    """
    valid = _valid_beams(scan)
    ranges = scan.ranges[valid]
    bearing = mount[2] + scan.start_angle + scan.angle_increment * valid
    points = np.empty((len(valid), 2))
    points[:, 0] = mount[0] + ranges * np.cos(bearing)
    points[:, 1] = mount[1] + ranges * np.sin(bearing)
    return points


def _valid_beams(scan: LaserScan) -> NDArray[np.intp]:
    return np.flatnonzero((scan.codes == VALID_BEAM) & np.isfinite(scan.ranges))


def scan_points_at(
    scan: LaserScan, mount: tuple[float, float, float], stamp: int, twist: tuple[float, float, float]
) -> Array:
    """Return the valid returns of a scan in the base frame at a later time.

    A scan is a tenth of a second old on arrival; at 0.5 rad/s this turns a point 2 m away by 10 cm.

    Args:
        scan: the revolution.
        mount: pose (x, y, yaw) of the lidar in base, m, m, rad.
        stamp: stamp of the base frame, ns.
        twist: vx, vy, wz of the base since the beams, m/s and rad/s.

    Returns:
        Shape (n, 2), m.
    """
    points = scan_points(scan, mount)
    if not any(twist):
        return points
    beams = _valid_beams(scan).astype(np.float64)
    x, y, yaw = swept_poses(twist, (scan.stamp - stamp) / SECOND + beams * scan.time_increment).T
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack((x + c * points[:, 0] - s * points[:, 1], y + s * points[:, 0] + c * points[:, 1]))


class ScanPoints:
    """``scan_points`` of the latest scan, computed once and shared; read-only.

    Args:
        mount: pose (x, y, yaw) of the lidar in base, m, m, rad.
    """

    def __init__(self, mount: tuple[float, float, float]) -> None:
        self.mount = mount
        self._newest: tuple[LaserScan, Array] | None = None

    def of(self, scan: LaserScan) -> Array:
        """Shape (n, 2), m."""
        if self._newest is None or self._newest[0] is not scan:
            self._newest = scan, scan_points(scan, self.mount)
        return self._newest[1]


def boxes_of(mask: NDArray[np.bool_]) -> "list[Box]":
    """Boxes that hold all marked cells of a grid (rows, columns), one for each square of 64 by 64 cells with any."""
    boxes = []
    tile = 64  # edge of the compared squares of a grid, cells
    for row in np.flatnonzero(np.logical_or.reduceat(mask.any(axis=1), np.arange(0, len(mask), tile))) * tile:
        strip = mask[row : row + tile]
        columns = np.arange(0, mask.shape[1], tile)
        for column in np.flatnonzero(np.logical_or.reduceat(strip.any(axis=0), columns)) * tile:
            rows_in, columns_in = np.nonzero(strip[:, column : column + tile])
            top, left, bottom, right = rows_in.min(), columns_in.min(), rows_in.max() + 1, columns_in.max() + 1
            boxes.append((int(row + top), int(column + left), int(row + bottom), int(column + right)))
    return boxes


class DistanceField:
    """Distance to the nearest occupied cell of a grid, and footprint-true checks on it.

    Obstacles are the squares of occupied cells; everything outside the grid is occupied.
    Built in workers only: it loads numba.

    Args:
        occupied: shape (rows, columns), bool, row 0 at the lowest y.
        resolution: metres per cell.
        origin: pose (x, y, yaw) of the outer corner of cell (0, 0).
        previous: previous of the same place before: only the surroundings of what differs are computed again.
        unseen: shape of ``occupied``: ground that nothing may reverse onto; None: none.

    Raises:
        InputError: a grid that is not two-dimensional, or empty, or a resolution not above zero.
    """

    def __init__(
        self,
        occupied: NDArray[np.bool_],
        resolution: float,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        previous: "DistanceField | None" = None,
        unseen: NDArray[np.bool_] | None = None,
    ) -> None:
        if occupied.ndim != 2 or occupied.size == 0 or not resolution > 0:
            msg = (
                f"grid of shape {occupied.shape}, resolution {resolution} m: "
                "expected rows x columns, resolution above 0"
            )
            raise InputError(msg)
        self.resolution = resolution
        self.origin = origin
        # One ring of occupied cells stands for everything outside.
        self._occupied: NDArray[np.bool_] = np.pad(occupied, 1, constant_values=True)
        self._distance: NDArray[np.float32]
        self.changes: list[Box] | None = None
        """Parts of the grid with its ring whose field may differ from ``previous``; None: everywhere."""
        if previous is not None and previous.same_place(self._occupied.shape, resolution, origin):
            self._update(previous)
        else:
            self._compute()
        self._unseen = np.empty((0, 0), np.float32), np.empty((0, 0), np.bool_)
        if unseen is not None and unseen.any():
            ground = np.pad(unseen, 1)
            self._unseen = self._distances(ground), ground

    def same_place(self, shape: tuple[int, ...], resolution: float, origin: tuple[float, float, float]) -> bool:
        """Whether this field belongs to a grid with this shape (including the ring), resolution and origin."""
        return (self._occupied.shape, self.resolution, self.origin) == (shape, resolution, origin)

    def _compute(self) -> None:
        self._distance = self._distances(self._occupied)

    def _distances(self, cells: NDArray[np.bool_]) -> NDArray[np.float32]:
        from monstertruck_planners.distance_kernels import fill_distances  # noqa: PLC0415 - workers only

        whole, distances = (0, 0, *cells.shape), np.empty(cells.shape, np.float32)
        fill_distances(cells, self.resolution, whole, whole, distances)
        return distances

    def _update(self, previous: "DistanceField") -> None:
        from monstertruck_planners.distance_kernels import update_distances  # noqa: PLC0415 - workers only

        before = previous.data()
        boxes = boxes_of(self._occupied != before.occupied)
        if 2 * sum((box[2] - box[0]) * (box[3] - box[1]) for box in boxes) > self._occupied.size:
            self._compute()
            return
        self._distance = before.distance
        self.changes = []
        if boxes:
            # One box after the other: each update starts from distances that are right for the cells before it.
            occupied, self._distance = before.occupied.copy(), before.distance.copy()
            for box in boxes:
                part = np.s_[box[0] : box[2], box[1] : box[3]]
                occupied[part] = self._occupied[part]
                self.changes.append(update_distances(self._distance, occupied, self.resolution, box))

    @classmethod
    def from_grid(cls, grid: "Grid", *, unknown_blocks: bool = True) -> "DistanceField":
        """Field of a ``state/map`` grid; unknown cells count as occupied, or as free."""
        cells = grid.cells.reshape(grid.height, grid.width)
        occupied = cells >= OCCUPIED
        if unknown_blocks:
            occupied |= cells < 0
        return cls(occupied, grid.resolution, (grid.origin.x, grid.origin.y, grid.origin.yaw))

    def data(self) -> "FieldData":
        """Arguments of the numba functions: the grid with its ring."""
        from monstertruck_planners.collision_kernels import FieldData  # noqa: PLC0415 - workers only

        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        res = self.resolution
        corner = x - res * (c - s), y - res * (s + c)
        return FieldData(self._distance, self._occupied, res, *corner, c, s, *self._unseen)

    def lookup(self, points: Array) -> Array:
        """Distance to the nearest occupied cell centre, bilinear between cell centres.

        Args:
            points: shape (..., 2), in the grid's parent frame.

        Returns:
            Shape (...), m; 0 outside the grid.
        """
        column, row = self._cells(points)
        rows, columns = self._distance.shape
        inside = (row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1)
        r0 = np.clip(np.floor(row), 0, rows - 2).astype(np.intp)
        c0 = np.clip(np.floor(column), 0, columns - 2).astype(np.intp)
        fr, fc = row - r0, column - c0
        field = self._distance
        low = field[r0, c0] * (1 - fc) + field[r0, c0 + 1] * fc
        high = field[r0 + 1, c0] * (1 - fc) + field[r0 + 1, c0 + 1] * fc
        return np.where(inside, low * (1 - fr) + high * fr, 0.0)

    def _cells(self, points: Array) -> tuple[Array, Array]:
        """Fractional (column, row) indices in the grid with its ring; integers at cell centres."""
        x, y, yaw = self.origin
        dx, dy = points[..., 0] - x, points[..., 1] - y
        c, s = math.cos(yaw), math.sin(yaw)
        return (dx * c + dy * s) / self.resolution + 0.5, (dy * c - dx * s) / self.resolution + 0.5

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (..., 2) lie on the grid."""
        column, row = self._cells(points)
        rows, columns = self._distance.shape
        return np.asarray((row >= 0.5) & (row <= rows - 1.5) & (column >= 0.5) & (column <= columns - 1.5))

    def clearance(self, footprint: Footprint | DiscFootprint, poses: Array, most: float, step: float = 0.01) -> Array:
        """Distance from the footprint to the nearest occupied cell, rounded down to whole steps.

        Args:
            footprint: the truck.
            poses: shape (m, 3), in the grid's parent frame.
            most: maximum distance of the search, m.
            step: m.

        Returns:
            Shape (m,), m: 0 to ``most``.
        """
        clearance = np.zeros(len(poses))
        rest = np.arange(len(poses))
        for margin in np.arange(1, round(most / step) + 1) * step:
            rest = rest[self.free(footprint, poses[rest], margin)]
            clearance[rest] = margin
        return clearance

    def free(self, footprint: Footprint | DiscFootprint, poses: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """Whether the footprint, grown by ``margin`` on all sides, overlaps no occupied cell, exactly.

        Args:
            footprint: the truck.
            poses: shape (m, 3), in the grid's parent frame.
            margin: m.

        Returns:
            Shape (m,).
        """
        from monstertruck_planners.collision_kernels import free_poses  # noqa: PLC0415 - workers only

        poses = np.ascontiguousarray(poses, dtype=np.float64)
        return np.asarray(free_poses(self.data(), footprint.data(), margin, poses))
