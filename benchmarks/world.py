"""The simulated world: exactness and rate of its scans, and speed of the whole daemon on the virtual clock.

    python benchmarks/world.py [--peer LASER_MODELS.PY] [--laps N]

Scans of 682 beams from seeded free poses on a seeded map of 1000 x 1000 cells of 5 cm (50 x 50 m of walls with doors
and posts), to 5.6 m (the URG-04LX's range) and to 30 m. Every range is compared with an exact walk, cell by cell,
written here for that purpose. ``--peer`` names f1tenth_gym's ``gym/f110_gym/envs/laser_models.py``: its numba simulator
then scans from the same poses, without noise, in turn with ours; otherwise published figures are quoted.

The daemon is the fast demo's: daemon, emulated devices, world and recorder in one process. Two runs of one seed must
record the same. Its speed is simulated per real time; because the machine may be shared, that per processor time is
reported, too. The last line is JSON.
"""

import argparse
import importlib.util
import json
import sys
import tempfile
import time
from collections.abc import Callable
from math import cos, floor, inf, sin
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks import ROOT
from benchmarks.same_python import go_on_in_the_systems_python
from monstertruck_kinematics.elementary import Array
from monstertruck_sim.world.raycast import cast_rays, clearance
from monstertruckd.tools.demo.runs import run_fast_demo

CELLS, RESOLUTION = 1000, 0.05
BEAMS, FIELD = 682, np.radians(239.77)
REACHES = (5.6, 30.0)
QUOTED = {5.6: (9_000.0, 16_000.0), 30.0: (3_000.0, 6_000.0)}
"""Scans per second of f1tenth_gym on a computer of two cores, least and greatest."""
GOALS = {"wrong_share": 0.0, "over_peer": 1.0, "speed": 15.0}
NOTHING = np.zeros((0, 3)), np.zeros((0, 4))


def make_map(seed: int = 1) -> NDArray[np.bool_]:
    """Return rooms of 5 m with doors of 1 m, and posts: (rows, columns), row 0 lowest y."""
    rng = np.random.default_rng(seed)
    occupied = np.zeros((CELLS, CELLS), bool)
    for at in range(0, CELLS + 1, 100):
        line = min(at, CELLS - 1)
        occupied[line, :] = occupied[:, line] = True
        if 0 < at < CELLS:
            for room in range(0, CELLS, 100):
                row, column = rng.integers(room + 5, room + 75, 2)
                occupied[line, row : row + 20] = occupied[column : column + 20, line] = False
    for row, column in rng.integers(2, CELLS - 4, (400, 2)):
        occupied[row : row + 2, column : column + 2] = True
    return occupied


def free_poses(occupied: NDArray[np.bool_], count: int, seed: int = 2) -> Array:
    """Return poses (count, 3) at least 20 cm away from all obstacles."""
    rng = np.random.default_rng(seed)
    rows, columns = np.nonzero(clearance(occupied) > 4)
    chosen = rng.integers(len(rows), size=count)
    offsets = rng.random((count, 2))
    x, y = (columns[chosen] + offsets[:, 0]) * RESOLUTION, (rows[chosen] + offsets[:, 1]) * RESOLUTION
    return np.column_stack([x, y, rng.uniform(-np.pi, np.pi, count)])


@njit(cache=False)
def exact_walk(occupied: NDArray[np.bool_], x: float, y: float, angle: float, reach: float) -> float:
    """Return the distance to the first occupied cell on the ray; inf beyond ``reach`` or outside the grid."""
    rows, columns = occupied.shape
    dx, dy = cos(angle), sin(angle)
    column, row, along = floor(x / RESOLUTION), floor(y / RESOLUTION), 0.0
    while along <= reach:
        if not (0 <= row < rows and 0 <= column < columns):
            return inf
        if occupied[row, column]:
            return along
        to_x = ((column + (dx > 0)) * RESOLUTION - x) / dx if dx != 0.0 else inf
        to_y = ((row + (dy > 0)) * RESOLUTION - y) / dy if dy != 0.0 else inf
        if to_x < to_y:
            along = to_x
            column += 1 if dx > 0 else -1
        else:
            along = to_y
            row += 1 if dy > 0 else -1
    return inf


def wrong(got: Array, want: Array, reach: float) -> float:
    """Return the share of beams that are off by more than a cell; no return counts as ``reach``."""
    return float(np.mean(np.abs(np.minimum(got, reach) - np.minimum(want, reach)) > RESOLUTION))


