"""Iterated fine registration of a scan to a cloud of surface elements (generalised ICP in the plane).

The residual of a pair is the vector d from the moved scan point to its nearest map point, weighted by the inverse of
the sum of both elements' covariances, under a Geman-McClure kernel. Gauss-Newton over (x, y, yaw), with an optional
prior of heavy (Cauchy) tails.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array

Index = NDArray[np.int32]

CELL: Final = 0.3
"""Edge of the cells for neighbour search (m); also the maximum distance of a pair."""
EDGE: Final = 0.03
"""Maximum offset along the surface between a scan point and its map point (m), besides half the map point's length.

Beyond it, the scan point lies outside the known surface, and the pair is ignored.
"""
CORRELATION: Final = 0.2
"""Factor on the information, because errors of neighbouring beams are correlated."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """Surface elements in one frame, hashed by cells of ``CELL`` metres."""

    points: Array
    """Points, shape (n, 2) (m)."""
    normals: Array
    """Unit normals towards the sensor that saw the points, shape (n, 2)."""
    variances: Array
    """Variances across and along the surface, shape (n, 2) (m^2)."""
    extents: Array
    """Half lengths, shape (n,) (m)."""
    starts: Index
    """First entry of ``order`` per bucket, shape (2^k + 1,)."""
    order: Index
    """Elements by bucket, shape (n,)."""

    @classmethod
    def of(cls, scan: Scan) -> "Cloud":
        """Return the elements of ``scan`` with their hash."""
        return cls(scan.points, scan.normals, scan.variances, scan.extents, *_hashed(scan.points))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Fit:
    """Result of a registration."""

    pose: Array
    """Pose of the scan's frame in the cloud's, shape (3,) (m, rad)."""
    information: Array
    """Information matrix of ``pose`` from the pairs alone (x, y in the cloud's frame, yaw), shape (3, 3)."""
    overlap: float
    """Share of the scan's points with a fitting partner."""
    residual: float
    """Root mean square distance of these pairs across the surface (m)."""
    pairs: int
    """Number of these pairs."""
    cost: float
    """Twice the negative log posterior of pairs and prior."""


NO_PRIOR: Final = np.zeros((3, 3))


def register(
    scan: Scan,
    cloud: Cloud,
    guess: Array,
    prior: Array = NO_PRIOR,
    iterations: int = 20,
    reach: float = CELL,
    start: Array | None = None,
) -> Fit:
    """Register ``scan`` to ``cloud``.

    Args:
        scan: points with normals in the moving frame.
        cloud: fixed map.
        guess: mean of the prior and, without ``start``, initial pose, shape (3,).
        prior: information of the guess in the cloud's frame, shape (3, 3).
        iterations: maximum number of Gauss-Newton steps.
        reach: maximum distance of a pair (m), up to ``CELL``.
        start: initial pose, shape (3,), if a coarse search found a better one.
    """
    pose, information, stats = _register(
        *_elements(scan, cloud),
        np.ascontiguousarray(guess if start is None else start, dtype=np.float64),
        np.ascontiguousarray(guess, dtype=np.float64),
        np.ascontiguousarray(prior),
        iterations,
        min(reach, CELL),
    )
    pairs = int(stats[0])
    total = max(len(scan), 1)
    return Fit(pose, information, pairs / total, math.sqrt(stats[1] / max(pairs, 1)), pairs, float(stats[2]))


def measure(scan: Scan, cloud: Cloud, pose: Array) -> Fit:
    """Return overlap, residual and information of ``scan`` at ``pose``, without moving it."""
    return register(scan, cloud, pose, iterations=0)


def fitting(scan: Scan, cloud: Cloud, pose: Array) -> NDArray[np.bool_]:
    """Mark the points (n,) of ``scan`` with a fitting partner at ``pose``; see ``Fit.overlap``."""
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    found = np.zeros(len(scan), np.bool_)
    _fitting(pose, *_elements(scan, cloud), CELL, found)
    return found


def normal_equations(scan: Scan, cloud: Cloud, pose: Array, reach: float = CELL) -> tuple[Array, Array, int]:
    """Return information (3, 3), gradient (3,) and number of fitting pairs of a registration at ``pose``."""
    h, g, stats = accumulate(np.ascontiguousarray(pose), *_elements(scan, cloud), min(reach, CELL), EDGE)
    return h, g, int(stats[0])


def _elements(scan: Scan, cloud: Cloud) -> tuple[Array, Array, Array, Array, Array, Array, Array, Index, Index]:
    """Return the arrays of both clouds for the kernels."""
    moved = scan.points, scan.normals, scan.variances
    return *moved, cloud.points, cloud.normals, cloud.variances, cloud.extents, cloud.starts, cloud.order


@njit(cache=True)
def _bucket(cx: int | np.int64, cy: int | np.int64, mask: int) -> int | np.int64:
    return (cx * 73856093 ^ cy * 19349663) & mask


@njit(cache=True)
def _hashed(points: Array) -> tuple[Index, Index]:
    """Sort into buckets by counting: return starts and order."""
    n = points.shape[0]
    size = 16
    while size < 2 * n:
        size *= 2
    mask = size - 1
    bucket = np.empty(n, np.int64)
    starts = np.zeros(size + 1, np.int32)
    for i in range(n):
        cx = np.int64(math.floor(points[i, 0] / CELL))
        cy = np.int64(math.floor(points[i, 1] / CELL))
        bucket[i] = _bucket(cx, cy, mask)
        starts[bucket[i] + 1] += 1
    for b in range(size):
        starts[b + 1] += starts[b]
    fill = starts[:-1].copy()
    order = np.empty(n, np.int32)
    for i in range(n):
        order[fill[bucket[i]]] = i
        fill[bucket[i]] += 1
    return starts, order


@njit(cache=True)
def _nearest(
    x: float, y: float, nx: float, ny: float, points: Array, normals: Array, starts: Index, order: Index, reach: float
) -> int:
    """Return the nearest element that faces the same half-plane; -1 if there is none within ``reach``."""
    mask = starts.size - 2
    cx = np.int64(math.floor(x / CELL))
    cy = np.int64(math.floor(y / CELL))
    best, found = reach * reach, -1
    for ax in (0, -1, 1):  # the point's own cell first, which holds most nearest points
        wx = 0.0 if ax == 0 else abs(x - (cx + max(ax, 0)) * CELL)
        for ay in (0, -1, 1):
            wy = 0.0 if ay == 0 else abs(y - (cy + max(ay, 0)) * CELL)
            if wx * wx + wy * wy >= best:
                continue
            b = _bucket(cx + ax, cy + ay, mask)
            for k in range(starts[b], starts[b + 1]):
                j = order[k]
                dx, dy = points[j, 0] - x, points[j, 1] - y
                d = dx * dx + dy * dy
                if d < best and normals[j, 0] * nx + normals[j, 1] * ny > 0.3:
                    best, found = d, j
    return found


@njit(cache=True)
def accumulate(
    pose: Array, points: Array, normals: Array, variances: Array, map_points: Array, map_normals: Array,
    map_variances: Array, map_extents: Array, starts: Index, order: Index, reach: float, edge: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return H (3, 3), gradient g (3,) and (pairs, sum of squares across, cost) of the normal equations."""
    h = np.zeros((3, 3))
    g = np.zeros(3)
    stats = np.zeros(3)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(points.shape[0]):
        rx = c * points[i, 0] - s * points[i, 1]
        ry = s * points[i, 0] + c * points[i, 1]
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        x, y = rx + pose[0], ry + pose[1]
        j = _nearest(x, y, nx, ny, map_points, map_normals, starts, order, reach)
        kernel = 3.0  # Mahalanobis distance at which a pair has a quarter of its full influence
        if j < 0:
            stats[2] += kernel * kernel
            continue
        mx, my = map_normals[j, 0], map_normals[j, 1]
        across, along = variances[i, 0], variances[i, 1]
        across_m, along_m = map_variances[j, 0], map_variances[j, 1]
        cxx = across * nx * nx + along * ny * ny + across_m * mx * mx + along_m * my * my
        cyy = across * ny * ny + along * nx * nx + across_m * my * my + along_m * mx * mx
        cxy = (across - along) * nx * ny + (across_m - along_m) * mx * my
        det = cxx * cyy - cxy * cxy
        ixx, iyy, ixy = cyy / det, cxx / det, -cxy / det
        ex, ey = x - map_points[j, 0], y - map_points[j, 1]
        vx, vy = ixx * ex + ixy * ey, ixy * ex + iyy * ey
        m = ex * vx + ey * vy
        w = kernel * kernel / (kernel * kernel + m)
        stats[2] += w * m
        half = map_extents[j] if map_extents[j] > 0 else math.sqrt(3 * along_m)
        w = 0.0 if abs(ey * mx - ex * my) > edge + half else w * w
        jx, jy = -ry, rx
        qx, qy = ixx * jx + ixy * jy, ixy * jx + iyy * jy
        h[0, 0] += w * ixx
        h[0, 1] += w * ixy
        h[1, 1] += w * iyy
        h[0, 2] += w * qx
        h[1, 2] += w * qy
        h[2, 2] += w * (jx * qx + jy * qy)
        g[0] += w * vx
        g[1] += w * vy
        g[2] += w * (jx * vx + jy * vy)
        if m < kernel * kernel:
            stats[0] += 1.0
            stats[1] += (ex * mx + ey * my) ** 2
    h[1, 0], h[2, 0], h[2, 1] = h[0, 1], h[0, 2], h[1, 2]
    stats[2] *= CORRELATION
    return h * CORRELATION, g * CORRELATION, stats


@njit(cache=True)
def _fitting(
    pose: Array, points: Array, normals: Array, variances: Array, map_points: Array, map_normals: Array,
    map_variances: Array, map_extents: Array, starts: Index, order: Index, reach: float, found: NDArray[np.bool_],
) -> None:  # fmt: skip
    for i in range(points.shape[0]):
        one = slice(i, i + 1)
        stats = accumulate(
            pose, points[one], normals[one], variances[one], map_points, map_normals, map_variances, map_extents,
            starts, order, reach, EDGE,
        )[2]  # fmt: skip
        found[i] = stats[0] > 0.0


@njit(cache=True)
def solve3(h: Array, g: Array) -> Array:
    """Solve the symmetric positive system h x = g by Cholesky; zeros if it is singular."""
    x = np.zeros(3)
    a = h[0, 0]
    if a <= 1e-12:
        return x
    l00 = math.sqrt(a)
    l10, l20 = h[1, 0] / l00, h[2, 0] / l00
    a = h[1, 1] - l10 * l10
    if a <= 1e-12:
        return x
    l11 = math.sqrt(a)
    l21 = (h[2, 1] - l20 * l10) / l11
    a = h[2, 2] - l20 * l20 - l21 * l21
    if a <= 1e-12:
        return x
    l22 = math.sqrt(a)
    y0 = g[0] / l00
    y1 = (g[1] - l10 * y0) / l11
    y2 = (g[2] - l20 * y0 - l21 * y1) / l22
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return x


@njit(cache=True)
def _register(
    points: Array, normals: Array, variances: Array, map_points: Array, map_normals: Array, map_variances: Array,
    map_extents: Array, starts: Index, order: Index, start: Array, guess: Array, prior: Array, iterations: int,
    reach: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    pose = start.copy()
    edge = reach if iterations > 0 else EDGE
    done = False
    # Squared Mahalanobis distance at which a prior has half its weight: wheels slip further than their covariance.
    tails = 4.0
    for remaining in range(iterations, -1, -1):
        h, g, stats = accumulate(
            pose, points, normals, variances, map_points, map_normals, map_variances, map_extents, starts, order, reach,
            edge,
        )  # fmt: skip
        if done or remaining == 0:
            break
        off = pose - guess
        off[2] = (off[2] + math.pi) % (2 * math.pi) - math.pi
        m = off @ prior @ off
        w = tails / (tails + m)
        total = h + w * prior
        for k in range(3):
            total[k, k] += 1e-6 + 1e-9 * total[k, k]
        step = solve3(total, -(g + w * (prior @ off)))
        pose = pose + step
        way, turn = math.hypot(step[0], step[1]), abs(step[2])
        done = edge == EDGE and way < 1e-4 and turn < 2e-5
        # Pairs beyond the edge are used until a step is shorter than this, m and rad: they lead to the place from afar.
        coarse = (1e-3, 5e-4)
        if way < coarse[0] and turn < coarse[1]:
            edge = EDGE
    off = pose - guess
    off[2] = (off[2] + math.pi) % (2 * math.pi) - math.pi
    stats[2] += tails * math.log(1.0 + (off @ prior @ off) / tails)
    pose[2] = (pose[2] + math.pi) % (2 * math.pi) - math.pi
    return pose, h, stats
