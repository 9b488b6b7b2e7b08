"""Cost of mapping: grid against a plain Bresenham in numba, front end, whole daemon on the virtual clock."""

import time
from pathlib import Path

import numpy as np
from numba import njit

from benchmarks import ROOT
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.grid import OccupancyGrid
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruckd.config.load import load_config
from monstertruckd.tools.logs.scans import read_scans
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

ROUNDS = 400
BEAMS, RANGE = 682, 5.6
DRIVEN = 20.0
GOALS = {"grid_over_bresenham": 1.2, "grid_us": 90.0, "step_median_ms": 8.0, "daemon_speed": 8.0}


@njit
def bresenham(grid, x0, y0, ends):  # type: ignore[no-untyped-def] # noqa: ANN001, ANN201
    """Baseline: decrement the cells of every beam, increment its end, with limits."""
    for i in range(ends.shape[0]):
        x, y, x1, y1 = x0, y0, ends[i, 0], ends[i, 1]
        dx, dy = abs(x1 - x), -abs(y1 - y)
        sx, sy = (1 if x < x1 else -1), (1 if y < y1 else -1)
        error = dx + dy
        while x != x1 or y != y1:
            grid[y, x] = max(grid[y, x] - 1, -100)
            twice = 2 * error
            if twice >= dy:
                error += dy
                x += sx
            if twice <= dx:
                error += dx
                y += sy
        grid[y1, x1] = min(grid[y1, x1] + 3, 100)


def grid_cost() -> dict[str, float]:
    """Return the processor time of one scan of 682 beams at 5.6 m, interleaved with the baseline's."""
    angles = np.deg2rad(np.linspace(-120, 120, BEAMS))
    points = np.stack((np.cos(angles), np.sin(angles)), axis=-1) * (RANGE - 0.02 + 0.02 * np.sin(9 * angles))[:, None]
    ours, plain, sensor = OccupancyGrid(), np.zeros((256, 256), np.int16), np.zeros(2)
    times: list[tuple[int, int]] = []
    for _ in range(ROUNDS):
        begin = time.thread_time_ns()
        ours.add(sensor, points)
        middle = time.thread_time_ns()
        bresenham(plain, 128, 128, (np.floor(points / 0.05) + 128).astype(np.int32))
        times.append((middle - begin, time.thread_time_ns() - middle))
    mine, theirs = np.median(np.array(times[20:]), axis=0) / 1e3
    return {"grid_us": mine, "bresenham_us": theirs, "grid_over_bresenham": mine / theirs}


def step_cost(recording: Path) -> dict[str, float]:
    """Return the processor time of preparation, matching, closing and drawing per recorded scan."""
    estimator, times = MappingEstimator(MapperConfig(), GridConfig()), []
    for scan in read_scans(recording).scans:
        begin = time.thread_time_ns()
        estimator.step(prepare_input(scan, 30.0, estimator.twist), scan)
        times.append(time.thread_time_ns() - begin)
    values = np.array(times[5:]) / 1e6
    return {"step_median_ms": float(np.median(values)), "step_p99_ms": float(np.percentile(values, 99))}


def daemon_cost() -> dict[str, float]:
    """Return the speed of the mapping demo relative to real time, and to the processor time of daemon and world."""
    config, _ = load_config(ROOT / "configs" / "slam.yaml", SimulatedTruckConfig)
    config = config.model_copy(update={"recorder": None, "map": None})

    async def main(clock: VirtualClock) -> tuple[float, float]:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(2.0)
            begin, cpu = time.perf_counter(), time.process_time()
            await clock.sleep(DRIVEN)
            return DRIVEN / (time.perf_counter() - begin), DRIVEN / (time.process_time() - cpu)

    speed, by_cpu = run_virtual(main, start=SECOND)
    return {"daemon_speed": speed, "daemon_speed_own_cpu": by_cpu}


def run(recording: Path) -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""
    figures = grid_cost() | step_cost(recording) | daemon_cost()
    met = figures["grid_over_bresenham"] <= 1.2 or figures["grid_us"] <= 90
    met &= figures["step_median_ms"] <= 8.0 and figures["daemon_speed"] >= 8.0
    return figures, GOALS, met
