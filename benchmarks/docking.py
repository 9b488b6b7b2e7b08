"""Docking in random places, light and noise: forward, and in reverse with localisation by scans.

    python benchmarks/docking.py [--seeds 200] [--first 0] [--jobs 2] [--directions forward reverse] [--resume FILE]

Each seed draws a dock on a wall of one of three built-in worlds, light, pixel noise and defocus of the camera, the
errors of the dock's place in the configuration and of the robot's pose in the map, and a start near the staging pose.
The behaviour ``dock`` runs in the whole daemon on the virtual clock.

A docking counts if the behaviour ends with ``behaviour_done``, the true pose is within 1 cm and 1 degree of the true
docked pose, and the true footprint touched nothing. The last line is JSON.
"""

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.virtual_runs import behaviour_run
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import compose
from monstertruck_planners.collision import DistanceField, Footprint
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.map_files import OCCUPIED
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay

CONFIG = ROOT / "configs" / "dock.yaml"
WORLDS = ("rooms", "workshop", "hall")
DIRECTIONS = ("forward", "reverse")
LENGTH, WIDTH = 0.47, 0.34
"""Size of the robot, m."""
TAG_DISTANCE, STAGING, RADIUS = 0.5, 0.7, 0.5
"""From the docked base to the tag and to the staging pose, and of the turn in reverse, m."""
SPARE = 0.12
"""Least distance of the robot from walls on the drawn manoeuvre, m."""
LIMIT = 400.0
"""Simulated seconds of a docking."""
GOALS = {"share": 0.99, "contacts": 0}


def way(direction: str) -> Array:
    """Return the poses (n, 3) of the manoeuvre, relative to the docked pose."""
    ahead = STAGING + 0.1 + (2 * RADIUS if direction == "reverse" else 0.0)
    axis = [(-x, 0.0, 0.0) for x in np.arange(0.15 if direction == "reverse" else 0.0, ahead, 0.05)]
    if direction == "forward":
        return np.array(axis)
    turns = np.arange(0.0, math.pi / 2, 0.1)
    start = -ahead + 0.1
    out = [(start + RADIUS * math.sin(a), RADIUS * (1 - math.cos(a)), a) for a in turns]
    into = [(start + RADIUS * math.sin(a), 2 * RADIUS - RADIUS * (1 - math.cos(a)), math.pi - a) for a in turns]
    return np.array(axis + out + into)


def place(world: str, direction: str, rng: np.random.Generator) -> Array:
    """Return a docked pose (3,) that faces the dock, whose tag hangs on a wall square to an axis of the map."""
    built = BUILT_IN[world]().map
    occupied = built.cells == OCCUPIED
    field = DistanceField(occupied, built.resolution, (*built.origin, 0.0))
    footprint = Footprint(LENGTH, WIDTH)
    rows, columns = np.nonzero(occupied)
    while True:
        at = int(rng.integers(len(rows)))
        turn = float(rng.integers(4)) * math.pi / 2
        row, column = int(rows[at]), int(columns[at])
        down, right = round(math.sin(turn)), round(math.cos(turn))
        aside = [(row + k * right, column + k * down) for k in range(-5, 6)]  # 5 cells of wall on both sides
        inside = all(0 < r < len(occupied) - 1 and 0 < c < occupied.shape[1] - 1 for r, c in aside)
        if not inside or not all(occupied[r, c] and not occupied[r - down, c - right] for r, c in aside):
            continue
        middle = (np.array((column, row)) + 0.5 - 0.5 * np.array((right, down))) * built.resolution + built.origin
        # 5 mm: the tag hangs before the wall
        docked = compose(np.array((*middle, turn)), np.array((-TAG_DISTANCE - 0.005, 0.0, 0.0)))
        poses = np.array([compose(docked, each) for each in way(direction)])
        if float(field.clearance(footprint, poses, 1.0).min()) > SPARE:
            return docked


def pose(row: Array) -> dict[str, float]:
    return dict(zip(("x", "y", "yaw"), row.tolist(), strict=True))


