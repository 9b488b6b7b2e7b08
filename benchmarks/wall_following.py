"""Wall following in an arena of the study's kind, in random ones, and with faults: published methods 1 and 2, and ours.

The pure steps of the behaviours, the world's sonars (5 mm + 1 %, 5 % drop-outs), and a robot that follows the twist
asked for within the acceleration of its gate and a lag of 50 ms; no daemon, no gate. Both senses, random headings, the
same seeds for all; odometry and gyroscope with errors of their own.

- ``study``: 48 m, two corners of 70 and two of 110 degrees, a gap of 0.4 m. Steady is the RMS of the side sonar's true
  distance error on straights from 1 m after a corner, and after the approach; worst is its maximum there, the gap
  included; of runs that came to their end.
- ``start``: the same from the middle with the heading and sense of the study's own run (digits 7 and 5).
- ``arenas``: one drawn per seed (4 or 5 corners of 50 to 130 degrees, a door, a pillar), method 3.
- ``faults``: one sonar dead, stuck, cross-talking; IMU unplugged; a motor stalled; method 3, in the study's arena.

A jump is a change of the speed or yaw rate asked for, from one step to the next, of more than 0.8 m/s^2 or rad/s^2.
Ramps of method 3 are evaluated at 100 Hz. The last line is JSON.

    python benchmarks/wall_following.py [--seeds 50] [--jobs 2] [--only study start arenas faults] [--figure FILE.png]

``--resume FOLDER`` keeps every run there; the same command goes on after an interruption. Of the same program only.
"""

import argparse
import json
import math
import pickle
import re
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks.wall_parts.arena import Arena, drawn, start_rule, study
from benchmarks.wall_parts.simulation import Fault, FaultKind, WallRun, drive_along
from monstertruck_kinematics.elementary import Array
from monstertruck_planners.behave.api import Behaviour
from monstertruck_planners.behave.wall.config import WallLineConfig, WallPdConfig, WallSwitchingConfig
from monstertruck_planners.behave.wall.line import WallLine
from monstertruck_planners.behave.wall.published import WallPd, WallSwitching
from monstertruck_runtime.small_files import replace_file
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.config import FIVE_SONARS
from monstertruckd.tools.figures import new_figure, write_figure

AFTER: Final = 1.0
"""Metres after a corner, and after the approach, from which on a straight counts."""
LAP: Final = {"lap_length": 20.0, "lap_radius": 1.0}
METHODS: Final = (
    ("1", "beam"),
    ("1, offset 0.05", "beam"),
    ("1, amended", "beam"),
    ("1, amended", "cone"),
    ("2", "beam"),
    ("2", "cone"),
    ("3", "cone"),
    ("3", "beam"),
)
PARTS: Final = ("study", "start", "arenas", "faults")
FAULTS: Final[tuple[FaultKind, ...]] = ("dead", "stuck", "cross-talk", "imu", "motor")
FAULT_SEEDS: Final = 20
GOALS: Final = {
    "1, amended, beam: steady_mm": 4.0,
    "1, amended, beam: worst_mm": 25.0,
    "3, cone: steady_mm": 2.0,
    "3, cone: worst_mm": 15.0,
    "3, cone: seconds_max": 240.0,
    "3, cone: contacts": 0,
    "3, cone: unfinished": 0,
    "3, cone: jumps_v": 0,
    "3, cone: jumps_w": 0,
    "3, cone: acceleration": 0.6,
    "3, cone: jerk": 4.8,
    "arenas: contacts": 0,
    "arenas: unfinished": 0,
    "faults: contacts": 0,
}


class Job(NamedTuple):
    """One run."""

    part: str
    method: str
    model: str
    side: str
    seed: int
    fault: FaultKind | None = None
    start: tuple[float, float, float] | None = None


class Result(NamedTuple):
    """Saved values of a run."""

    job: Job
    run: WallRun
    errors: Array
    """Errors of the side sonar's distance at every point of ``run.track``, m; NaN where it does not count."""
    ramp: tuple[float, float]
    """Greatest acceleration and jerk of the planned ramps."""


def pilot(method: str, model: str, side: str, lap: dict[str, float]) -> tuple[Behaviour, float]:
    """Return the behaviour of a method, and its rate (1/s)."""
    if method == "3":
        config = WallLineConfig.model_validate({"side": side, "beam": model == "beam", **lap})
        return WallLine(config), config.rate
    if method == "2":
        switching = WallSwitchingConfig.model_validate({"side": side, **lap})
        return WallSwitching(switching), switching.rate
    own = {
        "offset": 0.0 if method == "1" else 0.05,
        **({"gap": 0.6, "aligned": 0.0, "seen": 0.6, "trigger": 0.34} if "amended" in method else {}),
    }
    pd = WallPdConfig.model_validate({"side": side, **own, **lap})
    return WallPd(pd), pd.rate


