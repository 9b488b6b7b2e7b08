"""Grid of the ground's tilt and roughness, from the robot's motion over it and from tilted scans that hit it."""

import io
import os
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import opened, write_save
from monstertruck_runtime.outside import arrays, reading
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import GROUND_UNKNOWN, ROUGHNESS_STEP, TILT_STEP, Ground

FILE: Final = "ground.npz"
"""File name in the folder of a saved map."""
GROUND_RESOLUTION: Final = 0.1
"""Edge of a cell (m)."""
LARGEST_GROUND_GRID: Final = 2000
"""Maximum number of cells per side; cells beyond are ignored."""

Cells = NDArray[np.int64]


class GroundGrid:
    """Grid that grows with the observations; its axes are the frame's axes."""

    def __init__(self) -> None:
        self._corner: Cells = np.zeros(2, np.int64)
        """Column and row of the lower left cell, counted from the frame's origin."""
        self._counts: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._layers: NDArray[np.float32] = np.zeros((2, 0, 0), np.float32)
        """Tilt (rad) and roughness (m); shape (2, rows, columns)."""
        self._quantised: NDArray[np.uint8] = np.zeros((2, 0, 0), np.uint8)
        """Layers in the units of the message; only observed cells are converted: a whole large map takes milliseconds.
        """

    @property
    def empty(self) -> bool:
        """Whether the grid has no observations."""
        return not self._counts.any()

    def observe(self, points: Array, tilt: ArrayLike, roughness: ArrayLike) -> None:
        """Add an observation to the cells of ``points``, (n, 2) (m).

        Args:
            points: at least one point in each observed cell; only the first in a cell is used.
            tilt: tilt of the ground (rad); one value or n.
            roughness: standard deviation of its height (m); one value or n.
        """
        cells = np.floor(points / GROUND_RESOLUTION).astype(np.int64)
        _, first = np.unique(_key(*cells.T), return_index=True)
        cells = cells[first]
        if not len(cells) or not self._grow(cells.min(axis=0), cells.max(axis=0)):
            return
        columns, rows = (cells - self._corner).T
        # 20: maximum weight of a cell's mean, in values
        count = self._counts[rows, columns] = np.minimum(self._counts[rows, columns] + 1, 20)
        values = np.stack([np.broadcast_to(value, len(points))[first] for value in (tilt, roughness)])
        self._layers[:, rows, columns] += (values - self._layers[:, rows, columns]) / count
        self._quantised[:, rows, columns] = quantised(self._layers[:, rows, columns])

    def message(self, stamp: int, seq: int, frame: str) -> Ground:
        """Return the layers as a message; not defined for an empty grid."""
        rows, columns = self._counts.shape
        x, y = (self._corner * GROUND_RESOLUTION).tolist()
        return Ground(
            stamp=stamp,
            received=stamp,
            seq=seq,
            frame=frame,
            resolution=GROUND_RESOLUTION,
            width=columns,
            height=rows,
            origin=Pose2D(x=x, y=y, yaw=0.0),
            tilt=self._quantised[0].reshape(-1),
            roughness=self._quantised[1].reshape(-1),
        )

    def save(self, folder: Path, run: str) -> None:
        """Add the grid to the saved map of a run.

        Raises:
            OSError: it could not be written.
        """
        content = io.BytesIO()
        tilt, roughness = self._layers
        np.savez_compressed(content, corner=self._corner, counts=self._counts, tilt=tilt, roughness=roughness)
        write_save(folder, {FILE: content.getvalue()}, run=run)

    @classmethod
    def load(cls, folder: Path) -> "GroundGrid":
        """Read the file written by ``save``; return an empty grid if the map has none.

        Raises:
            InputError: the file is damaged.
        """
        grid = cls()
        with opened(folder) as save:
            path = save.file(FILE)
            if not os.path.lexists(path):
                return grid
            found = arrays(path, "a grid of the ground")
        with reading(path, "a grid of the ground"):
            corner, counts, tilt, roughness = (found[name] for name in ("corner", "counts", "tilt", "roughness"))
            shapes = {counts.shape, tilt.shape, roughness.shape}
            if corner.shape != (2,) or counts.ndim != 2 or len(shapes) != 1 or max(counts.shape) > LARGEST_GROUND_GRID:
                raise InputError(
                    f"{path}: layers of shapes {sorted(shapes)}: expected one of at most {LARGEST_GROUND_GRID} a side"
                )
            if not (np.isfinite(tilt).all() and np.isfinite(roughness).all()):
                raise InputError(f"{path}: expected finite tilt and roughness")
            grid._corner, grid._counts = corner.astype(np.int64), counts.astype(np.uint8)
            grid._layers = np.stack((tilt, roughness)).astype(np.float32)
            grid._quantised = np.where(grid._counts > 0, quantised(grid._layers), np.uint8(GROUND_UNKNOWN))
        return grid

    def _grow(self, low: Cells, high: Cells) -> bool:
        """Extend the grid to the cells from ``low`` to ``high``; return False if it would become too large."""
        size = np.array(self._counts.shape[::-1])
        if not size.all():
            self._corner, size = low.copy(), np.zeros(2, np.int64)
        margin = 20  # number of cells added when the grid grows
        before = np.where(low < self._corner, self._corner - low + margin, 0)
        behind = np.where(high >= self._corner + size, high + 1 - self._corner - size + margin, 0)
        if not (before.any() or behind.any()):
            return True
        if (size + before + behind).max() > LARGEST_GROUND_GRID:
            return False
        widths = ((before[1], behind[1]), (before[0], behind[0]))
        self._counts = np.pad(self._counts, widths)
        self._layers = np.pad(self._layers, ((0, 0), *widths))
        self._quantised = np.pad(self._quantised, ((0, 0), *widths), constant_values=GROUND_UNKNOWN)
        self._corner = self._corner - before
        return True


