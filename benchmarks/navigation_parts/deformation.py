"""Local planners: obstacles on a route that are not on the map, with front steering and with both axles.

A kinematic truck with a lidar drives each scenario with each local planner; all share window, follower and goal
tolerance (0.2 m, 0.2 rad, the author's). A run is better than that of the published planner (same strategy; the
author's for teb) if it arrives where that fails, or if both arrive, it is not slower, and it has no more contacts.
"""

import json
import math
import time
from typing import Any

import numpy as np

from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.deformation_world import (
    PERIOD,
    SCENARIOS,
    STEP,
    TRUCK,
    Follower,
    Scenario,
    Truck,
    World,
)
from monstertruck_planners.goals.deform_step import Window
from monstertruck_planners.local.api import LocalPlannerState
from monstertruck_planners.local.catalog import make_local_planner
from monstertruck_planners.local.config import LocalPlannerConfig, PublishedConfig, RsbandConfig, TebConfig
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.motion import MotionPath
from monstertruckd.tools.figures import new_figure, write_figure

STRATEGIES: tuple[Any, ...] = (
    "start_to_end",
    "start_to_next",
    "point_to_point",
    "skip_failures",
    "start_to_receding_end",
)
CARS: tuple[Any, ...] = ("2ws", "4ws")
LIMIT, TIMEOUT = 90.0, 12.0
ANGLE = 0.4
"""Greatest axle angle of a plan, rad."""


def run(options: Options) -> Part:
    part = Part()
    ours: dict[str, LocalPlannerConfig] = {s: RsbandConfig(strategy=s) for s in STRATEGIES}
    ours["teb"] = TebConfig()
    published = {s: PublishedConfig(strategy=s) for s in STRATEGIES}
    scenarios = SCENARIOS[:1] if options.quick else SCENARIOS
    for config in (*ours.values(), *published.values()):
        for car in CARS:
            drive(SCENARIOS[3], car, config, limit=2.0)
    rows = []
    for scenario in scenarios:
        for car in CARS:
            peers = {name: drive(scenario, car, config) for name, config in published.items()}
            for name, config in ours.items():
                row = drive(scenario, car, config)
                peer = peers[name if name in peers else "start_to_next"]
                row |= {"scenario": scenario.name, "car": car, "method": name, "better": better(row, peer)}
                rows.append(row | {"peer": {k: v for k, v in peer.items() if k != "cycles_ms"}})
                print(
                    f"{scenario.name:16} {car} {name:22} {summary(row)} | published {summary(peer)}"
                    f"{'' if row['better'] else '   not better'}",
                    flush=True,
                )
    sum_up(part, rows)
    (options.out / "deformation.json").write_text(json.dumps(rows, indent=1))
    draw(options, rows, scenarios)
    return part


def drive(scenario: Scenario, car: Any, config: LocalPlannerConfig, limit: float = LIMIT) -> dict:
    """Run once in closed loop."""
    vehicle = Vehicle.truck(car)
    route, world, window = scenario.route(vehicle), World(scenario), Window()
    planner, state, truck = make_local_planner(vehicle, config), LocalPlannerState(), Truck(scenario.start)
    follower: Follower | None = None
    cycles, trace, reasons = [], [], []
    violations, contacts, touching, least, waited, t = 0, 0, False, math.inf, 0.0, 0.0
    reached = False
    while t < limit and waited < TIMEOUT and not reached:
        world.at(t, truck.pose)
        world.scan(truck.pose, window)
        begin = time.thread_time()
        obstacles = window.field(world.known)
        result = planner.plan(route, obstacles, vehicle.reference_pose(truck.pose), state)
        cycles.append((time.thread_time() - begin) * 1e3)
        state = result.state
        if result.path is not None and len(result.path.segments):
            violations += beyond(result.path, vehicle)
            follower, waited = Follower(result.path, vehicle), 0.0
        else:
            follower, waited = None, waited + PERIOD
            reasons.append(result.reason.value)
        for _ in range(round(PERIOD / STEP)):
            command = follower.command(truck) if follower else (0.0, truck.front, truck.rear)
            truck.step(*command)
            t += STEP
            world.at(t, truck.pose)
            clearance = world.clearance(truck.pose)
            least = min(least, clearance)
            contacts += clearance <= 0.0 and not touching
            touching = clearance <= 0.0
        trace.append([round(v, 3) for v in truck.pose])
        x, y, yaw = scenario.goal
        reached = math.hypot(truck.pose[0] - x, truck.pose[1] - y) < 0.2 and (
            abs(math.remainder(truck.pose[2] - yaw, math.tau)) < 0.2
        )
    return {
        "reached": reached, "contacts": contacts, "clearance_m": round(least, 4), "time_s": round(t, 2),
        "violations": violations, "waiting": len(reasons), "reason": reasons[-1] if reasons and not reached else "",
        "p50_ms": round(float(np.median(cycles)), 2), "max_ms": round(max(cycles), 2), "cycles_ms": cycles,
        "trace": trace,
    }  # fmt: skip


