"""Frontiers of a growing map, kept per cell, so that a changed tile costs only its own surroundings.

A frontier cell is a free cell next to an unknown one (B. Yamauchi, "A frontier-based approach for autonomous
exploration", 1997). Only the surroundings of changed cells are searched again (compare M. Keidar, G. A. Kaminka,
"Efficient frontier detection for robot exploration", 2014).
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_planners.collision import OCCUPIED
from monstertruck_planners.distance_kernels import Box
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.state import Grid

Cells = NDArray[np.int8]

UNKNOWN_CELL: Final = -1
BLOCK: Final = 64
"""Block side (cells); the area grows by whole blocks."""


class FrontierMap:
    """Occupancy and frontiers of a growing area; cell indices start at the map origin.

    Args:
        grid: first message; all others must have its resolution.
    """

    def __init__(self, grid: Grid) -> None:
        self.resolution = grid.resolution
        self.corner = np.zeros(2, np.int64)
        """Column and row of the first cell."""
        self.cells: Cells = np.full((0, 0), UNKNOWN_CELL, np.int8)
        """Occupancy, shape (rows, columns): -1 unknown, 0 free to 100 occupied."""
        self.frontier: NDArray[np.bool_] = np.zeros((0, 0), np.bool_)
        self.free = 0
        """Number of free cells."""
        self.changes = 0
        """Number of insertions."""
        self.changed: NDArray[np.int64] = np.zeros((0, 0), np.int64)
        """Latest insertion that changed a cell of each block to unknown, free or occupied."""
        self.put(grid, whole=True)

    @property
    def origin(self) -> tuple[float, float, float]:
        """Pose of the outer corner of the first cell (m, m, rad)."""
        x, y = (self.corner * self.resolution).tolist()
        return x, y, 0.0

    def put(self, grid: Grid, *, whole: bool) -> int:
        """Insert a tile, or a whole map that replaces the last one; return the number of cells checked again.

        Raises:
            InputError: different resolution, or cells not aligned with the previous ones.
        """
        if grid.resolution != self.resolution or grid.origin.yaw != 0.0:
            text = f"map with cells of {grid.resolution} m, rotated by {grid.origin.yaw} rad"
            raise InputError(f"{text}: expected cells of {self.resolution} m without rotation")
        at = np.array((grid.origin.x, grid.origin.y)) / self.resolution
        low = np.round(at).astype(np.int64)
        if np.abs(at - low).max() > 0.01:
            raise InputError(f"map at {grid.origin.x}, {grid.origin.y}: expected whole cells of {self.resolution} m")
        new = grid.cells.reshape(grid.height, grid.width)
        self.changes += 1
        self._cover(low, low + np.array((grid.width, grid.height)))
        if whole:
            there = np.full_like(self.cells, UNKNOWN_CELL)
            column, row = low - self.corner
            there[row : row + grid.height, column : column + grid.width] = new
            return self._replace(there, (0, 0))
        column, row = (low - self.corner).tolist()
        return self._replace(new, (row, column))

    def _replace(self, new: Cells, corner: tuple[int, int]) -> int:
        """Write the differing blocks of a box."""
        looked = 0
        for top in range(0, new.shape[0], BLOCK):
            for left in range(0, new.shape[1], BLOCK):
                part = new[top : top + BLOCK, left : left + BLOCK]
                row, column = corner[0] + top, corner[1] + left
                place = np.s_[row : row + part.shape[0], column : column + part.shape[1]]
                if np.array_equal(self.cells[place], part):
                    continue
                self.free += _free(part) - _free(self.cells[place])
                same = np.array_equal(_standing(self.cells[place]), _standing(part))
                self.cells[place] = part
                if not same:
                    bottom, right = row + part.shape[0], column + part.shape[1]
                    blocks = np.s_[row // BLOCK : -(-bottom // BLOCK), column // BLOCK : -(-right // BLOCK)]
                    self.changed[blocks] = self.changes
                    looked += self._look((row, column, bottom, right))
        return looked

    def _look(self, box: Box) -> int:
        """Find the frontier cells of a box and the ring around it."""
        rows, columns = self.cells.shape
        top, left = max(box[0] - 1, 0), max(box[1] - 1, 0)
        bottom, right = min(box[2] + 1, rows), min(box[3] + 1, columns)
        around = self.cells[max(top - 1, 0) : bottom + 1, max(left - 1, 0) : right + 1]
        pads = [(int(top == 0), int(bottom == rows)), (int(left == 0), int(right == columns))]
        unknown = np.pad(around == UNKNOWN_CELL, pads)
        beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
        inner = self.cells[top:bottom, left:right]
        self.frontier[top:bottom, left:right] = beside & (inner >= 0) & (inner < OCCUPIED)
        return int(inner.size)

    def _cover(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Grow until the cells from ``low`` to ``high``, exclusive, are inside with an unknown ring around them."""
        size = np.array(self.cells.shape[::-1])
        low, high = low - 1, high + 1
        end = self.corner + size
        spare = 2  # extra blocks when the area grows
        if size.all():
            if (low >= self.corner).all() and (high <= end).all():
                return
            wider = np.where(low < self.corner, spare, 0), np.where(high > end, spare, 0)
            low, high = np.minimum(low, self.corner), np.maximum(high, end)
        else:
            wider = np.zeros(2, np.int64), np.zeros(2, np.int64)
        corner = (low // BLOCK - wider[0]) * BLOCK
        shape = ((-(-high // BLOCK) + wider[1]) * BLOCK - corner)[::-1]
        cells, frontier = np.full(shape, UNKNOWN_CELL, np.int8), np.zeros(shape, np.bool_)
        changed = np.zeros(np.array(shape) // BLOCK, np.int64)
        if size.all():
            column, row = self.corner - corner
            inside = np.s_[row : row + size[1], column : column + size[0]]
            cells[inside], frontier[inside] = self.cells, self.frontier
            row, column = row // BLOCK, column // BLOCK
            changed[row : row + self.changed.shape[0], column : column + self.changed.shape[1]] = self.changed
        self.corner, self.cells, self.frontier, self.changed = corner, cells, frontier, changed

    def changed_within(self, middle: tuple[float, float], reach: float) -> int:
        """Return the latest change of any block in a square around a place, ``reach`` (m) to each side."""
        cells = BLOCK * self.resolution
        low, high = (np.floor((np.array(middle) + d - self.origin[:2]) / cells).astype(int) for d in (-reach, reach))
        part = self.changed[max(low[1], 0) : max(high[1] + 1, 0), max(low[0], 0) : max(high[0] + 1, 0)]
        return int(part.max(initial=0))


def _standing(cells: Cells) -> Cells:
    """Return the state of each cell: -1 unknown, 0 free, 1 occupied."""
    return (cells >= OCCUPIED).astype(np.int8) - (cells < 0)


def _free(cells: Cells) -> int:
    return int(np.count_nonzero((cells >= 0) & (cells < OCCUPIED)))
