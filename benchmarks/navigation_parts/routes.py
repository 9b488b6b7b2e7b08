"""Route planning compared with ompl's BIT*: the queries of a folder, with front steering and with both axles.

Lengths are relative to the shortest known one of each query, times to the first route relative to BIT*'s median over
some seeds in the same run; a strict judge checks every route.
"""

import json
import math
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numba import njit
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou
from scipy.ndimage import distance_transform_edt

from benchmarks.navigation_parts import Options, Part, strict
from monstertruck_planners.collision import DiscFootprint
from monstertruck_planners.route.api import RouteMap, Vehicle
from monstertruck_planners.route.hybrid import HybridPlanner
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.figures import new_figure, write_figure

TRUCK = Vehicle.truck("4ws")
WALL = 0.9
"""Radius of a ring of wall round a goal, m."""
RUNS = 7
SECONDS = 1.0


@dataclass(frozen=True)
class Query:
    """A case of queries.json."""

    map: str
    start: tuple[float, float, float]
    goal: tuple[float, float, float]
    known: float


def run(options: Options) -> Part:
    part = Part()
    ou.setLogLevel(ou.LOG_ERROR)
    ou.RNG.setSeed(1)
    if options.data is None:
        print("routes: no --data, left out")
        return part
    setting = json.loads((options.data / "planning" / "queries.json").read_text())
    footprint = DiscFootprint(tuple(setting["footprint"]["discs_x_m"]), setting["footprint"]["disc_radius_m"])
    radius, tolerance = setting["turning_radius_m"], setting["goal_tolerance"]
    begin = time.thread_time()
    planners = {
        "2ws": HybridPlanner(Vehicle(footprint, radius, 0.0, "front")),
        "4ws": HybridPlanner(Vehicle(footprint, TRUCK.radius, TRUCK.crab_angle, "counter")),
    }
    rows = []
    for name, queries in setting["queries"].items():
        occupied, resolution = read(options.data / "maps" / f"{name}.yaml")
        route_map = RouteMap.from_cells(np.where(occupied, 100, 0).astype(np.int8), resolution)
        world = strict.World(occupied, resolution)
        for number, case in enumerate(queries):
            query = Query(name, tuple(case["start"]), tuple(case["goal"]), case["shortest_known_m"])
            if not rows:
                for planner in planners.values():
                    planner.plan(route_map, query.start, query.goal, time.thread_time)
                part.add("warm_up_s", time.thread_time() - begin)
            row = {"map": name, "query": number, "known_m": query.known}
            for kind, planner in planners.items():
                result = planner.plan(route_map, query.start, query.goal, time.thread_time)
                row |= {
                    f"{key}_{kind}": value for key, value in judged(result, world, planner, query, tolerance).items()
                }
                if result.path is not None:
                    row[f"xy_{kind}"] = result.path.sample(0.05).poses[:, :2].tolist()
            row |= peer(occupied, resolution, footprint, radius, query, 2 if options.quick else RUNS)
            rows.append(row)
            print(
                f"{name} {number}: {row['length_2ws']:.2f} m ({row['length_2ws'] / query.known:.3f} of the known), "
                f"{row['cusps_2ws']} cusps, first {row['first_ms_2ws']:.1f} ms; 4WS {row['length_4ws']:.2f} m; "
                f"BIT* {row['bit_length']:.2f} m, {row['bit_cusps']:g} cusps, first {row['bit_first_ms']:.1f} ms; "
                f"{row['faults_2ws'] + row['faults_4ws'] or 'valid'}",
                flush=True,
            )
        refuse(part, name, planners["2ws"], route_map, query, world)
        walled = RouteMap.from_cells(
            np.where(walled_in(occupied, resolution, query.goal), 100, 0).astype(np.int8), resolution
        )
        since = time.thread_time()
        result = planners["2ws"].plan(walled, query.start, query.goal, time.thread_time)
        part.add(f"unreachable_ms_{name}", (time.thread_time() - since) * 1e3, 2000.0)
        part.add(f"unreachable_not_reported_{name}", int(result.reason is not Reason.GOAL_UNREACHABLE), 0)
    sum_up(part, rows)
    (options.out / "routes.json").write_text(json.dumps(rows, indent=1))
    draw(options, rows)
    return part


def read(path: Path):  # noqa: ANN201
    """Return the occupied cells, including the border of the image, and the resolution."""
    world = load_map(path)
    occupied = world.cells != 0
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
    return occupied, world.resolution


