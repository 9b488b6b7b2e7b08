"""Rough ground on the direct route: the detours accepted by the planner of a truck as configured.

A hall has two routes to the goal: a direct one, rough over most of its length, and a detour, whose length differs from
map to map. A detour is measured by its length relative to the direct route; up to ``DETOUR`` it must be chosen.
"""

import time

import numpy as np

from benchmarks.navigation_parts import Options, Part
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.route.api import RouteMap, Vehicle, warm_up
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner

CELL = 0.05
ROUGHNESS = (0.01, 0.02, 0.03)
"""Standard deviation of the height, m."""
DEPTHS = np.arange(0.5, 4.0, 0.25)
"""Depths of the block between the two ways, m."""
DETOUR = 1.5
START, GOAL = (0.8, 0.6, 0.0), (7.2, 0.6, 0.0)
ROUGH = slice(round(2.0 / CELL), round(6.0 / CELL))
"""Columns of the block, and of the rough ground beside it."""
WAY = round(1.2 / CELL)
"""Rows of each way."""


def run(_options: Options) -> Part:
    part = Part()
    config = PlannerConfig()
    assert isinstance(config.route, HybridConfig)
    planner = HybridPlanner(Vehicle.truck(config.steering, angle=config.angle), config.route)
    warm_up(planner)
    driven, longest, missed = 0, 0.0, 0
    for depth in DEPTHS:
        direct, detour = (length(planner, hall(depth, closed=closed)) for closed in (False, True))
        ratio = detour / direct
        taken = []
        for roughness in ROUGHNESS:
            where = hall(depth, roughness=roughness)
            result = planner.plan(where, START, GOAL, time.thread_time)
            assert result.path is not None
            round_it = bool(result.path.sample(CELL).poses[:, 1].max() > CELL * WAY + depth)
            taken.append(round_it)
            driven += ratio < DETOUR
            missed += ratio < DETOUR and not round_it
            longest = max(longest, ratio * round_it)
        cells = ", ".join(f"{1e3 * r:.0f} mm {'round' if t else 'over'}" for r, t in zip(ROUGHNESS, taken, strict=True))
        print(f"detour of {ratio:.2f}: {cells}", flush=True)
    part.add("routes_with_a_detour_under_1.5", driven)
    part.add("rough_though_detour_under_1.5", missed, 0)
    part.add("longest_detour_taken", longest)
    return part


def hall(depth: float, *, closed: bool = False, roughness: float = 0.0) -> RouteMap:
    """Return the hall with a block of this depth; ``closed``: the direct route is blocked."""
    cells = np.zeros((2 * WAY + round(depth / CELL), round(8.0 / CELL)), np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[WAY:-WAY, ROUGH] = 100
    rough = np.zeros(cells.shape)
    rough[:WAY, ROUGH] = roughness
    if closed:
        cells[:WAY, ROUGH] = 100
    return RouteMap.from_cells(cells, CELL, roughness=rough)


def length(planner: HybridPlanner, where: RouteMap) -> float:
    result = planner.plan(where, START, GOAL, time.thread_time)
    assert result.path is not None
    return result.path.length
