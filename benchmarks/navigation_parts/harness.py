"""Light harness: random goals over maps, without serial lines and without Zenoh.

The planning step and the tracker are the daemon's own; the truck is kinematic, with the axles' turning rate and the
drive's acceleration. Collisions are judged on the map by the footprint without padding. Every run has its own seed. A
route is planned with little effort first, and with the default if none is found, so that equal runs are equal.
Unreachable goals are excluded from the share, and counted.
"""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.navigation_parts import Options, Part
from monstertruck_kinematics.se2 import Pose2
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import OCCUPIED, DistanceField, Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import PlanTask, RouteAnswer, Setup
from monstertruck_planners.goals.goal_run import apart
from monstertruck_planners.goals.plan_step import PlanningStep
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.track.catalog import build_tracker
from monstertruck_planners.track.config import LqrConfig
from monstertruck_planners.track.path_tracker import TruckState
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.plan import Path as DrivePath
from monstertruck_schemas.reasons import Reason

WORLDS = ROOT / "configs" / "worlds"
SHIPPED = ("rooms", "corridor_maze", "loop", "yard")
TOLERANCE = (0.2, 0.2)
"""Metres and radians."""
PERIOD = 0.05
ACCELERATION = 0.5
STEERING_RATE = 1.0
ROUTES = 3
"""Routes for one goal: the first one and corrections of its end."""
AIM = 0.4
"""Share of the tolerance beyond which the end is corrected."""
EFFORTS = 5000, 60_000


@dataclass(frozen=True)
class Place:
    """One map, with planner and judge."""

    name: str
    steps: tuple[PlanningStep, PlanningStep]
    """With little effort, and with more."""
    truth: DistanceField
    low: np.ndarray
    high: np.ndarray


def place(file: Path) -> Place:
    """Load a map and set up its planning step."""
    world = load_map(file)
    steps = PlanningStep(), PlanningStep()
    for step, effort in zip(steps, EFFORTS, strict=True):
        config = PlannerConfig(map=file, route=HybridConfig(margin=0.03, effort=effort))
        setup = Setup(config, TRUCK, BODY)
        step.step(PlanTask("route", (math.nan,) * 3, (0.0,) * 3, np.empty((0, 2)), setup))
    low = np.array(world.origin)
    truth = DistanceField((world.cells >= OCCUPIED) | (world.cells < 0), world.resolution, (*world.origin, 0.0))
    return Place(file.stem, steps, truth, low, low + world.size)


TRUCK, BODY = FourWheelSteering(), Footprint()
BARE = Footprint(padding=0.0)
CONFIG = LqrConfig(kind="lqr", goal_tolerance=0.01)


def random_pose(where: Place, rng: np.random.Generator) -> Pose2:
    """Return a pose with some centimetres of room."""
    while True:
        x, y = rng.uniform(where.low, where.high)
        pose = np.array([[x, y, rng.uniform(-math.pi, math.pi)]])
        if where.truth.free(BODY, pose, 0.05)[0]:
            return float(pose[0, 0]), float(pose[0, 1]), float(pose[0, 2])


def drive(where: Place, answer: RouteAnswer, pose: Pose2) -> tuple[Pose2, bool, float]:
    """Follow a route; return the last pose, whether it collided, and the duration (s)."""
    planned = answer.path
    assert planned is not None
    path = DrivePath(
        stamp=0, received=0, seq=0, frame="map", poses=planned.poses.ravel(), directions=planned.directions,
        steering=planned.steering, clearance=np.zeros(0) if planned.clearance is None else planned.clearance,
    )  # fmt: skip
    try:
        line = SegmentedPath(path, pose, CONFIG.beyond)
    except InputError:  # nothing left to drive
        return pose, False, 0.0
    tracker = build_tracker(CONFIG, TRUCK)
    progress, speed, front, rear = line.start, 0.0, 0.0, 0.0
    limit = 60.0 + 20.0 * answer.length
    driven = [pose]
    for k in range(round(limit / PERIOD)):
        vx = speed * math.cos(math.atan((math.tan(front) + math.tan(rear)) / 2))
        command = tracker.control(TruckState(driven[-1], vx), line, progress, k * PERIOD)
        progress = command.progress
        if command.outcome is not Reason.DRIVING and abs(speed) < 0.01:
            break
        speed += float(np.clip(command.speed - speed, -ACCELERATION * PERIOD, ACCELERATION * PERIOD))
        turn = STEERING_RATE * PERIOD
        front += float(np.clip(command.front - front, -turn, turn))
        rear += float(np.clip(command.rear - rear, -turn, turn))
        twist = TRUCK.body_twist(speed, front, rear)
        x, y, yaw = TRUCK.integrate(driven[-1], *twist, PERIOD)
        driven.append((float(x), float(y), float(yaw)))
    collided = not where.truth.free(BARE, np.array(driven)).all()
    return driven[-1], collided, len(driven) * PERIOD


