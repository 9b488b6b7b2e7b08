"""Logs drawn by seed: a robot drives to random places of a shipped map, so its poses are known exactly.

The map's cells are ray-cast from the true poses: ``BEAMS`` beams over 270 degrees to 8 m, with noise. The odometry has
drawn scale errors, drift and noise. Nothing else moves; each scan is taken at one instant.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numba import njit
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from monstertruck_estimation.slam.scans import ScanGeometry
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import FREE, OCCUPIED, WorldMap, load_map

Found = dict[str, float]
MAPS = {"hospital": "stdr_hospital_section", "depot": "nav2_depot", "robocup": "stdr_robocup"}
WAY, STEP, PERIOD = 240.0, 0.1, 0.2
"""Driven, m; between two scans at most, m, and s. Where it turns, scans are no more than ``TURN`` rad apart."""
TURN = 0.2
CLEARANCE, CELL = 0.4, 0.15
"""Clearance of the robot from walls, and cell size of the grid for its path search, m."""
BEAMS, HALF_VIEW, REACH, NOISE = 271, math.radians(135), 8.0, 0.01
SCALES, DRIFT, JITTER = (0.02, 0.03), 0.01, (0.03, 0.004)
"""Standard deviations: of the scales of ways and turns, of the drift, rad/m, and of each step, its share and rad."""


def drawn(folder: Path, name: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, ScanGeometry]:
    """Return stamps (n,), ns, ranges (n, beams), odometry (n, 3), poses (n, 3), and geometry in a map."""
    rng = np.random.default_rng((seed, len(name)))
    world = load_map(folder / f"{MAPS[name]}.yaml")
    poses = _along(_way(world, rng))
    step = 2 * HALF_VIEW / (BEAMS - 1)
    angles = -HALF_VIEW + np.arange(BEAMS) * step
    ranges = _cast(world.cells == OCCUPIED, world.resolution, np.array(world.origin), poses, angles, REACH)
    ranges = np.where(ranges < REACH, ranges + rng.normal(0.0, NOISE, ranges.shape), REACH + 1.0)
    stamps = (np.arange(len(poses)) * PERIOD * SECOND).astype(np.int64)
    return stamps, ranges, _odometry(poses, rng), poses, ScanGeometry(-HALF_VIEW, step, 0.05, REACH)


def over_drives(
    folder: Path, part: str, seeds: int, measure: Callable[[tuple, str, int], Iterator[tuple[str, Found, Found]]]
) -> tuple[Found, Found, bool]:
    """Return figures and goals of ``part`` in every map, for this many seeds, and whether all goals are met.

    ``measure`` receives a log, and the name of its map and its seed; it yields a case, its figures and its goals.
    """
    figures: Found = {}
    goals: Found = {}
    for name in MAPS:
        for seed in range(1, seeds + 1):
            for case, found, least in measure(drawn(folder.parent / "maps", name, seed), name, seed):
                key = f"{part}.{name}-{seed}.{case}"
                print(key, found, flush=True)
                figures |= {f"{key}.{what}": round(value, 4) for what, value in found.items()}
                goals |= {f"{key}.{what}": value for what, value in least.items()}
    return figures, goals, all(figures[key] <= goal for key, goal in goals.items())


def _way(world: WorldMap, rng: np.random.Generator) -> np.ndarray:
    """Return points, shape (n, 2), of the least-cost paths between random places, ``WAY`` metres in total."""
    factor = max(round(CELL / world.resolution), 1)
    room = (distance_transform_edt(world.cells == FREE) * world.resolution)[::factor, ::factor]
    areas, _ = label(room > CLEARANCE, np.ones((3, 3)))
    sizes = np.bincount(areas.ravel())
    sizes[0] = 0
    inside = areas == sizes.argmax()
    cells = np.argwhere(inside)
    number = np.full((inside.shape[0] + 1, inside.shape[1] + 2), -1)
    number[:-1, 1:-1][inside] = np.arange(len(cells))
    here = number[cells[:, 0], cells[:, 1] + 1]
    ends, costs = [], []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        there = number[cells[:, 0] + down, cells[:, 1] + 1 + right]
        known = there >= 0
        ends.append(np.stack((here[known], there[known])))
        costs.append(math.hypot(down, right) * (1.0 + 0.5 / room[inside][known]))
    graph = csr_matrix((np.concatenate(costs), np.concatenate(ends, axis=1)), shape=(len(cells), len(cells)))
    legs, length, at = [], 0.0, int(rng.integers(len(cells)))
    while length < WAY:
        goal = int(rng.integers(len(cells)))
        _, before = dijkstra(graph, directed=False, indices=at, return_predecessors=True)
        leg = [goal]
        while leg[-1] != at:
            leg.append(int(before[leg[-1]]))
        points = cells[leg[::-1]][:, ::-1] * factor * world.resolution + 0.5 * world.resolution + world.origin
        legs.append(points[1:] if legs else points)
        length += float(np.hypot(*np.diff(points, axis=0).T).sum())
        at = goal
    return np.concatenate(legs)


def _along(way: np.ndarray) -> np.ndarray:
    """Return poses, shape (n, 3), along a smoothed path."""
    done = np.r_[0.0, np.cumsum(np.hypot(*np.diff(way, axis=0).T))]
    fine = np.arange(0.0, min(float(done[-1]), WAY), 0.02)
    line = np.column_stack([np.interp(fine, done, column) for column in way.T])
    line = gaussian_filter1d(line, 12, axis=0, mode="nearest")
    ahead = np.gradient(line, axis=0)
    yaw = gaussian_filter1d(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), 6, mode="nearest")
    scans = np.cumsum(np.maximum(0.02 / STEP, np.abs(np.gradient(yaw)) / TURN))
    kept = np.searchsorted(scans, np.arange(1.0, scans[-1]))
    return np.column_stack((line[kept], yaw[kept]))


def _odometry(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return poses, shape (n, 3), as measured by the wheels."""
    steps = between(poses[:-1], poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])
    scale, turn, drift = 1.0 + rng.normal(0, SCALES[0]), 1.0 + rng.normal(0, SCALES[1]), rng.normal(0, DRIFT)
    steps[:, :2] *= scale * (1.0 + rng.normal(0, JITTER[0], len(steps)))[:, None]
    steps[:, 2] = turn * steps[:, 2] + drift * way + rng.normal(0, JITTER[1], len(steps))
    odometry = [np.zeros(3)]
    for step in steps:
        odometry.append(compose(odometry[-1], step))
    return np.array(odometry)