def load_peer(path: Path) -> ModuleType:
    """Import f1tenth_gym's module alone."""
    spec = importlib.util.spec_from_file_location("laser_models", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["laser_models"] = module  # numba's cache of a first run looks for it there
    spec.loader.exec_module(module)
    return module


def peer_scanner(module: ModuleType, occupied: NDArray[np.bool_], reach: float) -> Callable[[Array], Array]:
    """Return its simulator on our map, set as its ``set_map`` does from a file."""
    simulator = module.ScanSimulator2D(BEAMS, FIELD, max_range=reach)
    simulator.map_height, simulator.map_width = occupied.shape
    simulator.map_resolution = RESOLUTION
    simulator.orig_x = simulator.orig_y = simulator.orig_s = 0.0
    simulator.orig_c = 1.0
    simulator.dt = module.get_dt(np.where(occupied, 0.0, 255.0), RESOLUTION)
    return lambda pose: simulator.scan(pose, None)


def our_scanner(occupied: NDArray[np.bool_], reach: float) -> Callable[[Array], Array]:
    """Return the world's scanner, for a standing truck."""
    clear, beams = clearance(occupied), np.linspace(-FIELD / 2, FIELD / 2, BEAMS)

    def scan(pose: Array) -> Array:
        xs, ys = np.full(BEAMS, pose[0]), np.full(BEAMS, pose[1])
        return cast_rays(clear, RESOLUTION, 0.0, 0.0, xs, ys, pose[2] + beams, reach, *NOTHING)

    return scan


def rates(scanners: dict[str, Callable[[Array], Array]], poses: Array, rounds: int = 15) -> dict[str, Array]:
    """Return scans per second of processor time, measured in turn: (rounds,) each."""
    found = {name: np.empty(rounds) for name in scanners}
    for scan in scanners.values():
        scan(poses[0])
    for i in range(rounds):
        for name, scan in scanners.items():
            begin = time.process_time()
            for pose in poses:
                scan(pose)
            found[name][i] = len(poses) / (time.process_time() - begin)
    return found


def lidar(peer: Path | None) -> dict[str, float]:
    """Return exactness and speed."""
    occupied = make_map()
    poses, beams = free_poses(occupied, 300), np.linspace(-FIELD / 2, FIELD / 2, BEAMS)
    module = load_peer(peer) if peer is not None else None
    figures: dict[str, float] = {}
    for reach in REACHES:
        scanners = {"our": our_scanner(occupied, reach)}
        if module is not None:
            scanners["peer"] = peer_scanner(module, occupied, reach)
        want = np.array([[exact_walk(occupied, x, y, yaw + b, reach) for b in beams] for x, y, yaw in poses])
        per_second = rates(scanners, poses)
        for name, scan in scanners.items():
            figures[f"{name}_wrong_share_{reach:g}m"] = wrong(np.array([scan(pose) for pose in poses]), want, reach)
            figures[f"{name}_scans_per_s_{reach:g}m"] = float(np.median(per_second[name]))
        ratio = per_second["our"] / (per_second["peer"] if module is not None else QUOTED[reach][1])
        figures[f"over_peer_{reach:g}m"] = float(np.median(ratio))
    figures["wrong_share"] = max(figures[f"our_wrong_share_{reach:g}m"] for reach in REACHES)
    figures["over_peer"] = min(figures[f"over_peer_{reach:g}m"] for reach in REACHES)
    return figures


def laps(config: Path, count: int) -> dict[str, Any]:
    """Run the fast demo ``count`` times with one seed."""
    speeds, per_cpu, digests = [], [], set()
    for _ in range(count):
        with tempfile.TemporaryDirectory() as folder:
            begin = time.process_time()
            summary = run_fast_demo(config, Path(folder), 1)
            used = time.process_time() - begin
        assert summary.speedup is not None
        speeds.append(summary.speedup)
        per_cpu.append(summary.lap.end / 1e9 / used)
        digests.add(summary.digest)
    return {
        "speed": float(np.median(speeds)),
        "speed_per_cpu": float(np.median(per_cpu)),
        "lap_s": summary.lap.seconds,
        "same_log": len(digests) == 1,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", type=Path, help="laser_models.py of f1tenth_gym")
    parser.add_argument("--laps", type=int, default=3)
    arguments = parser.parse_args()
    go_on_in_the_systems_python()
    figures: dict[str, Any] = lidar(arguments.peer)
    if arguments.peer is None:
        print(f"f1tenth_gym is not measured but quoted, scans/s by reach in m: {QUOTED}; ratios are to the greater")
    figures |= laps(ROOT / "configs" / "demo.yaml", arguments.laps)
    full = laps(ROOT / "configs" / "full.yaml", 1)
    figures |= {"full_truck_speed": full["speed"], "full_truck_speed_per_cpu": full["speed_per_cpu"]}
    for name, value in figures.items():
        print(f"{name:26} {value:12.4g}")
    met = (
        figures["wrong_share"] <= GOALS["wrong_share"]
        and figures["over_peer"] >= GOALS["over_peer"]
        and figures["speed"] >= GOALS["speed"]
        and figures["same_log"]
    )
    print(json.dumps({"bench": "world", "figures": figures, "goals": GOALS | {"same_log": True}, "met": met}))


if __name__ == "__main__":
    main()
