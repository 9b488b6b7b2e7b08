"""Key scans and the relations between them: arrays that grow, and forget when told to."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.graph import Edges
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import compose, wrap

Array = NDArray[np.float64]

START: Final = 64
"""Rows at the beginning."""


class Rows:
    """Rows of one shape, appended in constant time."""

    def __init__(self, *shape: int, dtype: type = float) -> None:
        self._data: NDArray[Any] = np.zeros((START, *shape), dtype)
        self._count = 0

    def append(self, row: object) -> None:
        """Add one row."""
        if self._count == len(self._data):
            self._data = np.concatenate((self._data, np.zeros_like(self._data)))
        self._data[self._count] = row
        self._count += 1

    def set(self, rows: NDArray[Any]) -> None:
        """Have these rows and no others."""
        data = np.zeros((max(START, len(rows)), *self._data.shape[1:]), self._data.dtype)
        data[: len(rows)] = rows
        self._data, self._count = data, len(rows)

    @property
    def view(self) -> NDArray[Any]:
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

    def cut(self, count: int) -> None:
        """Forget all relations after the first ``count``."""
        for rows in (self._ends, self._measured, self._information, self._spread, self._loop, self._odometry):
            rows.set(rows.view[:count])

    def replace(self, edges: Edges, spread: Array, odometry: NDArray[np.bool_]) -> None:
        """Have these relations and no others."""
        self._ends.set(np.stack((edges.origin, edges.target), axis=1))
        self._measured.set(edges.measured)
        self._information.set(edges.information)
        self._spread.set(spread)
        self._loop.set(edges.loop)
        self._odometry.set(odometry)

    def edges(self) -> Edges:
        """Views of all relations."""
        ends = self._ends.view
        return Edges(ends[:, 0], ends[:, 1], self._measured.view, self._information.view, self._loop.view)

    @property
    def spread(self) -> Array:
        """Shape (n, 2)."""
        return self._spread.view

    @property
    def odometry(self) -> NDArray[np.bool_]:
        """Shape (n,): whether odometry gave the relation."""
        return self._odometry.view

    def __len__(self) -> int:
        return len(self._ends)


class Trail:
    """Every scan's place relative to a key scan, so that the whole trajectory moves with the graph.

    A scan that becomes a key scan is there twice: where the key scan before it saw it, and as itself. What the graph
    has moved the one against the other is spread over the scans between, or every key scan would be a jolt.

    Args:
        most: scans remembered; beyond that every second one is forgotten.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._stamps = Rows(dtype=np.int64)
        self._keys = Rows(dtype=np.int64)
        self._relative = Rows(3)

    def append(self, stamp: int, key: int, relative: Array) -> None:
        """One more scan."""
        self._stamps.append(stamp)
        self._keys.append(key)
        self._relative.append(relative)
        if len(self._stamps) > self._most:
            for rows in (self._stamps, self._keys, self._relative):
                rows.set(rows.view[::2])

    def move(self, stand_in: NDArray[np.int64], offset: Array) -> None:
        """Key k is now known as ``stand_in[k]``, in whose frame it was at ``offset[k]``."""
        keys = self._keys.view
        self._relative.set(compose(offset[keys], self._relative.view))
        self._keys.set(stand_in[keys])

    def poses(self, keys: Array) -> tuple[NDArray[np.int64], Array]:
        """Stamps (n,) and poses (n, 3), given those of the key scans."""
        stamps = self._stamps.view.copy()
        poses = compose(keys[self._keys.view], self._relative.view)
        joints = np.flatnonzero(stamps[1:] == stamps[:-1])
        apart = poses[joints + 1] - poses[joints]
        apart[:, 2] = wrap(apart[:, 2])
        begins = np.append(0, joints + 1)[: len(joints)]
        for begin, end, off in zip(begins, joints, apart, strict=True):
            share = (stamps[begin:end] - stamps[begin]) / max(stamps[end] - stamps[begin], 1)
            poses[begin:end] += share[:, None] * off
        return np.delete(stamps, joints), np.delete(poses, joints, axis=0)