@njit(cache=True)
def _cast(occupied, resolution, origin, poses, angles, reach):  # noqa: ANN001, ANN202
    """Return exact distances, shape (n, beams), to the first occupied cell; more than ``reach`` if there is none."""
    rows, columns = occupied.shape
    ranges = np.full((poses.shape[0], angles.shape[0]), reach + 1.0)
    for k in range(poses.shape[0]):
        x, y = (poses[k, 0] - origin[0]) / resolution, (poses[k, 1] - origin[1]) / resolution
        for beam in range(angles.shape[0]):
            dx, dy = math.cos(poses[k, 2] + angles[beam]), math.sin(poses[k, 2] + angles[beam])
            column, row = math.floor(x), math.floor(y)
            right, up = 1 if dx > 0 else -1, 1 if dy > 0 else -1
            by_column, by_row = 1.0 / max(abs(dx), 1e-12), 1.0 / max(abs(dy), 1e-12)
            to_column = abs(column + (dx > 0) - x) * by_column
            to_row = abs(row + (dy > 0) - y) * by_row
            far = 0.0
            while far * resolution < reach:
                if to_column < to_row:
                    far, to_column, column = to_column, to_column + by_column, column + right
                else:
                    far, to_row, row = to_row, to_row + by_row, row + up
                if not (0 <= row < rows and 0 <= column < columns):
                    break
                if occupied[row, column]:
                    ranges[k, beam] = far * resolution
                    break
    return ranges