def quantised(layers: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return tilt (rad) and roughness (m), shape (2, ...), in the units of the message."""
    steps = np.array((TILT_STEP, ROUGHNESS_STEP), np.float32)
    steps = steps.reshape(2, *(1 for _ in layers.shape[1:]))
    values: NDArray[np.uint8] = np.minimum(np.rint(layers / steps), GROUND_UNKNOWN - 1).astype(np.uint8)
    return values


def planes(points: Array) -> tuple[Array, Array, Array]:
    """Fit planes to points on the ground, square by square.

    Args:
        points: shape (n, 3) (m).

    Returns:
        The points in squares with enough points, (k, 2); the tilt of their square's plane, (k,) (rad); and the standard
        deviation of the heights about it, (k,) (m).
    """
    x, y = np.floor(points[:, :2] / 0.3).astype(np.int64).T  # side of the squares with one fitted plane each, m
    _, which, counts = np.unique(_key(x, y), return_inverse=True, return_counts=True)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(which, values, len(counts)) / counts)

    dx, dy, dz = (values - mean(values)[which] for values in points.T)
    xx, xy, yy, xz, yz, zz = (mean(a * b) for a, b in ((dx, dx), (dx, dy), (dy, dy), (dx, dz), (dy, dz), (dz, dz)))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    # 8: minimum number of points for a plane
    # 0.05: their minimum standard deviation in every direction, m
    good = (counts >= 8) & (least >= 0.05**2)
    determinant = np.where(good, xx * yy - xy**2, 1.0)
    along, across = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
    rough = np.sqrt(np.maximum(zz - along * xz - across * yz, 0.0))
    tilt, chosen = np.arctan(np.hypot(along, across)), good[which]
    return points[chosen, :2], tilt[which][chosen], rough[which][chosen]


def _key(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for the index pair of a cell or square."""
    return np.asarray(x * (1 << 24) + y)