def trial(seed: int, direction: str) -> dict[str, Any]:
    """Simulate one docking."""
    rng = np.random.default_rng([53, seed])
    world = WORLDS[seed % len(WORLDS)]
    facing = place(world, direction, rng)
    about = np.array((0.0, 0.0, math.pi if direction == "reverse" else 0.0))
    docked = compose(facing, about)
    entered = compose(docked, rng.uniform(-1, 1, 3) * (0.05, 0.05, 0.05))
    start = compose(compose(facing, np.array((-STAGING, 0.0, 0.0))), rng.uniform(-1, 1, 3) * (0.08, 0.08, 0.1))
    known = compose(start, rng.normal(size=3) * (0.02, 0.02, 0.01))
    light = {
        "brightness": float(2.0 ** rng.uniform(-2.5, 1.0)),
        "gradient": float(rng.uniform(-0.7, 0.7)),
        "noise": float(rng.uniform(1.0, 10.0)),
        "blur": float(rng.uniform(0.0, 1.2)),
    }
    tag = compose(facing, np.array((TAG_DISTANCE, 0.0, math.pi)))
    overlay: dict[str, Any] = {
        "recorder": None, "blackbox": None, "zones": None, "planner": None, "tracker": None,
        "odometry": {"start": pose(known)},
        "devices": {"camera": {"driver": {"rate": 5}}},
        "docks": {"charger": pose(entered) | {"direction": direction}},
        "sim": {
            "seed": seed,
            "world": {
                "map": world, "start": pose(start), "camera": light, "chargers": [pose(docked)],
                "tags": [pose(tag) | {"tag": 20, "z": 0.25, "size": 0.2}],
            },
        },
    }  # fmt: skip
    if direction == "reverse":
        overlay["slam"] = {"mode": "mapping"}
    config = with_overlay(load_config(CONFIG, SimulatedTruckConfig)[0], overlay)
    states, truth = run_virtual(
        lambda clock: behaviour_run(config, "dock", clock, settle=3.0, limit=LIMIT), start=SECOND
    )
    end, last = states[-1], truth[-1, 1:4]
    off = math.dist(last[:2], docked[:2])
    turn = abs(math.degrees(math.remainder(float(last[2] - docked[2]), math.tau)))
    contact = bool(truth[:, 5].any())
    good = end.outcome is Reason.BEHAVIOUR_DONE and off <= 0.01 and turn <= 1.0 and not contact
    return {
        "seed": seed, "direction": direction, "world": world, "good": good, "contact": contact,
        "mm": round(1000 * off, 1), "degrees": round(turn, 2), "outcome": end.outcome.value, "text": end.text,
        "attempts": end.values.get("attempt", 0.0), "seconds": round(end.elapsed, 1),
        "light": {name: round(value, 2) for name, value in light.items()},
    }  # fmt: skip


def main() -> None:
    """Dock with all seeds and print the sums."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=200, help="of each direction")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--directions", nargs="+", choices=DIRECTIONS, default=DIRECTIONS)
    parser.add_argument("--resume", type=Path, help="file of rows: read before, and extended")
    options = parser.parse_args()
    file: Path | None = options.resume
    lines = file.read_text().splitlines() if file is not None and file.exists() else []
    rows = [json.loads(line) for line in lines]
    done = {(row["seed"], row["direction"]) for row in rows}
    jobs = [
        (seed, direction)
        for seed in range(options.first, options.first + options.seeds)
        for direction in options.directions
        if (seed, direction) not in done
    ]
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for row in pool.map(trial, *zip(*jobs, strict=True)) if jobs else ():
            rows.append(row)
            print(row, flush=True)
            if file is not None:
                with file.open("a") as out:
                    out.write(json.dumps(row) + "\n")
    figures = {direction: sums([row for row in rows if row["direction"] == direction]) for direction in DIRECTIONS}
    met = all(
        row["runs"] >= 200 and row["good"] >= GOALS["share"] * row["runs"] and not row["contacts"]
        for row in figures.values()
    )
    print(json.dumps({"bench": "docking", "figures": figures, "goals": GOALS | {"runs": 200}, "met": met}))


def sums(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of one direction."""
    done = [row for row in rows if row["outcome"] == Reason.BEHAVIOUR_DONE.value]
    return {
        "runs": len(rows),
        "good": sum(row["good"] for row in rows),
        "contacts": sum(row["contact"] for row in rows),
        "again": sum(row["attempts"] > 1 for row in rows),
        "mm_median": float(np.median([row["mm"] for row in done])) if done else None,
        "mm_worst": max((row["mm"] for row in done), default=None),
        "degrees_worst": max((row["degrees"] for row in done), default=None),
        "seconds_median": float(np.median([row["seconds"] for row in done])) if done else None,
    }


if __name__ == "__main__":
    main()
