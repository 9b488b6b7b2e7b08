"""Key scans and the relations between them: arrays that grow, and forget when told to."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.graph import Edges
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scans import Scan

Array = NDArray[np.float64]

START: Final = 64
"""Rows at the beginning."""


class Rows:
    """Rows of one shape, appended in constant time."""

    def __init__(self, *shape: int, dtype: type = float) -> None:
        self._data = np.zeros((START, *shape), dtype)
        self._count = 0

    def append(self, row: object) -> None:
        """Add one row."""
        if self._count == len(self._data):
            self._data = np.concatenate((self._data, np.zeros_like(self._data)))
        self._data[self._count] = row
        self._count += 1

    def keep(self, kept: NDArray[np.bool_]) -> None:
        """Leave only the rows marked in ``kept``."""
        rows = self.view[kept]
        self._data[: len(rows)] = rows
        self._count = len(rows)

    @property
    def view(self) -> NDArray[np.generic]:
        """The rows, not copied."""
        return self._data[: self._count]

    def __len__(self) -> int:
        return self._count


@dataclass(frozen=True, slots=True)
class Key:
    """A scan that the map is made of."""

    stamp: int
    """ns."""
    scan: Scan
    """Thinned points in base."""
    cloud: Cloud
    """The same, hashed."""


class EdgeStore:
    """Growing ``Edges``."""

    def __init__(self) -> None:
        self._ends = Rows(2, dtype=np.int64)
        self._measured = Rows(3)
        self._information = Rows(3, 3)
        self._spread = Rows(2)
        self._loop = Rows(dtype=bool)
        self._odometry = Rows(dtype=bool)

    def add(
        self,
        origin: int,
        target: int,
        measured: Array,
        information: Array,
        spread: tuple[float, float],
        *,
        loop: bool = False,
        odometry: bool = False,
    ) -> None:
        """One relation; ``spread`` are the variances (m^2, rad^2) with which it takes part in drift bounds."""
        self._ends.append((origin, target))
        self._measured.append(measured)
        self._information.append(information)
        self._spread.append(spread)
        self._loop.append(loop)
        self._odometry.append(odometry)

    def drop(self, dropped: NDArray[np.bool_]) -> None:
        """Forget the marked relations."""
        for rows in (self._ends, self._measured, self._information, self._spread, self._loop, self._odometry):
            rows.keep(~dropped)

    def edges(self) -> Edges:
        """Views of all relations."""
        ends = self._ends.view
        return Edges(ends[:, 0], ends[:, 1], self._measured.view, self._information.view, self._loop.view)

    def odometry(self) -> Edges:
        """The relations that odometry gave."""
        kept, every = self._odometry.view, self.edges()
        return Edges(
            every.origin[kept], every.target[kept], every.measured[kept], every.information[kept], every.loop[kept]
        )

    @property
    def spread(self) -> Array:
        """Shape (n, 2)."""
        return self._spread.view

    def __len__(self) -> int:
        return len(self._ends)