def trip(where: Place, rng: np.random.Generator) -> dict[str, Any]:
    """Drive to one random goal from one random start."""
    pose, goal = random_pose(where, rng), random_pose(where, rng)
    row: dict[str, Any] = {"map": where.name, "start": pose, "goal": goal, "collided": False, "seconds": 0.0}
    for number in range(ROUTES):
        task = PlanTask("route", pose, goal, np.empty((0, 2)), clear=True)
        answer = where.steps[0].step(task)
        if answer.reason is Reason.ROUTE_TIMEOUT:
            answer = where.steps[1].step(task)
        row["reason"] = answer.reason
        if answer.path is None:
            break
        row["length"] = row.get("length", answer.length)
        pose, collided, seconds = drive(where, answer, pose)
        row["collided"] |= collided
        row["seconds"] += seconds
        row["routes"] = number + 1
        away, turned = row["away"], row["turned"] = apart(pose, goal)
        if max(away / TOLERANCE[0], turned / TOLERANCE[1]) <= AIM:
            break
    row["reached"] = "away" in row and row["away"] <= TOLERANCE[0] and row["turned"] <= TOLERANCE[1]
    return row


def run(options: Options) -> Part:
    files = [WORLDS / f"{name}.yaml" for name in SHIPPED]
    if options.data is not None:
        files += sorted((options.data / "maps").glob("*.yaml"))
    places = [place(file) for file in files]
    count = min(options.runs, 2 * len(places)) if options.quick else options.runs
    begin = time.process_time()
    rows = [trip(places[i % len(places)], np.random.default_rng([1, i])) for i in range(count)]
    possible = [row for row in rows if row["reason"] is not Reason.GOAL_UNREACHABLE or "away" in row]
    part = Part()
    part.add("runs", len(rows))
    part.add("maps", len(places))
    part.add("unreachable", len(rows) - len(possible))
    part.add("not_reached_share", 1.0 - sum(row["reached"] for row in possible) / max(len(possible), 1), 0.02)
    part.add("collisions", sum(row["collided"] for row in rows), 0)
    reached = [row for row in possible if row["reached"]]
    for name, unit in (("away", "m"), ("turned", "rad")):
        values = np.array([row[name] for row in reached] or [math.inf])
        for label, value in (("p50", np.median(values)), ("p95", np.percentile(values, 95))):
            part.add(f"{name}_{label}_{unit}", float(value))
        part.add(f"{name}_max_{unit}", float(values.max()), 0.2)
    part.add("both_within_0.05_share", sum(max(row["away"], row["turned"]) <= 0.05 for row in reached) / len(reached))
    part.add("corrected_share", sum(row["routes"] > 1 for row in reached) / len(reached))
    part.add("cpu_s_per_run", (time.process_time() - begin) / len(rows))
    for row in possible:
        if not row["reached"] or row["collided"]:
            how = "collided" if row["collided"] else row["reason"].value
            print(f"{row['map']} {np.round(row['start'], 3)} to {np.round(row['goal'], 3)}: {how}", flush=True)
    (options.out / "harness.json").write_text(json.dumps(rows, indent=1))
    return part
