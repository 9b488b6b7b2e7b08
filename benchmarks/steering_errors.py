"""Steering that is not as calibrated: how soon trackers make up for it, and what they report.

    python benchmarks/steering_errors.py [--part PART] [--seeds N]

The reference model of the part ``tracking`` of ``navigation.py``, whose axles have 50 ms of dead time and a lag of
0.10 s that no tracker has configured, with one fault of the front axle or all of them. Each tracker drives a course
again and again, every lap from 5 cm to the left of its beginning and without its first 5 %. Errors are RMS distances
of the rear axle from the course, mm: of the first 10 m, and of the lap that begins after them; goals are their ratios
to those of a truck without a fault.

Parts: ``errors`` (the table), ``reports`` (what is reported of faults within 10 m, and of clean runs with noise, whose
number is ``--seeds``), ``latency`` (0.25 s of dead time and 0.20 s of lag, not configured: errors against those of a
tracker that has them configured). The last line is JSON.
"""

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.navigation_parts.tracking import (
    ADAPTER,
    KINDS,
    PERIOD,
    RESPONSES,
    STEP,
    YARDSTICK,
    Plant,
    built_in,
    route,
)
from benchmarks.scoring import distance, rms
from monstertruck_planners.track.axle_report import report
from monstertruck_planners.track.catalog import build_tracker
from monstertruck_planners.track.path_tracker import PathTracker, TruckState
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_schemas.reasons import Reason

COURSES = (("arcs", 0.5), ("arcs", 1.0), ("eight", 1.0))
TRACKERS = ("lqr", "mpc")
LIMIT = 0.75
"""Greatest angle of an axle, rad: a truck that loses 28 % of it can still drive every course."""
LEARNING = 10.0
"""Metres within which a fault is to be learnt and reported."""
ON_THE_WAY, AFTER = 2.5, 1.5
"""Greatest error over that without a fault, in these metres and after them."""
YAW_NOISE = 0.002
"""Standard deviation of measured yaws in the part ``reports``, rad."""
LATE = (0.25, 0.20, 5.0)
"""Dead time (s), lag (s) and greatest rate (rad/s) of the part ``latency``."""
PARTS = ("errors", "reports", "latency")


@dataclass(frozen=True)
class Fault:
    """Errors of the front axle, or of the ground."""

    gain: float = 1.0
    trim: float = 0.0
    """Rad, left positive."""
    understeer: float = 0.0
    """Share of the turn that is lost at every speed."""
    slip: float = 0.0
    """Angle lost for each m/s^2 of lateral acceleration, rad s^2/m."""
    backlash: float = 0.0
    """Play between servo and wheels, rad."""
    jitter: float = 0.0
    """Greatest additional delay of a request, s."""


CLEAN = Fault()
FAULTS = {
    "gain_0.9": Fault(gain=0.9),
    "gain_1.1": Fault(gain=1.1),
    "offset_3_degrees": Fault(trim=math.radians(3.0)),
    "understeer_20": Fault(understeer=0.2),
    "backlash_jitter": Fault(backlash=math.radians(2.0), jitter=0.03),
    "all": Fault(0.9, math.radians(3.0), 0.2, 0.0, math.radians(2.0), 0.03),
}
REPORTED = ("gain_0.9", "gain_1.1", "offset_3_degrees", "understeer_20", "all")
"""Faults that a calibration or another speed would show; play and jitter are not among what is learnt."""


@dataclass
class FaultyPlant:
    """The reference model with a fault."""

    plant: Plant
    fault: Fault
    wheels: float = 0.0
    """Where the play has left the front axle, rad."""

    def step(self, front: float, rear: float) -> None:
        """Execute one step with these requests."""
        plant, fault = self.plant, self.fault
        plant.turn(front, rear)
        play = 0.5 * fault.backlash
        self.wheels = min(max(self.wheels, plant.front - play), plant.front + play)
        acting = fault.gain * self.wheels + fault.trim
        grip = plant.speed**2 / plant.geometry.wheelbase
        acting /= 1.0 + grip * fault.slip
        vx, vy, turn = plant.geometry.body_twist(plant.speed, acting, plant.rear)
        plant.pose = plant.geometry.integrate(plant.pose, vx, vy, (1.0 - fault.understeer) * turn, STEP)


