"""Trackers on courses with the reference model: RMS and worst error, swept width; forward, backward, with cusps.

The plant is a kinematic bicycle about the rear axle, wheelbase 0.30 m, steering +-0.6 rad, 10 ms steps, requests at 10
Hz, started 5 cm to the left. "ideal" steers immediately; "lag" has 50 ms dead time, 0.10 s lag and 5 rad/s. The error
is the rear axle's distance from the course, without its first 5 %. Forward and backward the speed is constant; with
cusps it follows the tracker's request with at most 1 m/s^2.

A run has arrived if the tracker ended it and the rear axle came within ``ARRIVED`` of the course's end: at standstill
with cusps, in passing at constant speed (which the tracker cannot stop, so it reports ``goal_missed``).
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from pydantic import TypeAdapter
from scipy.spatial import cKDTree

from benchmarks.navigation_parts import Options, Part
from benchmarks.scoring import distance, rms
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.catalog import AnyTracker, build_tracker
from monstertruck_planners.track.path_tracker import PathTracker, TruckState
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.figures import new_figure, write_figure

YARDSTICK = FourWheelSteering(wheelbase=0.30, cg_split=1.0)
TRUCK = FourWheelSteering()
PERIOD, STEP = 0.1, 0.01
ADAPTER: TypeAdapter[AnyTracker] = TypeAdapter(AnyTracker)
PEERS = {
    ("arcs", 0.5, "ideal"): (2.6, 11.0),
    ("arcs", 0.5, "lag"): (2.2, 5.0),
    ("arcs", 1.0, "ideal"): (5.0, 13.0),
    ("arcs", 1.0, "lag"): (12.0, 29.0),
    ("figure_eight", 1.0, "lag"): (11.0, 28.0),
}
"""Best RMS and best worst error of PythonRobotics, mm."""
MUST_ARRIVE = {"pure_pursuit", "fuzzy", "lqr", "mpc"}
"""The published fuzzy rules are here for comparison only."""
ARRIVED = 0.05
"""Distance from the course's end, m: as far as every run begins from the course."""
ENDED = frozenset({Reason.GOAL_REACHED, Reason.GOAL_MISSED})
TAIL = 50
"""Steps before the end of a run at held speed in which it passes the course's end."""


@dataclass
class Plant:
    """The steered truck."""

    geometry: FourWheelSteering
    dead_time: float
    lag: float
    rate: float
    limit: float = 0.6
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed: float = 0.0
    front: float = 0.0
    rear: float = 0.0

    def __post_init__(self) -> None:
        self.queue = deque([(0.0, 0.0)] * round(self.dead_time / STEP))

    def step(self, front: float, rear: float) -> None:
        """Execute one step with these requests."""
        self.turn(front, rear)
        self.pose = self.geometry.integrate(
            self.pose, *self.geometry.body_twist(self.speed, self.front, self.rear), STEP
        )

    def turn(self, front: float, rear: float) -> None:
        """Turn the axles for one step with these requests."""
        self.queue.append((front, rear))
        front, rear = self.queue.popleft()
        self.front, self.rear = self._turn(self.front, front), self._turn(self.rear, rear)

    def _turn(self, now: float, wanted: float) -> float:
        wanted = min(max(wanted, -self.limit), self.limit)
        if self.lag == 0.0:
            return wanted
        return now + STEP * min(max((wanted - now) / self.lag, -self.rate), self.rate)


@dataclass(frozen=True)
class Result:
    """One run, errors in mm."""

    rms: float
    worst: float
    end: float
    """Distance from the course's end; infinite where the tracker did not end the run."""
    steps_ms: np.ndarray
    """Processor time of every step."""
    track: np.ndarray
    width: float = 0.0
    heading: float = 0.0
    """RMS of the angle between the truck and the course where it is nearest, rad."""
    effort: float = 0.0
    """What both axles turned in all, rad."""
    seconds: float = 0.0
    lost: bool = False
    untrue: bool = False
    """The tracker reported the goal as reached from further off than its tolerance."""

    @property
    def work_ms(self) -> float:
        """Median duration of a step."""
        return float(np.median(self.steps_ms))

    @property
    def longest_ms(self) -> float:
        """99th percentile of the duration of a step."""
        return float(np.quantile(self.steps_ms, 0.99))

    @property
    def arrived(self) -> bool:
        """Whether the end was reached."""
        return self.end <= 1000 * ARRIVED