def beyond(path: MotionPath, vehicle: Vehicle) -> int:
    """Return the number of pieces of a path that the truck's wheels cannot drive."""
    turn, slip = path.segments[:, 1], path.segments[:, 2]
    if vehicle.steering == "front":
        return int(((np.abs(turn) > math.tan(ANGLE) / TRUCK.wheelbase + 1e-6) | (slip != 0.0)).sum())
    angles = np.abs(np.array(TRUCK.steer_for(turn, slip)))
    return int((angles > ANGLE + 1e-6).any(axis=0).sum())


def better(row: dict, peer: dict) -> bool:
    if not row["reached"] or row["contacts"] > peer["contacts"]:
        return False
    return not peer["reached"] or row["time_s"] <= peer["time_s"]


def summary(row: dict) -> str:
    what = f"{row['time_s']:5.1f} s" if row["reached"] else f"fails ({row['reason'] or 'time'})"
    hits = f", {row['contacts']} contacts" if row["contacts"] else ""
    return f"{what}, clearance {row['clearance_m']:.3f} m{hits}"


def sum_up(part: Part, rows: list[dict]) -> None:
    count = len(rows)
    cycles = np.concatenate([row["cycles_ms"] for row in rows])
    for row in rows:
        del row["cycles_ms"]
    part.add("rows", count)
    part.add("cycle_p50_ms", float(np.percentile(cycles, 50)))
    part.add("cycle_p99_ms", float(np.percentile(cycles, 99)), 50.0)
    part.add("cycle_max_ms", float(cycles.max()))
    part.add("curvature_violations", sum(row["violations"] for row in rows), 0)
    part.add("not_better_share", sum(not row["better"] for row in rows) / count, 0.1)
    part.add("rows_with_more_contacts", sum(row["contacts"] > row["peer"]["contacts"] for row in rows), 0)
    part.add("contacts", sum(row["contacts"] for row in rows))
    part.add("reached_share", sum(row["reached"] for row in rows) / count)
    part.add("published_reached_share", sum(row["peer"]["reached"] for row in rows) / count)
    for method in (*STRATEGIES, "teb"):
        own = [row for row in rows if row["method"] == method]
        part.add(f"{method}_reached_share", sum(row["reached"] for row in own) / len(own))
        part.add(f"{method}_time_s", float(np.mean([row["time_s"] for row in own if row["reached"]] or [math.inf])))
        part.add(f"{method}_least_clearance_m", min(row["clearance_m"] for row in own))


def draw(options: Options, rows: list[dict], scenarios: tuple[Scenario, ...]) -> None:
    """Draw all runs, ours in colour, the published planner's in grey."""
    figure = new_figure(13, 3.6 * len(scenarios))
    axes = figure.subplots(len(scenarios), 2, squeeze=False)
    for line, scenario in zip(axes, scenarios, strict=True):
        for ax, car in zip(line, CARS, strict=True):
            world = World(scenario)
            world.at(30.0, None)
            ax.imshow(world.occupied, origin="lower", extent=(0, 7, 0, 5), cmap="Greys", alpha=0.6)
            ax.plot(*scenario.route(Vehicle.truck(car)).poses[:, :2].T, "k:", lw=1)
            own = [row for row in rows if row["scenario"] == scenario.name and row["car"] == car]
            for row in own:
                ax.plot(*np.array(row["peer"]["trace"])[:, :2].T, color="0.65", lw=1)
            for row in own:
                ax.plot(*np.array(row["trace"])[:, :2].T, lw=1.3, label=row["method"])
            if scenario.person is not None:
                ax.plot(*np.array([scenario.person(t) for t in np.arange(0, 25, 0.5)]).T, "r.", ms=3)
            peers = sum(row["peer"]["reached"] for row in own)
            ax.set_title(
                f"{scenario.name}, {car}: {sum(r['reached'] for r in own)} of {len(own)} arrive, published {peers}"
            )
            ax.set_aspect("equal")
    axes[0][0].legend(fontsize=7, loc="lower right")
    write_figure(figure, options.out / "deformation.png")
