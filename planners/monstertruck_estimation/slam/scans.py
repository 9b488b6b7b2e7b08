"""Conversion of ranges to surface elements: deskewing, levelling, and points with normals.

Every point carries the covariance of its surface element, from the unit normal (towards the sensor) and the variances
along and across the surface: a point among neighbours on a line is unconstrained along that line, a lone point is
constrained equally in all directions (generalised ICP: Segal, Haehnel, Thrun 2009).
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Twist2

RANGE_NOISE: Final = 0.012
"""Minimum standard deviation of a short range (m) (URG-04LX and SICK LMS200 manuals: 10 to 15 mm)."""
RELATIVE_NOISE: Final = 0.005
"""Increase per metre of range (beam width; URG-04LX: limits of 1 % of the range)."""
SLIDE: Final = 5.0
"""Standard deviation along a line (m): unconstrained."""


STEEPEST: Final = math.sin(math.radians(60))


@dataclass(frozen=True, slots=True)
class ScanGeometry:
    """Geometry that converts ranges to points in base."""

    start_angle: float
    """Angle of the first beam (rad), counter-clockwise from the sensor's x axis."""
    angle_increment: float
    """Angle between neighbouring beams (rad)."""
    range_min: float
    """Minimum range (m); shorter ranges mean no return."""
    range_max: float
    """Maximum range (m); ranges from it on mean no return."""
    time_increment: float = 0.0
    """Time between neighbouring beams (s)."""
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose of the sensor in base (m, rad)."""
    noise: float = 0.0
    """Standard deviation of a short range (m), used if above ``RANGE_NOISE``."""


@dataclass(frozen=True, slots=True)
class Scan:
    """Points of one scan in base at the time of its first beam."""

    points: Array
    """Points, shape (n, 2) (m)."""
    normals: Array
    """Unit normals towards the sensor, shape (n, 2)."""
    variances: Array
    """Variances across and along the surface, shape (n, 2) (m^2)."""
    extents: Array
    """Half of the surface length that each point stands for, shape (n,) (m); 0 for lone points."""

    def __len__(self) -> int:
        return len(self.points)

    def downsampled(self, cell: float, most: int) -> "Scan":
        """Return about one point per square of ``cell``, and at most ``most``, spread evenly."""
        kept = downsample_indices(self.points, cell)
        if len(kept) > most:
            kept = kept[np.linspace(0, len(kept) - 1, most).astype(np.intp)]
        return self.chosen(kept)

    def averaged(self, cell: float) -> "Scan":
        """Return the mean, as uncertain as one point, of the points in every square of ``cell`` facing one quadrant.

        Every piece of surface then has equal weight, whatever its number of beams.
        """
        quarters = np.floor(np.arctan2(self.normals[:, 1], self.normals[:, 0]) / (math.pi / 2)).astype(np.int64)
        keys = _cells(self.points, cell) * 4 + quarters % 4
        _, first, group, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
        order = np.argsort(first)

        def mean(values: Array) -> Array:
            sums = np.stack([np.bincount(group, column) for column in values.T], axis=1)
            return np.ascontiguousarray((sums / counts[:, None])[order])

        normals = mean(self.normals)
        normals /= np.hypot(normals[:, 0], normals[:, 1])[:, None]
        return Scan(mean(self.points), normals, mean(self.variances), mean(self.extents[:, None])[:, 0])

    def chosen(self, kept: NDArray[np.intp] | NDArray[np.bool_]) -> "Scan":
        """Return the marked or numbered points."""
        return Scan(self.points[kept], self.normals[kept], self.variances[kept], self.extents[kept])


def prepare(
    ranges: Array,
    geometry: ScanGeometry,
    twist: tuple[float, float, float] = (0.0, 0.0, 0.0),
    longest: float = math.inf,
) -> Scan:
    """Return points with normals; beams without a return, NaN and ranges out of bounds are left out.

    Args:
        ranges: shape (n,) (m); non-finite values mean no return.
        geometry: angles, limits, times and mount.
        twist: velocity of base (vx, vy, wz; m/s, rad/s), for deskewing.
        longest: maximum range that is used (m).
    """
    values = np.ascontiguousarray(ranges, dtype=np.float64)
    limit = min(geometry.range_max, np.nextafter(longest, math.inf))
    xs, ys, yaw = geometry.mount
    elements = _prepare(
        values,
        geometry.start_angle,
        geometry.angle_increment,
        geometry.range_min,
        limit,
        geometry.time_increment,
        np.array((xs, ys, yaw)),
        np.array(twist, dtype=np.float64),
        max(geometry.noise, RANGE_NOISE),
    )
    return Scan(*elements)


def prepare_input(inputs: ScanInput, longest: float, twist: Twist2 = (0.0, 0.0, 0.0)) -> Scan:
    """Return the points of a scan in base: deskewed, levelled, without hits of the ground or the ceiling.

    Args:
        inputs: scan with mount and tilt.
        longest: maximum range that is used (m).
        twist: twist of the base, m/s and rad/s, used without odometry.
    """
    geometry = ScanGeometry(
        inputs.start_angle,
        inputs.angle_increment,
        inputs.range_min,
        inputs.range_max,
        inputs.time_increment,
        inputs.mount,
        inputs.range_noise or 0.0,
    )
    return prepare(level_ranges(inputs), geometry, twist if inputs.odom is None else inputs.twist, longest)


def level_ranges(inputs: ScanInput) -> Array:
    """Return the horizontal ranges; NaN for beams that hit the ground or the ceiling.

    A beam at angle a rises by cos(a) sx + sin(a) sy per metre, with the ``slopes`` (sx, sy) of the sensor's axes.
    """
    ranges = np.asarray(inputs.ranges, dtype=np.float64)
    if inputs.slopes is None:
        return ranges
    angles = inputs.start_angle + inputs.angle_increment * np.arange(len(ranges))
    rise = np.clip(np.cos(angles) * inputs.slopes[0] + np.sin(angles) * inputs.slopes[1], -STEEPEST, STEEPEST)
    result: Array = ranges * np.sqrt(1.0 - rise**2)
    # Levelling must not turn a no-return just beyond the limit into a range.
    result[~(ranges < inputs.range_max)] = np.inf
    if inputs.height is not None:
        with np.errstate(invalid="ignore"):
            ends = inputs.height + ranges * rise
            ground = 0.05  # maximum distance of a hit from ground or ceiling, m
            hit = ends < ground
            if inputs.ceiling is not None:
                hit |= ends > inputs.ceiling - ground
        result[hit] = np.nan
    return result


@njit(cache=True)
def _prepare(ranges, start, increment, shortest, longest, beam_time, mount, twist, near):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Compute the arrays of ``Scan``."""
    n = 0
    for r in ranges:
        if r >= shortest and r < longest:
            n += 1
    points = np.empty((n, 2))
    origins = np.empty((n, 2))
    beams = np.empty(n, np.int64)
    reach = np.empty(n)
    k = 0
    for i in range(ranges.size):
        r = ranges[i]
        if not (r >= shortest and r < longest):
            continue
        angle = start + i * increment + mount[2]
        x = mount[0] + r * math.cos(angle)
        y = mount[1] + r * math.sin(angle)
        dt = i * beam_time
        turn = twist[2] * dt
        # Along the arc: half of the turn before the translation, half after it.
        wx = (twist[0] * math.cos(turn / 2) - twist[1] * math.sin(turn / 2)) * dt
        wy = (twist[0] * math.sin(turn / 2) + twist[1] * math.cos(turn / 2)) * dt
        c, s = math.cos(turn), math.sin(turn)
        points[k, 0] = wx + c * x - s * y
        points[k, 1] = wy + s * x + c * y
        origins[k, 0] = wx + c * mount[0] - s * mount[1]
        origins[k, 1] = wy + s * mount[0] + c * mount[1]
        beams[k] = i
        reach[k] = r
        k += 1
    normals = np.empty((n, 2))
    variances = np.empty((n, 2))
    extents = np.zeros(n)
    joined = np.zeros(n + 1, np.bool_)  # with the previous point
    for i in range(1, n):
        joined[i] = _joined(points, beams, reach, abs(increment), near, i - 1, i)
    for i in range(n):
        _surface(points, origins, joined, reach, abs(increment), near, i, normals, variances, extents)
    return points, normals, variances, extents