KINDS = {
    "pure_pursuit": {"kind": "pure_pursuit", "lookahead": 0.6, "min_lookahead": 0.2, "lookahead_time": 0.4},
    "fuzzy_published": {"kind": "fuzzy", "rules": "published"},
    "fuzzy": {"kind": "fuzzy"},
    "lqr": {"kind": "lqr"},
    "mpc": {"kind": "mpc"},
}
"""Every kind with its defaults; pure pursuit looks ahead by its speed, as one distance cannot suit them all."""
RESPONSES = {
    "ideal": (0.0, 0.0, 50.0),
    "lag": (0.05, 0.10, 5.0),
    "dead_50": (0.05, 0.0, 50.0),
    "dead_150": (0.15, 0.0, 50.0),
    "lag_150": (0.0, 0.15, 5.0),
}
"""Dead time (s), lag (s) and greatest turning rate (rad/s) of the axles."""
SPEEDS, AXLES, VERSIONS = (0.2, 0.5, 1.0), ("ideal", "lag"), ("forward", "backward", "cusps")
TURNS = (0.0, 0.4, 0.25, 0.75, 0.6, 1.0)
"""Turning points of the version with cusps: shares of the course between which it goes forward and backward."""


def run(options: Options) -> Part:
    part = Part()
    courses = built_in() if options.data is None else from_data(options)
    table = {
        (course, speed, axles, version, name): drive(points, name, speed, axles, version)
        for course, points in courses.items()
        for speed in (SPEEDS[1:] if options.quick else SPEEDS)
        for axles in AXLES
        for version in VERSIONS
        for name in KINDS
    }
    report(part, table)
    four_wheels(part, courses["arcs"])
    draw(options, table, courses)
    return part


def from_data(options: Options) -> dict[str, np.ndarray]:
    files = sorted((options.data / "planning").glob("course_*.csv"))
    return {f.stem.removeprefix("course_"): np.genfromtxt(f, delimiter=",", skip_header=1)[:, :2] for f in files}


def built_in() -> dict[str, np.ndarray]:
    """Return courses for runs without data: arcs of 0.7 and 1.2 m with straights between, and a lemniscate."""
    pieces = ((1.0, 0.0), (1.1, 1 / 0.7), (0.8, 0.0), (1.9, -1 / 1.2), (0.4, 0.0), (2.0, -1 / 0.7), (1.0, 0.0))
    step = 0.025
    bends = np.concatenate([np.full(round(length / step), curvature) for length, curvature in pieces])
    yaw = np.concatenate(([0.0], np.cumsum(bends * step)))
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    arcs = np.cumsum(step * np.column_stack((np.cos(middle), np.sin(middle))), axis=0)
    t = np.linspace(0.2, math.tau, 5000)
    eight = 1.8 * np.column_stack((np.cos(t), np.sin(t) * np.cos(t))) / (1 + np.sin(t) ** 2)[:, None]
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(eight, axis=0).T))))
    even = np.arange(0.0, along[-1], step)
    return {"arcs": arcs, "eight": np.column_stack([np.interp(even, along, eight[:, k]) for k in (0, 1)])}


def route(points: np.ndarray, version: str, steering: str = "") -> Path:
    """Return the course as a path."""
    if version == "cusps":
        at = [round(share * (len(points) - 1)) for share in TURNS]
        index, directions = [at[0]], [1.0]
        for begin, end in pairwise(at):
            way = 1 if end > begin else -1
            index += range(begin + way, end + way, way)
            directions += [float(way)] * abs(end - begin)
        points = points[index]
    else:
        directions = [1.0 if version == "forward" else -1.0] * len(points)
    poses = np.column_stack((points, np.zeros(len(points))))
    ways = np.array(directions)
    return Path(stamp=0, received=0, seq=0, frame="odom", poses=poses.ravel(), directions=ways, name=version)