@dataclass
class Drive:
    """A tracker that drives a course lap after lap, and keeps what it has learnt."""

    tracker: PathTracker[Any]
    points: np.ndarray
    speed: float
    fault: Fault
    response: tuple[float, float, float]
    """Dead time (s), lag (s) and greatest rate (rad/s) of the axles."""
    seed: int = 0
    noise: float = 0.0
    """Standard deviation of measured yaws, rad."""
    metres: float = 0.0
    begun: float = 0.0
    """Time at which the next lap begins, s."""
    errors: list[tuple[float, float]] = field(default_factory=list)
    """Distance driven (m) and distance from the course (mm)."""
    lost: bool = False

    def lap(self, each: Callable[["Drive"], None]) -> None:
        """Drive the course once; ``each`` is called at every control step."""
        dead_time, lag, rate = self.response
        rng = np.random.default_rng([self.seed, round(self.metres)])
        truck = FaultyPlant(Plant(YARDSTICK, dead_time, lag, rate, self.tracker.config.angle), self.fault)
        plant = truck.plant
        yaw = math.atan2(*(self.points[1] - self.points[0])[::-1])
        x, y = self.points[0] + 0.05 * np.array([-math.sin(yaw), math.cos(yaw)])
        plant.pose, plant.speed = (float(x), float(y), yaw), self.speed
        path = SegmentedPath(route(self.points, "forward"), plant.pose, self.tracker.config.beyond)
        self.tracker.reset()
        progress, request, length, track = path.start, (0.0, 0.0), 0.0, []
        for k in range(round(5 * path.length / self.speed / PERIOD)):
            seen = (*plant.pose[:2], plant.pose[2] + self.noise * float(rng.standard_normal()))
            self.now = self.begun + k * PERIOD
            command = self.tracker.control(TruckState(seen, plant.speed), path, progress, self.now)
            progress = command.progress
            each(self)
            if command.outcome is not Reason.DRIVING:
                self.lost |= command.outcome is Reason.PATH_LOST
                break
            late = round(float(rng.uniform(0.0, self.fault.jitter)) / STEP)
            for i in range(round(PERIOD / STEP)):
                truck.step(*((command.front, command.rear) if i >= late else request))
                length += STEP * self.speed
                track.append((length, *plant.pose[:2]))
            request = (command.front, command.rear)
        self.begun = self.now + 10.0  # s of rest before the next lap
        rows = np.array(track)
        off = 1000 * distance(rows[:, 1:], self.points)
        beyond = (rows[:, 1:] - self.points[-1]) @ (self.points[-1] - self.points[-2]) > 0
        keep = slice(len(rows) // 20, len(rows) - int(np.argmin(beyond[::-1])))
        self.errors += [(self.metres + at, error) for at, error in zip(rows[keep, 0], off[keep], strict=True)]
        self.metres += length


def tracker_of(kind: str, speed: float, rate: float, **more: float) -> PathTracker[Any]:
    """Return a tracker with the settings of the part ``tracking``; it must learn dead time and lag."""
    settings = {"speed": speed, "reverse_speed": speed, "min_speed": 0.05, "deceleration": 0.5, "acceleration": 1.0}
    axle = {"angle": LIMIT, "steering": "front", "steering_rate": rate, "rate": 1 / PERIOD}
    return build_tracker(ADAPTER.validate_python({**settings, **axle, **KINDS[kind], **more}), YARDSTICK)


def learn(run: Drive, each: Callable[[Drive], None] = lambda _: None) -> tuple[float, float]:
    """Drive laps until ``LEARNING`` metres are driven, and one more; return the RMS errors during and after, mm."""
    while run.metres < LEARNING:
        run.lap(each)
    after = run.metres
    run.lap(each)
    at, errors = np.array(run.errors).T
    return rms(errors[at < LEARNING]), rms(errors[at >= after])


def errors(figures: dict[str, float], goals: dict[str, float]) -> None:
    """Drive every course with every fault."""
    courses = built_in()
    print(f"{'':20}{'RMS mm in 10 m':>16}{'after':>8}{'over clean':>12}{'after':>8}")
    for kind in TRACKERS:
        for course, speed in COURSES:
            clean = None
            for name, fault in {"clean": CLEAN, **FAULTS}.items():
                tracker = tracker_of(kind, speed, RESPONSES["lag"][2])
                run = Drive(tracker, courses[course], speed, fault, RESPONSES["lag"])
                early, late = learn(run)
                clean = clean or (early, late)
                label = f"{kind}.{course}.{speed}.{name}"
                ratios = early / clean[0], late / clean[1]
                print(f"{label:36}{early:8.2f}{late:8.2f}{ratios[0]:12.2f}{ratios[1]:8.2f}", flush=True)
                figures[f"{label}.rms_mm"], figures[f"{label}.after_rms_mm"] = early, late
                if fault is not CLEAN:
                    figures[f"{label}.over_clean"], figures[f"{label}.after_over_clean"] = ratios
                    goals[f"{label}.over_clean"], goals[f"{label}.after_over_clean"] = ON_THE_WAY, AFTER
                if run.lost:
                    figures[f"{label}.lost"], goals[f"{label}.lost"] = 1, 0


def first_report(run: Drive) -> tuple[float, str]:
    """Return the distance at the first report (m), and its text; infinite and empty if there is none."""
    found: list[tuple[float, str]] = []

    def look(drive: Drive) -> None:
        estimator = drive.tracker.axle_errors
        text = "" if found else report(estimator, YARDSTICK.wheelbase).text
        if text:
            found.append((estimator.metres, text))

    learn(run, look)
    return found[0] if found else (math.inf, "")


def reports(figures: dict[str, float], goals: dict[str, float], seeds: int) -> None:
    """Measure the distance to the first report of every fault, and count reports of clean runs."""
    courses, wrong = built_in(), 0
    for course, speed in COURSES:
        for name in REPORTED:
            tracker = tracker_of("lqr", speed, RESPONSES["lag"][2])
            run = Drive(tracker, courses[course], speed, FAULTS[name], RESPONSES["lag"], noise=YAW_NOISE)
            metres, text = first_report(run)
            final = report(tracker.axle_errors, YARDSTICK.wheelbase).text
            print(f"{course} {speed} {name}: after {metres:.1f} m: {text}; in the end: {final}", flush=True)
            figures[f"{course}.{speed}.{name}.reported_m"] = metres if math.isfinite(metres) else 1000.0
            goals[f"{course}.{speed}.{name}.reported_m"] = LEARNING
    for seed in range(seeds):
        course, speed = COURSES[seed % len(COURSES)]
        tracker = tracker_of("lqr", speed, RESPONSES["lag"][2])
        run = Drive(tracker, courses[course], speed, CLEAN, RESPONSES["lag"], seed=seed, noise=YAW_NOISE)
        text = first_report(run)[1]
        wrong += bool(text)
        if text:
            print(f"clean {course} {speed}, seed {seed}: {text}", flush=True)
    print(f"{wrong} of {seeds} clean runs reported something")
    figures["clean_runs"], figures["clean_runs.reported"], goals["clean_runs.reported"] = seeds, wrong, 0


def latency(figures: dict[str, float], goals: dict[str, float]) -> None:
    """Compare a delay that must be learnt with one that is configured."""
    dead_time, lag, rate = LATE
    for course, speed in COURSES:
        known = tracker_of("lqr", speed, rate, dead_time=dead_time, lag=lag)
        unknown = tracker_of("lqr", speed, rate)
        points = built_in()[course]
        pairs = [learn(Drive(tracker, points, speed, CLEAN, LATE)) for tracker in (known, unknown)]
        label = f"latency.{course}.{speed}"
        for name, goal, with_it, without in zip(("over", "after_over"), (ON_THE_WAY, AFTER), *pairs, strict=True):
            figures[f"{label}.{name}_known"], goals[f"{label}.{name}_known"] = without / with_it, goal
        known_mm, learnt_mm = (f"{early:.1f} mm, then {late:.1f} mm" for early, late in pairs)
        print(f"{label}: configured {known_mm}; learnt {learnt_mm}")


def main() -> int:
    """Run the parts; 1: a goal is not met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, help="only this part")
    parser.add_argument("--seeds", type=int, default=50, help="clean runs of the part reports")
    options = parser.parse_args()
    figures: dict[str, float] = {}
    goals: dict[str, float] = {}
    for part in [options.part] if options.part else PARTS:
        if part == "errors":
            errors(figures, goals)
        elif part == "reports":
            reports(figures, goals, options.seeds)
        else:
            latency(figures, goals)
    missed = [name for name, goal in goals.items() if figures.get(name, math.inf) > goal]
    for name in missed:
        print(f"missed: {name} {figures[name]:.2f}, goal {goals[name]:g}")
    print(json.dumps({"bench": "steering_errors", "figures": figures, "goals": goals, "met": not missed}))
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
