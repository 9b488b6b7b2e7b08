"""Times to the first route on a map of 100 x 100 m at 5 cm, against BIT* of ompl; on a new map; after a change; by CLI.

Queries are drawn by seed. Times are processor time: the whole call, without improvement.
"""

import os
import statistics
import subprocess
import sys
import time

import numpy as np
from ompl import base as ob
from ompl import util as ou

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.routes import Query, bit_star, read, validity
from benchmarks.navigation_parts.unseen_maps import free_pose
from monstertruck_planners.collision import DiscFootprint
from monstertruck_planners.route.api import RouteMap, Vehicle, warm_up
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner

MAP = "nav2_100by100_10"
FOOTPRINT = DiscFootprint((-0.0283, 0.115, 0.2583), 0.1235)
RADIUS = Vehicle.truck("4ws").radius
"""The least circle of the truck, m."""
LIMIT = 10.0
"""Time limit of BIT*, s."""
CLI_STARTS = 3
NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"}


def run(options: Options) -> Part:
    part = Part()
    if options.data is None:
        print("route_times: no --data, left out")
        return part
    ou.setLogLevel(ou.LOG_ERROR)
    ou.RNG.setSeed(1)
    occupied, resolution = read(options.data / "maps" / f"{MAP}.yaml")
    cells = np.where(occupied, 100, 0).astype(np.int8)
    planner = HybridPlanner(Vehicle(FOOTPRINT, RADIUS, 0.0, "front"), HybridConfig(improve=False))
    warm_up(planner)
    begin = time.thread_time()
    route_map = RouteMap.from_cells(cells, resolution)
    part.add("new_map_ms", (time.thread_time() - begin) * 1e3)
    rng = np.random.default_rng(19)
    count = 10 if options.quick else 40
    rows = [one_query(planner, route_map, occupied, resolution, rng, options.quick) for _ in range(count + 1)]
    part.add("first_plan_on_new_map_ms", rows[0]["ms"])
    rows = rows[1:]
    part.add("queries", len(rows))
    part.add("not_found", sum(not row["ok"] for row in rows), 0)
    part.add("median_ms", statistics.median(row["ms"] for row in rows), 15.0)
    part.add("slowest_ms", max(row["ms"] for row in rows))
    part.add("bit_median_ms", statistics.median(row["bit_ms"] for row in rows))
    part.add("slowest_over_limit", max(row["ms"] / max(2.0 * row["bit_ms"], 15.0) for row in rows), 1.0)
    direct = [row["ms"] for row in rows if row["direct"]]
    part.add("direct_motions", len(direct))
    part.add("direct_slowest_ms", max(direct, default=0.0), 1.0)
    add_change(part, planner, route_map, cells, resolution, rng)
    part.add("cli_start_s", cli_start(options, occupied, resolution, free_pose(route_map, planner.vehicle, rng)), 2.0)
    return part


def one_query(planner, route_map, occupied, resolution, rng, quick) -> dict:  # noqa: ANN001
    start, goal = (free_pose(route_map, planner.vehicle, rng) for _ in range(2))
    begin = time.thread_time()
    result = planner.plan(route_map, start, goal, time.thread_time)
    ms = (time.thread_time() - begin) * 1e3
    space = ob.ReedsSheppStateSpace(RADIUS)
    bounds = ob.RealVectorBounds(2)
    for axis, many in enumerate(occupied.shape[::-1]):
        bounds.setLow(axis, 0.0)
        bounds.setHigh(axis, many * resolution)
    space.setBounds(bounds)
    if "valid" not in CACHED:
        CACHED["valid"] = validity(occupied, resolution, FOOTPRINT)
    query, times = Query(MAP, tuple(start), tuple(goal), 0.0), []
    for _ in range(1 if quick else 3):
        setup = bit_star(space, CACHED["valid"], resolution, query, any_will_do=True)
        begin = time.thread_time()
        setup.solve(LIMIT)
        times.append((time.thread_time() - begin) * 1e3)
    row = {"ms": ms, "ok": result.ok, "direct": result.statistics["expanded"] == 0, "bit_ms": statistics.median(times)}
    length = result.path.length if result.path else float("nan")
    print(f"{length:.1f} m: {ms:.1f} ms, BIT* {row['bit_ms']:.1f} ms{', direct' if row['direct'] else ''}", flush=True)
    return row


CACHED: dict = {}
"""The peer's rule: made once, as it holds a distance field too."""


def add_change(part: Part, planner, route_map, cells, resolution, rng) -> None:  # noqa: ANN001
    """Time the acceptance of a map with a few changed cells, and planning on it."""
    times = []
    for _ in range(5):
        cells = cells.copy()
        row, column = rng.integers(100, np.array(cells.shape) - 100)
        cells[row : row + 4, column : column + 4] = 100
        begin = time.thread_time()
        route_map = RouteMap.from_cells(cells, resolution, previous=route_map)
        times.append((time.thread_time() - begin) * 1e3)
    part.add("changed_map_ms", statistics.median(times))
    start, goal = (free_pose(route_map, planner.vehicle, rng) for _ in range(2))
    begin = time.thread_time()
    planner.plan(route_map, start, goal, time.thread_time)
    part.add("plan_on_changed_map_ms", (time.thread_time() - begin) * 1e3)


def cli_start(options: Options, occupied, resolution, pose) -> float:  # noqa: ANN001
    """Return the processor time of ``monstertruckd plan`` for a motion of zero length, without compilation."""
    import resource  # noqa: PLC0415

    # Bytecode is read and written where Python does so by default.
    environment = {name: value for name, value in os.environ.items() if name not in NO_BYTECODE}

    command = [sys.executable, "-m", "monstertruckd", "plan", str(options.data / "maps" / f"{MAP}.yaml")]
    place = ",".join(f"{value:.4f}" for value in pose)
    times = []
    for _ in range(CLI_STARTS + 1):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, place, place, "--budget", "0.01"], check=False, capture_output=True, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times[1:])
