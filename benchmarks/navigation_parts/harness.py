"""Light harness: random goals over maps, without serial lines and without Zenoh.

The planning step and the tracker are the daemon's own; the truck is a kinematic one with the axles' turning rate and
the drive's acceleration. Collisions are judged on the map by the footprint without padding.

    python -m benchmarks.navigation_parts.harness [--runs 2000] [--data DIR] [--seed 1]
"""

import argparse
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import OCCUPIED, DistanceField, Footprint
from monstertruck_planners.manage.config import PlannerConfig
from monstertruck_planners.manage.exchange import PlanAnswer, PlanTask, Pose, Setup
from monstertruck_planners.manage.mission import apart
from monstertruck_planners.manage.planning import PlanningStep
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.track.api import TruckState
from monstertruck_planners.track.catalog import build_tracker
from monstertruck_planners.track.config import LqrConfig
from monstertruck_planners.track.line import Line
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.plan import Path as DrivePath
from monstertruck_schemas.reasons import Reason

WORLDS = Path(__file__).resolve().parents[2] / "configs" / "worlds"
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


@dataclass(frozen=True)
class Place:
    """One map: what plans on it, and what judges."""

    name: str
    step: PlanningStep
    truth: DistanceField
    low: np.ndarray
    high: np.ndarray


def place(file: Path) -> Place:
    """Load a map and set up its planning step."""
    world = load_map(file)
    step = PlanningStep()
    config = PlannerConfig(map=file, route=HybridConfig(margin=0.03, effort=5000))
    first = PlanTask("route", (math.nan,) * 3, (0.0,) * 3, np.empty((0, 2)), Setup(config, TRUCK, BODY, timed=False))
    step.step(first)
    low = np.array(world.origin)
    truth = DistanceField((world.cells >= OCCUPIED) | (world.cells < 0), world.resolution, (*world.origin, 0.0))
    return Place(file.stem, step, truth, low, low + world.size)


TRUCK, BODY = FourWheelSteering(), Footprint()
BARE = Footprint(padding=0.0)
CONFIG = LqrConfig(kind="lqr", goal_tolerance=0.01)


def random_pose(where: Place, rng: np.random.Generator) -> Pose:
    """A pose with some centimetres of room."""
    while True:
        x, y = rng.uniform(where.low, where.high)
        pose = np.array([[x, y, rng.uniform(-math.pi, math.pi)]])
        if where.truth.free(BODY, pose, 0.05)[0]:
            return float(pose[0, 0]), float(pose[0, 1]), float(pose[0, 2])


def drive(where: Place, answer: PlanAnswer, pose: Pose) -> tuple[Pose, bool, float]:
    """Follow a route; returns the last pose, whether it collided, and the seconds it took."""
    assert answer.poses is not None
    path = DrivePath(
        stamp=0, received=0, seq=0, frame="map", poses=answer.poses.ravel(), directions=answer.directions,
        steering=answer.steering,
    )  # fmt: skip
    try:
        line = Line(path, pose, CONFIG.beyond)
    except InputError:  # nothing left to drive
        return pose, False, 0.0
    law = build_tracker(CONFIG, TRUCK)
    progress, speed, front, rear = line.start, 0.0, 0.0, 0.0
    limit = 60.0 + 20.0 * answer.length
    driven = [pose]
    for k in range(round(limit / PERIOD)):
        vx = speed * math.cos(math.atan((math.tan(front) + math.tan(rear)) / 2))
        command = law.control(TruckState(driven[-1], vx), line, progress, k * PERIOD)
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


def run(where: Place, rng: np.random.Generator) -> dict[str, Any]:
    """One random goal from one random start."""
    pose, goal = random_pose(where, rng), random_pose(where, rng)
    row: dict[str, Any] = {"map": where.name, "start": pose, "goal": goal, "collided": False, "seconds": 0.0}
    for number in range(ROUTES):
        answer = where.step.step(PlanTask("route", pose, goal, np.empty((0, 2)), clear=True))
        row["reason"] = answer.reason
        if not answer.ok:
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


def figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What the runs show; goals to which no way leads are left out of the share, and counted."""
    possible = [row for row in rows if row["reason"] is not Reason.GOAL_UNREACHABLE or "away" in row]
    ended = [row for row in possible if "away" in row]
    spread = {
        name: [round(float(np.percentile([row[name] for row in ended], q)), 4) for q in (50, 95, 100)]
        for name in ("away", "turned")
        if ended
    }
    return {
        "runs": len(rows),
        "unreachable": len(rows) - len(possible),
        "reached": round(sum(row["reached"] for row in possible) / max(len(possible), 1), 4),
        "collisions": sum(row["collided"] for row in rows),
        **{f"{name}_p50_p95_max": values for name, values in spread.items()},
        "failed": [{k: row[k] for k in ("map", "start", "goal", "reason")} for row in possible if not row["reached"]][
            :10
        ],
    }


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--data", type=Path, help="folder with maps/*.yaml")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    files = [WORLDS / f"{name}.yaml" for name in SHIPPED]
    if arguments.data is not None:
        files += sorted((arguments.data / "maps").glob("*.yaml"))
    places = [place(file) for file in files]
    rng = np.random.default_rng(arguments.seed)
    rows = [run(places[i % len(places)], rng) for i in range(arguments.runs)]
    found = figures(rows)
    goals = {"reached": 0.98, "collisions": 0}
    met = found["reached"] >= goals["reached"] and found["collisions"] == 0
    print(json.dumps({"bench": "navigation_harness", "figures": found, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
