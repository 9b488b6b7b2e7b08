"""Worlds to explore: obstacles, reachable area, starts of runs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, label

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.collision import DistanceField, Footprint
from monstertruck_runtime.map_files import FREE, load_map
from monstertruck_sim.world.raycast import Clearance, cast_rays, clearance

BODY, BARE = Footprint(), Footprint(padding=0.0)
ROOM = 0.3
"""Metres between the footprint and obstacles where a run starts."""
BEAMS, FIRST, STEP = 682, -340.5 * 2 * np.pi / 1024, 2 * np.pi / 1024
"""Beams of the URG-04LX, which sees 240 degrees."""
MOUNT = (0.14, 0.0, 0.0)


@dataclass(frozen=True)
class Arena:
    """A true world; every cell that is not free is an obstacle."""

    name: str
    resolution: float
    origin: tuple[float, float]
    blocked: NDArray[np.bool_]
    clear: Clearance
    truth: DistanceField

    @classmethod
    def load(cls, name: str, file: Path) -> "Arena":
        """Load a map_server file."""
        world = load_map(file)
        return cls.of(name, world.cells != FREE, world.resolution, world.origin[:2])

    @classmethod
    def of(cls, name: str, cells: NDArray[np.bool_], resolution: float, corner: tuple[float, float]) -> "Arena":
        """Create from occupied cells, shape (rows, columns); ``corner`` is the corner of the first one, m."""
        blocked = np.pad(cells, 1, constant_values=True)  # nothing is seen beyond the edge
        origin = corner[0] - resolution, corner[1] - resolution
        field = DistanceField(blocked, resolution, (*origin, 0.0))
        return cls(name, resolution, origin, blocked, clearance(blocked), field)

    def start(self, seed: int) -> Pose2:
        """Return a random pose with free space around it, in the largest drivable part."""
        regions, _ = label(self._open())
        sizes = np.bincount(regions.ravel())
        sizes[0] = 0
        rows, columns = np.nonzero(regions == int(np.argmax(sizes)))
        rng = np.random.default_rng([7, seed])
        while True:
            k = int(rng.integers(len(rows)))
            x, y = ((v[k] + 0.5) * self.resolution + o for v, o in ((columns, self.origin[0]), (rows, self.origin[1])))
            pose = np.array([[x, y, rng.uniform(-np.pi, np.pi)]])
            if self.truth.free(BODY, pose, ROOM)[0]:
                return float(x), float(y), float(pose[0, 2])

    def reachable(self, start: Pose2) -> tuple[Array, Array]:
        """Return the centres of the cells that the footprint can cover (m), by flood fill of the inscribed circle."""
        regions, _ = label(self._open())
        row, column = (
            int((v - o) / self.resolution) for v, o in ((start[1], self.origin[1]), (start[0], self.origin[0]))
        )
        inside = regions == regions[row, column]
        covered = distance_transform_edt(~inside) * self.resolution <= BARE.half_width
        rows, columns = np.nonzero(covered & ~self.blocked)
        return (columns + 0.5) * self.resolution + self.origin[0], (rows + 0.5) * self.resolution + self.origin[1]

    def _open(self) -> NDArray[np.bool_]:
        away: NDArray[np.bool_] = distance_transform_edt(~self.blocked) * self.resolution > BODY.half_width + 0.02
        return away

    def scan(self, pose: Pose2, reach: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
        """Return sensor (2,), returns (n, 2), and ends of beams without return (k, 2), in map, with noise."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        sensor = np.array((pose[0] + c * MOUNT[0], pose[1] + s * MOUNT[0]))
        angles: Array = pose[2] + FIRST + STEP * np.arange(BEAMS)
        xs, ys = (np.full(BEAMS, v) for v in sensor)
        none = np.empty((0, 3)), np.empty((0, 4))
        ranges = cast_rays(self.clear, self.resolution, *self.origin, xs, ys, angles, reach, *none)
        hit = np.isfinite(ranges)
        noise = np.maximum(0.01, 0.01 * ranges[hit]) / 2 * rng.standard_normal(int(hit.sum()))
        ranges[hit] = np.maximum(ranges[hit] + noise, 0.02)
        ranges[~hit] = reach
        ends = sensor + ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
        return sensor, ends[hit], ends[~hit]
