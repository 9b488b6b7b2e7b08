"""5.3 Path construction: random queries in the built-in rooms by all route planners, two and four wheels.

``grid_astar`` is the author's (its paths ignore the wheels' constraints); times are processor time. Clearance is that
of the true footprint in the world; curvature is relative to the tightest that the truck can drive.
"""

import time

import numpy as np

from benchmarks import scoring
from benchmarks.exploration_parts.arena import BARE, Arena
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.harness import WORLDS
from monstertruck_planners.route.api import RouteMap, Vehicle, make_planner
from monstertruck_planners.route.config import GridAstarConfig, HybridConfig, LatticeConfig
from monstertruckd.tools.figures import new_figure, write_figure

PLANNERS = {"hybrid": HybridConfig(), "lattice": LatticeConfig(), "grid_astar": GridAstarConfig()}
QUERIES = 20


def run(options: Options) -> Part:
    part = Part()
    arena = Arena.load("rooms", WORLDS / "rooms.yaml")
    ground = RouteMap.from_cells(
        np.where(arena.blocked, 100, 0).astype(np.int8), arena.resolution, (*arena.origin, 0.0)
    )
    queries = [(arena.start(2 * k), arena.start(2 * k + 1)) for k in range(2 if options.quick else QUERIES)]
    shown = []
    for name, config in PLANNERS.items():
        for car in ("2ws", "4ws"):
            vehicle = Vehicle.truck(car)
            planner = make_planner(vehicle, config)
            planner.plan(ground, vehicle.reference_pose(queries[0][0]), vehicle.reference_pose(queries[0][1]))
            rows = [one(planner, vehicle, arena, ground, *query) for query in queries]
            done = [row for row in rows if row is not None]
            part.add(f"{name}.{car}.found_share", len(done) / len(rows))
            for key in ("length_m", "time_ms", "cusps"):
                part.add(f"{name}.{car}.{key}", float(np.mean([row[key] for row in done])) if done else 0.0)
            if done:
                bend, room = (max(row["bend"] for row in done), min(row["clearance_m"] for row in done))
                part.add(f"{name}.{car}.curvature_max_share", bend, None if name == "grid_astar" else 1.001)
                part.add(f"{name}.{car}.clearance_min_m", room)
                shown.append((f"{name} {car}", done[0]["poses"]))
    draw(options, arena, shown)
    return part


def one(planner, vehicle, arena: Arena, ground: RouteMap, start, goal) -> dict | None:  # noqa: ANN001
    begin = time.thread_time()
    result = planner.plan(ground, vehicle.reference_pose(start), vehicle.reference_pose(goal))
    used = time.thread_time() - begin
    path, poses = result.path, result.poses
    if path is not None:
        length, cusps, bend = path.length, path.cusps, float(np.abs(path.segments[:, 1]).max())
        poses = path.sample(0.05).poses
    elif poses is not None:  # cell by cell, no motion
        length, cusps, bend = scoring.length(poses), 0, scoring.sharpest(poses)
    else:
        return None
    base = poses.copy()
    base[:, :2] -= vehicle.reference * np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    return {
        "length_m": length, "time_ms": 1e3 * used, "cusps": cusps, "poses": base, "bend": bend * vehicle.radius,
        "clearance_m": scoring.clearance(arena.truth, BARE, base),
    }  # fmt: skip


def draw(options: Options, arena: Arena, shown: list) -> None:
    figure = new_figure(9, 7)
    axes = figure.subplots()
    rows, columns = arena.blocked.shape
    x, y = arena.origin
    box = (x, x + columns * arena.resolution, y, y + rows * arena.resolution)
    axes.imshow(arena.blocked, origin="lower", extent=box, cmap="Greys", alpha=0.7)
    for name, poses in shown:
        axes.plot(*poses[:, :2].T, lw=1.2, label=name)
    axes.legend()
    write_figure(figure, options.out / "routes.png")