@njit(cache=True)
def _joined(points, beams, reach, increment, near, a, b):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Whether the neighbouring points ``a`` and ``b`` plausibly lie on one surface."""
    gap = beams[b] - beams[a]
    if gap > 3:
        return False
    r = min(reach[a], reach[b])
    apart = math.hypot(points[a, 0] - points[b, 0], points[a, 1] - points[b, 1])
    # Minimum angle between the line through the ends of neighbouring beams and the beam for a common surface, rad.
    grazing = 0.12
    return apart < r * increment * gap / grazing + 3.0 * (near + RELATIVE_NOISE * r)


@njit(cache=True)
def _surface(points, origins, joined, reach, increment, near, i, normals, variances, extents):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Compute normal and variances of point ``i`` from its neighbours in beam order."""
    noise = near + RELATIVE_NOISE * reach[i]
    spacing = reach[i] * increment
    window = max(0.2, 2.5 * spacing)
    sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0
    count = 1
    px, py = points[i, 0], points[i, 1]
    closest, square, furthest = i, 1e18, 0.0
    for side in (-1, 1):
        k = i + side
        while joined[max(k, k - side)]:
            dx, dy = points[k, 0] - px, points[k, 1] - py
            xx, yy = dx * dx, dy * dy
            if xx + yy < square:
                closest, square = k, xx + yy
            if k == i + side:
                furthest = max(furthest, math.hypot(dx, dy))
            elif xx + yy > window * window:
                break
            sx += dx
            sy += dy
            sxx += xx
            sxy += dx * dy
            syy += yy
            count += 1
            k += side
    nearest = math.hypot(points[closest, 0] - px, points[closest, 1] - py) if closest != i else 1e9
    bx, by = origins[i, 0] - px, origins[i, 1] - py
    length = math.hypot(bx, by)
    if length < 1e-9:
        bx, by, length = 1.0, 0.0, 1.0
    slanted = 3.0  # two lone neighbours this many beam spacings apart are on a wall seen at an oblique angle
    # Two points far apart are the end of a wall along the beam; two close together may be a chair leg.
    if count >= 3 or (count == 2 and furthest > slanted * spacing):
        mx, my = sx / count, sy / count
        cxx, cxy, cyy = sxx / count - mx * mx, sxy / count - mx * my, syy / count - my * my
        middle, half = (cxx + cyy) / 2, math.hypot((cxx - cyy) / 2, cxy)
        small, large = max(middle - half, 0.0), middle + half
        if small < (2.0 * noise) ** 2 and small < 0.1 * large:
            angle = 0.5 * math.atan2(2 * cxy, cxx - cyy)
            nx, ny = -math.sin(angle), math.cos(angle)
            if nx * bx + ny * by < 0:
                nx, ny = -nx, -ny
            normals[i, 0], normals[i, 1] = nx, ny
            variances[i, 0], variances[i, 1] = max(noise * noise, small), SLIDE * SLIDE
            extents[i] = furthest / 2
            return
    normals[i, 0], normals[i, 1] = bx / length, by / length
    around = noise * noise + (min(nearest, window) / 2) ** 2 / 3
    variances[i, 0], variances[i, 1] = around, around