def do(job: Job) -> Result:
    """Run one job."""
    arena = drawn(job.seed) if job.part == "arenas" else study()
    behaviour, rate = pilot(job.method, job.model, job.side, {"lap_length": 8.0} if job.part == "arenas" else LAP)
    fault = None
    if job.fault is not None:
        rng = np.random.default_rng([job.seed, FAULTS.index(job.fault)])
        own = ("l", "fl", "f") if job.side == "left" else ("r", "fr", "f")
        part = str(rng.choice(("left", "right") if job.fault == "motor" else own))
        fault = Fault(job.fault, float(rng.uniform(30.0, 150.0)), part)
    run = drive_along(behaviour, rate, arena, job.side, job.seed, model=job.model, fault=fault, start=job.start)
    return Result(job, run._replace(ramps=[]), errors_along(arena, run.track), steepest(run))


def kept(job: Job, folder: Path | None) -> Result:
    """Return the result of ``do``, or its earlier result."""
    if folder is None:
        return do(job)
    name = "-".join(re.sub(r"[^a-z0-9.]+", "_", str(value)) for value in job if not isinstance(value, tuple))
    file = folder / f"{name}.pickle"
    if file.exists():
        found: Result = pickle.loads(file.read_bytes())
        return found
    result = do(job)
    replace_file(file, pickle.dumps(result))
    return result


def steepest(run: WallRun) -> tuple[float, float]:
    """Return the maximum acceleration and jerk of the planned ramps at 100 Hz."""
    acceleration = jerk = 0.0
    for ramp in run.ramps:
        a1, a2 = ramp.shape.coefficients
        t = np.arange(0.0, ramp.shape.duration, 0.01)
        acceleration = max(acceleration, float(np.abs(ramp.shape.a0 + 2 * a1 * t + 3 * a2 * t**2).max()))
        jerk = max(jerk, float(np.abs(2 * a1 + 6 * a2 * t).max()))
    return acceleration, jerk


def errors_along(arena: Arena, track: Array) -> Array:
    """Return the errors of the side sonar's distance from its wall; NaN in and near corners and in the approach."""
    errors, place, left = np.full(len(track), np.nan), FIVE_SONARS["l"], AFTER
    before = track[0, :2]
    for i, (x, y, yaw, _, found) in enumerate(track):
        left = left - math.dist((x, y), before) if found else AFTER
        before = np.array([x, y])
        if left > 0.0:
            continue
        c, s = math.cos(yaw), math.sin(yaw)
        at = np.array([x + c * place.x - s * place.y, y + s * place.x + c * place.y])
        for a, b in zip(arena.corners, np.roll(arena.corners, -1, axis=0), strict=True):
            length = float(np.linalg.norm(b - a))
            along = (b - a) / length
            if math.cos(yaw - math.atan2(along[1], along[0])) < math.cos(0.5):
                continue
            way, off = float((at - a) @ along), float(along[0] * (a - at)[1] - along[1] * (a - at)[0])
            if AFTER <= way <= length - AFTER and 0.0 < off < 1.0:
                errors[i] = off - 0.30
    return errors


def row_of(job: Job) -> str:
    """Return the name of the row of a run."""
    return {
        "study": f"{job.method}, {job.model}",
        "start": f"start: {job.method}, {job.model}",
        "arenas": "arenas",
        "faults": f"fault {job.fault}",
    }[job.part]


def summary(results: list[Result]) -> dict[str, Any]:
    """Return the figures of the runs of one row."""
    done = [r for r in results if r.run.reason is Reason.BEHAVIOUR_DONE]
    errors = [r.errors[~np.isnan(r.errors)] * 1000 for r in done]
    counted = np.concatenate(errors) if errors else np.zeros(0)
    worst = [float(np.abs(e).max()) for e in errors if len(e)]
    jumps = [r.run.jumps() for r in results]
    seconds = [r.run.seconds for r in done]
    return {
        "runs": len(results),
        "unfinished": len(results) - len(done),
        "contacts": sum(r.run.contact for r in results),
        "steady_mm": round(float(np.sqrt(np.mean(counted**2))), 2) if len(counted) else None,
        "median_mm": round(float(np.median(np.abs(counted))), 2) if len(counted) else None,
        "worst_mm": round(max(worst), 1) if worst else None,
        "worst_median_mm": round(float(np.median(worst)), 1) if worst else None,
        "seconds": round(float(np.median(seconds)), 1) if seconds else None,
        "seconds_max": round(max(seconds), 1) if seconds else None,
        "jumps_v": sum(j[0] for j in jumps),
        "jumps_w": sum(j[1] for j in jumps),
        "jump_v": round(max(j[2] for j in jumps), 3),
        "jump_w": round(max(j[3] for j in jumps), 3),
        "wheel": round(max(r.run.wheels for r in results), 3),
        "acceleration": round(max(r.ramp[0] for r in results), 4),
        "jerk": round(max(r.ramp[1] for r in results), 3),
        "step_ms": dict(zip(("median", "p99", "max"), _step_times(results), strict=True)),
        "reasons": dict(Counter(str(r.run.reason) for r in results)),
    }