def judged(result, world, planner, query: Query, tolerance) -> dict:  # noqa: ANN001
    if result.path is None:
        return {"length": float("inf"), "cusps": 0, "first_ms": float("inf"), "faults": [result.reason.value]}
    vehicle = planner.vehicle
    rule = strict.Rule(
        vehicle.footprint.centres, vehicle.footprint.radius, vehicle.radius, vehicle.crab_angle,
        tolerance["position_m"], tolerance["yaw_rad"],
    )  # fmt: skip
    segments = [(abs(s), 1 if s > 0 else -1, k, b) for s, k, b in result.path.segments.tolist()]
    return {
        "length": result.path.length,
        "cusps": result.path.cusps,
        "first_ms": result.statistics["first_s"] * 1e3,
        "first_length": result.statistics["first_length"],
        "faults": strict.faults(world, rule, query.start, query.goal, segments),
    }


def refuse(part: Part, name: str, planner, route_map, query: Query, world) -> None:  # noqa: ANN001
    """Test invalid goals: their reasons and times."""
    wall = np.array(middle_of_a_square(world))
    worst = 0.0
    for goal, reasons in (
        ((*wall, 0.0), {Reason.GOAL_BLOCKED}),
        ((-3.0, 2.0, 0.0), {Reason.GOAL_OUTSIDE}),
        ((float("nan"), 1.0, 0.0), {Reason.NOT_FINITE}),
    ):
        begin = time.thread_time()
        result = planner.plan(route_map, query.start, goal, time.thread_time)
        worst = max(worst, time.thread_time() - begin)
        if result.reason not in reasons:
            part.add(f"wrong_reason_{name}_{result.reason.value}", 1, 0)
    part.add(f"refused_ms_{name}", worst * 1e3, 100.0)


def walled_in(occupied, resolution, goal):  # noqa: ANN001, ANN201
    """Return the map with a ring of walls around a goal."""
    rows, columns = np.indices(occupied.shape)
    away = np.hypot((columns + 0.5) * resolution - goal[0], (rows + 0.5) * resolution - goal[1])
    return occupied | (np.abs(away - WALL) < resolution)


