"""Submaps: what several key scans saw, merged into one cloud of surface elements in one frame."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_estimation.slam.correlation import LikelihoodGrid
from monstertruck_estimation.slam.registration import Cloud
from monstertruck_estimation.slam.scans import Scan
from monstertruck_estimation.slam.se2 import rotation

Array = NDArray[np.float64]

MERGE: Final = 0.05
"""Elements within a square of this edge that face the same way become one, m."""


@dataclass
class Submap:
    """A cloud and, when asked for, its likelihood pyramids."""

    cloud: Cloud
    _grids: dict[int, LikelihoodGrid] = field(default_factory=dict)

    def grid(self, levels: int) -> LikelihoodGrid:
        """Likelihood pyramid of at least this many levels."""
        known = self._grids.get(levels)
        if known is None:
            known = self._grids[levels] = LikelihoodGrid.of(self.cloud, levels)
        return known


def merged(scans: Sequence[Scan], poses: Array) -> Scan:
    """Elements of all ``scans`` at ``poses`` (shape (n, 3)), averaged where they are the same piece of surface."""
    points, normals, variances, extents = [], [], [], []
    for scan, pose in zip(scans, poses, strict=True):
        turn = rotation(pose[2]).T
        points.append(scan.points @ turn + pose[:2])
        normals.append(scan.normals @ turn)
        variances.append(scan.variances)
        extents.append(scan.extents)
    every = np.concatenate(points), np.concatenate(normals), np.concatenate(variances), np.concatenate(extents)
    # Cell and octant of the normal tell the piece of surface.
    cells = np.floor(every[0] / MERGE).astype(np.int64)
    facing = np.floor(np.arctan2(every[1][:, 1], every[1][:, 0]) / (np.pi / 4) + 0.5).astype(np.int64) % 8
    lone = (every[2][:, 0] == every[2][:, 1]).astype(np.int64)
    cells -= cells.min(axis=0) if len(cells) else 0
    keys = (
        ((cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]) * 8 + facing) * 2 + lone if len(cells) else cells[:, 0]
    )
    order = np.argsort(keys, kind="stable")
    return Scan(*_average(*every, keys[order], order))


@njit(cache=True)
def _average(points, normals, variances, extents, keys, order):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN202
    """Means of runs of equal keys; points are weighted by how well they lie on their surface."""
    n = keys.size
    runs = 0
    for i in range(n):
        if i == 0 or keys[i] != keys[i - 1]:
            runs += 1
    p, m, v = np.zeros((runs, 2)), np.zeros((runs, 2)), np.zeros((runs, 2))
    e = np.zeros(runs)
    r, total = -1, 0.0
    for i in range(n + 1):
        if i == n or i == 0 or keys[i] != keys[i - 1]:
            if r >= 0:
                p[r] /= total
                v[r] /= total
                length = np.hypot(m[r, 0], m[r, 1])
                m[r] /= max(length, 1e-12)
            if i == n:
                break
            r += 1
            total = 0.0
        k = order[i]
        w = 1.0 / variances[k, 0]
        p[r] += w * points[k]
        m[r] += w * normals[k]
        v[r] += w * variances[k]
        e[r] = max(e[r], extents[k])
        total += w
    return p, m, v, e
