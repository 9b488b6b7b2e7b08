"""Surface elements of a plain occupancy grid: every side of a wall that free cells touch, with its own normal.

Free cells see walls from their own side only, so both faces of a wall one cell thick are found, each facing its room.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from monstertruck_estimation.slam.scans import SLIDE, Scan
from monstertruck_estimation.slam.storage import elements
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap

Array = NDArray[np.float64]

REACH: Final = 0.2
"""Faces up to this far away make the normal, m; at least ``CELLS``."""
CELLS: Final = 4.0
"""The same in cells: the stairs of an oblique wall must come out even."""
SAME_SIDE: Final = 0.5
"""Cosine between first guesses of normals that may belong to one side of one wall."""
STRAIGHT: Final = 0.1
"""Faces lie on a line if they spread across it by less than this part of the variance along it."""
NOISE: Final = 0.02
"""Least standard deviation of a drawn wall, m."""


def surfaces_of(grid: WorldMap) -> Scan:
    """Elements in map of all walls beside free cells; none if there are none."""
    step = grid.resolution
    cells, towards = _faces(grid.cells)
    if not len(cells):
        return elements(np.zeros((0, 2)), normals=np.zeros((0, 2)), variances=np.zeros((0, 2)))
    normals, straight, aside = _fitted(cells, towards, max(REACH / step, CELLS))
    # A free cell beside a wall is one cell from the middle of the wall's cells.
    points = (cells + aside - normals + 0.5) * step + np.array(grid.origin)
    across = NOISE**2 + step**2 / 12
    variances = np.stack((np.full(len(points), across), np.where(straight, SLIDE**2, across)), axis=-1)
    return elements(points, normals=normals, variances=variances, extents=np.where(straight, step / 2, 0.0))


def _faces(cells: NDArray[np.int8]) -> tuple[Array, Array]:
    """Free cells that share an edge with an occupied one (column, row), shape (n, 2); unit vectors away from those."""
    wall = np.pad(cells == OCCUPIED, 1).astype(np.float64)
    rows, columns = cells.shape

    def beside(dx: int, dy: int) -> Array:
        return wall[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]

    touching = beside(1, 0) + beside(-1, 0) + beside(0, 1) + beside(0, -1) > 0
    # Sobel's kernel: the stairs of an oblique wall give its direction roughly.
    x = 2 * (beside(-1, 0) - beside(1, 0)) + sum(beside(-1, k) - beside(1, k) for k in (-1, 1))
    y = 2 * (beside(0, -1) - beside(0, 1)) + sum(beside(k, -1) - beside(k, 1) for k in (-1, 1))
    length = np.hypot(x, y)
    # In a gap one cell wide both sides cancel: nobody looks into it.
    at = np.nonzero((cells == FREE) & touching & (length > 0))
    free: Array = np.stack(at[::-1], axis=-1).astype(np.float64)
    return free, np.stack((x[at], y[at]), axis=-1) / length[at][:, None]


def _fitted(cells: Array, towards: Array, reach: float) -> tuple[Array, NDArray[np.bool_], Array]:
    """Normals, shape (n, 2), of lines through the faces near each; whether those are lines; steps (n, 2) onto them."""
    count = len(cells)
    first, second = cKDTree(cells).query_pairs(reach, output_type="ndarray").T
    here = np.concatenate((first, second, np.arange(count)))
    there = np.concatenate((second, first, np.arange(count)))
    same = (towards[here] * towards[there]).sum(axis=1) > SAME_SIDE
    here, there = here[same], there[same]

    def total(values: Array) -> Array:
        summed: Array = np.bincount(here, values, count).astype(np.float64)
        return summed

    off, near = cells[there] - cells[here], total(np.ones(len(here)))
    mx, my = total(off[:, 0]) / near, total(off[:, 1]) / near
    cxx = total(off[:, 0] ** 2) / near - mx * mx
    cyy = total(off[:, 1] ** 2) / near - my * my
    cxy = total(off[:, 0] * off[:, 1]) / near - mx * my
    middle, half = (cxx + cyy) / 2, np.hypot((cxx - cyy) / 2, cxy)
    straight = (near >= 3) & (middle - half < STRAIGHT * (middle + half))
    angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    normals = np.stack((-np.sin(angle), np.cos(angle)), axis=-1)
    normals *= np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    normals = np.where(straight[:, None], normals, towards)
    across = normals[:, 0] * mx + normals[:, 1] * my
    return normals, straight, np.where(straight, across, 0.0)[:, None] * normals