def middle_of_a_square(world):  # noqa: ANN001, ANN201
    box = world.squares[len(world.squares) // 2].bounds
    return (box[0] + box[2]) / 2, (box[1] + box[3]) / 2


def sum_up(part: Part, rows: list[dict]) -> None:
    part.add("queries", len(rows))
    for kind in ("2ws", "4ws"):
        part.add(f"invalid_{kind}", sum(bool(row[f"faults_{kind}"]) for row in rows), 0)
    part.add("length_over_known", max(row["length_2ws"] / row["known_m"] for row in rows), 1.03)
    part.add("length_over_known_median", float(np.median([row["length_2ws"] / row["known_m"] for row in rows])))
    part.add("4ws_over_2ws", max(row["length_4ws"] / row["length_2ws"] for row in rows), 1.0)
    part.add("cusps_more_than_bit", max(row["cusps_2ws"] - row["bit_cusps"] for row in rows), 0)
    for name in dict.fromkeys(row["map"] for row in rows):
        own = [row for row in rows if row["map"] == name]
        mine, bit = (float(np.median([row[key] for row in own])) for key in ("first_ms_2ws", "bit_first_ms"))
        part.add(f"first_ms_{name}", mine)
        part.add(f"bit_first_ms_{name}", bit)
        part.add(f"first_over_bit_{name}", mine / bit, 2.0)


def peer(occupied, resolution: float, footprint: DiscFootprint, radius: float, query: Query, runs: int) -> dict:  # noqa: ANN001
    """Run BIT*: time to its first route, and length and cusps after a second (medians over some runs)."""
    space = ob.ReedsSheppStateSpace(radius)
    bounds = ob.RealVectorBounds(2)
    for axis, cells in enumerate(occupied.shape[::-1]):
        bounds.setLow(axis, 0.0)
        bounds.setHigh(axis, cells * resolution)
    space.setBounds(bounds)
    valid = validity(occupied, resolution, footprint)
    first, length, cusps = [], [], []
    for _ in range(runs):
        setup = bit_star(space, valid, resolution, query, any_will_do=True)
        begin = time.thread_time()
        setup.solve(10 * SECONDS)
        first.append(time.thread_time() - begin if setup.haveExactSolutionPath() else float("inf"))
        setup = bit_star(space, valid, resolution, query, any_will_do=False)
        setup.solve(SECONDS)
        if setup.haveExactSolutionPath():
            length.append(setup.getSolutionPath().length())
            cusps.append(turns(space, setup.getSolutionPath()))
    return {
        "bit_first_ms": float(np.median(first)) * 1e3,
        "bit_length": float(np.median(length)) if length else float("inf"),
        "bit_cusps": float(np.median(cusps)) if cusps else float("inf"),
    }


def bit_star(space, valid, resolution: float, query: Query, *, any_will_do: bool):  # noqa: ANN001, ANN201
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(valid)
    setup.getSpaceInformation().setStateValidityCheckingResolution(resolution / 2 / space.getMaximumExtent())
    ends = [space.allocState() for _ in range(2)]
    for state, pose in zip(ends, (query.start, query.goal), strict=True):
        state.setX(pose[0])
        state.setY(pose[1])
        state.setYaw(pose[2])
    setup.setStartAndGoalStates(ends[0], ends[1])
    objective = ob.PathLengthOptimizationObjective(setup.getSpaceInformation())
    if any_will_do:
        objective.setCostThreshold(ob.Cost(1e9))
    setup.setOptimizationObjective(objective)
    setup.setPlanner(og.BITstar(setup.getSpaceInformation()))
    setup.setup()
    return setup


def validity(occupied, resolution: float, footprint: DiscFootprint):  # noqa: ANN001, ANN201
    """Return the validity check of the queries, as fast as a Python callback allows."""
    distance = distance_transform_edt(~occupied) * resolution
    discs = np.array(footprint.centres)

    def valid(state) -> bool:  # noqa: ANN001
        return discs_free(distance, resolution, discs, footprint.radius, state.getX(), state.getY(), state.getYaw())

    valid(SimpleNamespace(getX=lambda: 1.0, getY=lambda: 1.0, getYaw=lambda: 0.0))
    return valid


@njit
def discs_free(distance, resolution, discs, radius, x, y, yaw):  # noqa: ANN001, ANN201
    c, s = np.cos(yaw), np.sin(yaw)
    for i in range(len(discs)):
        row, column = int((y + discs[i] * s) / resolution), int((x + discs[i] * c) / resolution)
        if not (0 <= row < distance.shape[0] and 0 <= column < distance.shape[1]):
            return False
        if distance[row, column] <= radius:
            return False
    return True


def turns(space, path) -> int:  # noqa: ANN001
    """Return the number of changes of direction along a path of Reeds-Shepp motions, sampled densely."""
    states, between = path.getStates(), [space.allocState(), space.allocState()]
    signs = []
    for a, b in pairwise(states):
        count = max(int(space.distance(a, b) / 0.02), 1)
        space.interpolate(a, b, 0.0, between[0])
        for k in range(1, count + 1):
            space.interpolate(a, b, k / count, between[k % 2])
            last, now = between[(k + 1) % 2], between[k % 2]
            middle = last.getYaw() + 0.5 * math.remainder(now.getYaw() - last.getYaw(), math.tau)
            dx, dy = now.getX() - last.getX(), now.getY() - last.getY()
            signs.append(dx * math.cos(middle) + dy * math.sin(middle))
    moving = np.array(signs)[np.abs(signs) > 1e-4]
    return int(np.count_nonzero(np.diff(np.sign(moving))))


def draw(options: Options, rows: list[dict]) -> None:
    """Draw the routes on their maps."""
    for name in dict.fromkeys(row["map"] for row in rows):
        occupied, resolution = read(options.data / "maps" / f"{name}.yaml")
        extent = (0, occupied.shape[1] * resolution, 0, occupied.shape[0] * resolution)
        figure = new_figure(10, 10 * extent[3] / extent[1] + 0.6)
        axis = figure.subplots()
        axis.imshow(occupied, origin="lower", cmap="gray_r", extent=extent, alpha=0.7)
        for row in (row for row in rows if row["map"] == name):
            for kind, style in (("2ws", "-"), ("4ws", "--")):
                if xy := row.get(f"xy_{kind}"):
                    axis.plot(*np.transpose(xy), style, lw=1.2, color=f"C{row['query']}",
                              label=f"{row['query']} {kind}: {row[f'length_{kind}']:.2f} m")  # fmt: skip
        axis.set(title=f"{name}: routes after {SECONDS:g} s", xlabel="x, m", ylabel="y, m")
        axis.legend(fontsize=7, loc="upper right")
        write_figure(figure, options.out / f"routes_{name}.png")