@njit(cache=True)
def _cells(points, cell):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    keys = np.empty(points.shape[0], np.int64)
    for i in range(points.shape[0]):
        keys[i] = np.int64(math.floor(points[i, 0] / cell)) * 1048583 + np.int64(math.floor(points[i, 1] / cell))
    return keys


def downsample_indices(points: Array, cell: float) -> NDArray[np.intp]:
    """Return rising indices of one point in every square of ``cell`` m.

    The choice must not depend on the noise: the first point in beam order would be the one that noise moved across the
    edge, which would rotate every wall a little.
    """
    # The fractional parts of its multiples mix early and late beams evenly.
    golden = (math.sqrt(5.0) - 1.0) / 2.0
    order = np.argsort(np.arange(len(points)) * golden % 1.0, kind="stable")
    _, first = np.unique(_cells(points[order], cell), return_index=True)
    return np.sort(order[first])


def scans_in_a_room() -> list[ScanInput]:
    """Return four scans of a drive in a square room, for workers that compile everything before the first scan."""
    angles = np.linspace(-2.0, 2.0, 200)
    along, across = np.cos(angles), np.sin(angles)
    scans = []
    for i in range(4):
        x = 0.2 * i
        scans.append(
            ScanInput(
                stamp=(i + 1) * 10**8,
                ranges=np.minimum((2.0 - x * np.sign(along)) / np.abs(along), 2.0 / np.abs(across)),
                start_angle=-2.0,
                angle_increment=float(angles[1] - angles[0]),
                range_min=0.02,
                range_max=5.6,
                odom=(x, 0.0, 0.0),
            )
        )
    return scans