def drive(
    points: np.ndarray,
    name: str,
    speed: float,
    axles: str,
    version: str,
    geometry: FourWheelSteering = YARDSTICK,
    build: Callable[[AnyTracker, FourWheelSteering], PathTracker[Any]] = build_tracker,
    **more: object,
) -> Result:
    """Run the tracker made by ``build`` once, from 5 cm to the left of the start."""
    dead_time, lag, rate = RESPONSES[axles]
    config = ADAPTER.validate_python(
        {
            "rate": 1 / PERIOD,
            "speed": speed,
            "reverse_speed": speed,
            "min_speed": 0.05,
            "deceleration": 0.5,
            "acceleration": 1.0,
            "angle": 0.6,
            "steering": "front",
            "dead_time": dead_time,
            "lag": lag,
            "steering_rate": rate,
            **KINDS[name],
            **more,
        }
    )
    tracker = build(config, geometry)
    plant = Plant(geometry, dead_time, lag, rate, config.angle)
    yaw = math.atan2(*(points[1] - points[0])[::-1])
    x, y = points[0] + 0.05 * np.array([-math.sin(yaw), math.cos(yaw)])
    direction = -1 if version == "backward" else 1
    plant.pose = (float(x), float(y), yaw if direction > 0 else yaw + math.pi)
    path = SegmentedPath(route(points, version), plant.pose, config.beyond)
    progress, track, work, effort, outcome = path.start, [plant.pose], [], 0.0, Reason.DRIVING
    plant.speed = 0.0 if version == "cusps" else direction * speed
    tracker.prepare(path, progress)
    for k in range(round(5 * path.length / speed / PERIOD) + 200):
        begin = time.thread_time()
        command = tracker.control(TruckState(plant.pose, plant.speed), path, progress, k * PERIOD)
        work.append(time.thread_time() - begin)
        progress, outcome = command.progress, command.outcome
        if outcome is not Reason.DRIVING:
            break
        for _ in range(round(PERIOD / STEP)):
            if version == "cusps":
                plant.speed += min(max(command.speed - plant.speed, -STEP), STEP)
            front, rear = plant.front, plant.rear
            plant.step(command.front, command.rear)
            effort += abs(plant.front - front) + abs(plant.rear - rear)
            track.append(plant.pose)
    poses = np.array(track)
    met = poses[-1:, :2] if version == "cusps" else poses[-TAIL:, :2]
    end = float(distance(points[-1:], met)[0]) if len(met) > 1 else math.dist(points[-1], met[0])
    past = (poses[:, :2] - points[-1]) @ (points[-1] - points[-2]) > 0  # held speed runs over the end
    poses = poses[: len(poses) - int(np.argmin(past[::-1]))]
    error = 1000 * distance(poses[len(poses) // 20 :, :2], points)
    return Result(
        rms=float(np.sqrt(np.mean(error**2))),
        worst=float(error.max()),
        end=1000 * end if outcome in ENDED else math.inf,
        lost=outcome is Reason.PATH_LOST,
        untrue=outcome is Reason.GOAL_REACHED and end > config.goal_tolerance,
        steps_ms=1000 * np.array(work),
        track=poses,
        width=swept(poses[len(poses) // 20 :], points),
        heading=heading(poses[len(poses) // 20 :], points, backward=direction < 0),
        effort=effort,
        seconds=(len(track) - 1) * STEP,
    )


def heading(poses: np.ndarray, points: np.ndarray, *, backward: bool) -> float:
    """Return the RMS angle of the truck to the nearest piece of the course, rad."""
    middle, step = 0.5 * (points[1:] + points[:-1]), np.diff(points, axis=0)
    nearest = cKDTree(middle).query(poses[:, :2])[1]
    along = np.arctan2(step[nearest, 1], step[nearest, 0]) + (math.pi if backward else 0.0)
    return rms(np.remainder(poses[:, 2] - along + math.pi, math.tau) - math.pi)


def swept(poses: np.ndarray, points: np.ndarray) -> float:
    """Return twice the maximum distance of the footprint's corners from the course, m."""
    c, s = np.cos(poses[::5, 2]), np.sin(poses[::5, 2])
    corners = [
        poses[::5, :2] + np.column_stack((c * x - s * y, s * x + c * y)) for x in (-0.235, 0.235) for y in (-0.17, 0.17)
    ]
    inside = slice(len(corners[0]) // 20, -len(corners[0]) // 20)
    return 2 * float(max(distance(corner[inside], points).max() for corner in corners))


def report(part: Part, table: dict) -> None:
    print("RMS / worst error in mm, by tracker; x = did not arrive")
    print(f"{'':34}" + "".join(f"{name:>17}" for name in KINDS))
    columns = sorted({key[:4] for key in table}, key=lambda k: (k[0], k[1], k[2], VERSIONS.index(k[3])))
    best = {}
    for column in columns:
        row = {name: table[(*column, name)] for name in KINDS}
        cells = "".join(f"{'' if r.arrived else 'x'}{r.rms:8.1f}/{r.worst:6.1f}".rjust(17) for r in row.values())
        print(f"{column[0]:>14} {column[1]:4} {column[2]:>6} {column[3]:>8}{cells}")
        arrived = {name: r for name, r in row.items() if r.arrived}
        best[column] = min(arrived.values(), key=lambda r: r.rms) if arrived else None
    for name in KINDS:
        runs = [r for key, r in table.items() if key[4] == name]
        part.add(f"{name}.not_arrived", sum(not r.arrived for r in runs), 0 if name in MUST_ARRIVE else None)
        part.add(f"{name}.reported_reached_but_off", sum(r.untrue for r in runs), 0)
        part.add(f"{name}.off_the_end_max_mm", max(r.end for r in runs))
        part.add(f"{name}.step_ms", float(np.median([r.work_ms for r in runs])))
        part.add(f"{name}.step_p99_ms", max(r.longest_ms for r in runs))
        off, step, slow = (part.figures[f"{name}.{key}"] for key in ("off_the_end_max_mm", "step_ms", "step_p99_ms"))
        print(f"{name}: at most {off:.0f} mm off the end; step {step:.2f} ms, p99 {slow:.2f} ms")
    for (course, speed, axles, version), found in best.items():
        if found is None:
            part.add(f"{course}.{speed}.{axles}.{version}.arrived", 1, 0)
            continue
        label = f"{course}.{speed}.{axles}"
        if version == "forward":
            rms, worst = PEERS.get((course, speed, axles), (None, None))
            part.add(f"{label}.rms_mm", found.rms, rms)
            part.add(f"{label}.worst_mm", found.worst, worst)
            continue
        forward = best[course, speed, axles, "forward"]
        if forward is not None:
            part.add(f"{label}.{version}_rms_mm", found.rms)
            part.add(f"{label}.{version}_over_forward", found.rms / forward.rms, 1.5)


def four_wheels(part: Part, arcs: np.ndarray) -> None:
    """Drive the truck at 0.2 m/s on the arcs, widened so that it can turn them with two wheels."""
    wide = 1.4 * arcs
    print("the truck, four wheels against two: RMS / worst mm, swept width m")
    for name in ("lqr", "mpc"):
        for steering in ("front", "counter", "hybrid"):
            found = drive(wide, name, 0.2, "lag", "forward", TRUCK, steering=steering, angle=0.4)
            print(f"  {name:6}{steering:9}{found.rms:6.1f}/{found.worst:6.1f}  {found.width:.3f}")
            part.add(f"truck.{name}.{steering}.rms_mm", found.rms)
            part.add(f"truck.{name}.{steering}.swept_m", found.width)
        for figure in ("rms_mm", "swept_m"):
            front = part.figures[f"truck.{name}.front.{figure}"]
            part.add(f"truck.{name}.4ws_over_2ws.{figure}", part.figures[f"truck.{name}.hybrid.{figure}"] / front, 1.0)


def draw(options: Options, table: dict, courses: dict) -> None:
    figure = new_figure(18, 6 * len(courses))
    axes = figure.subplots(len(courses), 3, squeeze=False)
    for row, (course, points) in zip(axes, courses.items(), strict=True):
        for axis, version in zip(row, VERSIONS, strict=True):
            axis.plot(*points.T, color="0.7", linewidth=5)
            for name in KINDS:
                found = table[course, 1.0, "lag", version, name]
                axis.plot(*found.track[:, :2].T, linewidth=1, label=f"{name} {found.rms:.1f} mm")
            axis.set_title(f"{course}, 1.0 m/s, lag, {version}")
            axis.set_aspect("equal")
            axis.legend(fontsize=7)
    write_figure(figure, options.out / "tracking.png")