def _step_times(results: list[Result]) -> list[float]:
    """Return the processor time of the behaviour's steps, ms: median, 99th percentile, maximum."""
    costs = np.concatenate([r.run.costs for r in results]) * 1000
    return [round(float(value), 2) for value in np.percentile(costs, (50, 99, 100))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="of study and arenas; faults have 20 at most")
    parser.add_argument("--resume", type=Path, metavar="FOLDER", help="keep runs there, and drive none again")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS)
    parser.add_argument("--method", choices=("1", "2", "3"), nargs="+", default=("1", "2", "3"))
    parser.add_argument("--model", choices=("beam", "cone"), nargs="+", default=("beam", "cone"))
    parser.add_argument("--figure", help="PNG of the runs of `start`")
    args = parser.parse_args()
    if args.figure and "start" not in args.only:
        parser.error("--figure draws the runs of the part start: it needs --only start, or all parts")
    sides, jobs = ("left", "right"), []
    every = range(args.seeds)
    if args.resume is not None:
        args.resume.mkdir(parents=True, exist_ok=True)
    rows = [row for row in METHODS if row[0][0] in args.method and row[1] in args.model]
    if "study" in args.only:
        jobs += [Job("study", *row, side, s) for row, s, side in product(rows, every, sides)]
    if "start" in args.only:
        heading, side = start_rule(7, 5)
        mirror = 1.0 if side == "left" else -1.0
        jobs += [Job("start", *row, side, 0, start=(0.0, 0.0, heading * mirror)) for row in rows]
    if "arenas" in args.only:
        jobs += [Job("arenas", "3", "cone", sides[s % 2], s) for s in every]
    if "faults" in args.only:
        seeds = range(min(args.seeds, FAULT_SEEDS))
        jobs += [Job("faults", "3", "cone", sides[s % 2], s, fault) for fault, s in product(FAULTS, seeds)]
    groups: dict[str, list[Result]] = {}
    figures: dict[str, dict[str, Any]] = {}
    expected = Counter(row_of(job) for job in jobs)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        for result in pool.map(partial(kept, folder=args.resume), jobs):
            name = row_of(result.job)
            results = groups.setdefault(name, [])
            results.append(result)
            if len(results) == expected[name]:
                figures[name] = summary(results)
                print(name, figures[name], flush=True)
                ends = Counter(r.run.text for r in results if r.run.reason is not Reason.BEHAVIOUR_DONE)
                for text, count in ends.items():
                    print(f"    {count} x {text or 'no end, or a contact'}", flush=True)
    broken = [row["contacts"] for name, row in figures.items() if name.startswith("fault ")]
    if broken:
        figures["faults"] = {"contacts": sum(broken)}
    if args.figure:
        _draw({name: results[0] for name, results in groups.items() if results[0].job.part == "start"}, args.figure)
    goals = {key: goal for key, goal in GOALS.items() if key.split(": ")[0] in figures}
    met = all(_figure(figures, key) is not None and _figure(figures, key) <= goal + 1e-3 for key, goal in goals.items())
    print(json.dumps({"bench": "wall_following", "seeds": args.seeds, "figures": figures, "goals": goals, "met": met}))
    return 0


def _figure(figures: dict[str, dict[str, Any]], key: str) -> Any:
    row, name = key.split(": ")
    return figures[row][name]


def _draw(first: dict[str, Result], file: str) -> None:
    figure = new_figure(5 * len(first), 11)
    axes = figure.subplots(3, len(first), squeeze=False)
    arena = study()
    for column, (name, result) in enumerate(first.items()):
        track, asked = result.run.track, result.run.asked
        for wall in arena.walls:
            axes[0, column].plot(wall[::2], wall[1::2], "k")
        axes[0, column].plot(track[:, 0], track[:, 1])
        axes[0, column].set(
            title=f"method {name.removeprefix('start: ')}", aspect="equal", xlabel="x, m", ylabel="y, m"
        )
        axes[1, column].plot(track[:, 3], result.errors * 1000)
        axes[1, column].set(xlabel="time, s", ylabel="distance error on straights, mm", ylim=(-60, 60))
        times = np.arange(len(asked)) * result.run.period
        axes[2, column].plot(times, asked[:, 0], label="speed, m/s")
        axes[2, column].plot(times, asked[:, 1], label="yaw rate, rad/s", linewidth=0.7)
        axes[2, column].set(xlabel="time, s", ylim=(-1.2, 1.2))
        axes[2, column].legend()
    write_figure(figure, Path(file))


if __name__ == "__main__":
    sys.exit(main())
