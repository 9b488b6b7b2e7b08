"""Routes on maps drawn by seed: both axles against front steering, turns in corridors, exhausted lattices.

The truck with both axles is compared with the one with front steering, and with one with front steering that turns on
the circle of both axles, so that only translations distinguish them.
"""

import math
import time
from typing import Any

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.unseen_maps import free_pose, unseen_map
from monstertruck_planners.collision import DiscFootprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.route.api import RouteMap, Vehicle, warm_up
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_planners.route.lattice import LatticePlanner
from monstertruck_schemas.reasons import Reason

FOOTPRINT = DiscFootprint((-0.0283, 0.115, 0.2583), 0.1235)
TRUCK, FRONT = Vehicle.truck("4ws"), Vehicle.truck("2ws")
CUSPS = 8
"""Goal where 0.8 m are free."""


def run(options: Options) -> Part:
    part = Part()
    front, tight = (Vehicle(FOOTPRINT, radius, 0.0, "front") for radius in (FRONT.radius, TRUCK.radius))
    planners: dict[str, Any] = {
        "2ws": HybridPlanner(front),
        "tight": HybridPlanner(tight),
        "4ws": HybridPlanner(Vehicle(FOOTPRINT, TRUCK.radius, TRUCK.crab_angle, "counter")),
        "lattice": LatticePlanner(tight),
    }
    for planner in planners.values():
        warm_up(planner)
    ratios: dict[str, list[float]] = {"2ws": [], "tight": []}
    refused, invalid, missed = 0, 0, 0
    for kind in ("rooms", "maze", "boxes"):
        for seed in range(101, 103 if options.quick else 107):
            route_map, rng = unseen_map(kind, seed).route_map(), np.random.default_rng(seed)
            for _ in range(2):
                start, goal = (free_pose(route_map, planners["2ws"].vehicle, rng) for _ in range(2))
                found = {
                    name: planner.plan(route_map, start, goal, time.thread_time) for name, planner in planners.items()
                }
                two, tight, four, lattice = found.values()
                refused += lattice.reason is Reason.GOAL_UNREACHABLE and tight.ok
                for path in (found[name].path for name in ("2ws", "tight", "4ws") if found[name].ok):
                    invalid += not route_map.field.free(FOOTPRINT, path.sample(0.01).poses).all()
                missed += (two.ok or tight.ok) and not four.ok
                for name, other in (("2ws", two), ("tight", tight)):
                    if other.ok and four.ok:
                        ratio = four.path.length / other.path.length
                        ratios[name].append(ratio)
                        print(f"{kind} {seed}: {name} {other.path.length:.2f} m, 4ws {ratio:.4f} of it", flush=True)
    part.add("queries", len(ratios["tight"]))
    part.add("invalid", invalid, 0)
    part.add("4ws_missed", missed, 0)
    for name, found_ratios in ratios.items():
        part.add(f"4ws_over_{name}", max(found_ratios), 1.0)
        part.add(f"4ws_over_{name}_median", float(np.median(found_ratios)))
    part.add("lattice_said_unreachable_wrongly", refused, 0)
    turn_round(part)
    return part


def turn_round(part: Part) -> None:
    """Count the cusps of the daemon's own planner in corridors 0.80 m wide."""
    config = PlannerConfig()
    assert isinstance(config.route, HybridConfig)
    planner = HybridPlanner(Vehicle.truck(config.steering, angle=config.angle), config.route)
    cells = np.zeros((34, 260), np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    route_map, y = RouteMap.from_cells(cells, 0.025), 0.425
    worst = 0
    for x in (2.0, 2.5, 3.0, 4.0):
        result = planner.plan(route_map, (2.0, y, 0.0), (x, y, math.pi), time.thread_time)
        cusps = result.path.cusps if result.path else 99
        print(f"corridor, goal {x - 2.0:g} m ahead: {result.reason.value}, {cusps} cusps")
        worst = max(worst, cusps)
    part.add("corridor_cusps", worst, CUSPS)
