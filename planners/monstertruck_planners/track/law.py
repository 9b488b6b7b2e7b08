"""What all trackers have in common: progress, cusps, speed, prediction over the dead time, limits.

A run ends for good: its successor, with the direction and the steering it asks for, begins when the truck has come to
rest at the end, and starts to roll when the wheels have turned. No bearing decides the direction, so nothing chatters.
"""

import math
from abc import ABC, abstractmethod
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.actuator import Angles, Axles, Pose
from monstertruck_planners.track.api import Command, TruckState
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.course import Course, Spot
from monstertruck_planners.track.line import MAX_RUNS, Foot, Line, Progress, Run
from monstertruck_planners.track.speed import Pace, wanted_speed
from monstertruck_schemas.plan import Steering
from monstertruck_schemas.reasons import Reason

Array = NDArray[np.float64]

C = TypeVar("C", bound=TrackerConfig)

REST: Final = 0.01
"""Speed of a truck at rest, m/s."""
STEEPEST: Final = 1.4
"""Angles are cut to this before their curvature is kept, rad."""
TURNED: Final = 0.03
"""Axles this near to what is asked count as turned, rad."""


class Here(NamedTuple):
    """Where the truck will be when what is asked now begins to act."""

    pose: Pose
    """x, y (m), yaw (rad)."""
    angles: Angles
    """Of the axles, rad."""
    speed: float
    """Forward, m/s; at least ``min_speed`` in size."""
    wanted: float
    """Speed that will be asked for, m/s."""
    acceleration: float
    """With which it is reached, m/s^2."""
    run: Run
    course: Course
    s: float
    """Metres from the run's beginning."""
    steering: Steering
    offset: float
    """Distance left of the reference, seen along ``reference.heading``, m."""
    reference: Spot
    turned: float
    """Yaw less the reference's, rad."""

    def speeds(self, times: Array) -> Array:
        """Forward speed after ``times`` seconds: gained, never lost, as braking depends on what lies ahead."""
        size, most = abs(self.speed), max(abs(self.wanted), abs(self.speed))
        return self.run.direction * np.minimum(size + self.acceleration * times, most)

    def ways(self, times: Array) -> Array:
        """Metres from the run's beginning after ``times`` seconds."""
        size, most = abs(self.speed), max(abs(self.wanted), abs(self.speed))
        gaining = np.minimum(times, (most - size) / self.acceleration)
        return self.s + size * times + self.acceleration * gaining * (times - 0.5 * gaining)


class Law(ABC, Generic[C]):
    """Base of the trackers: subclasses steer.

    Args:
        config: speeds, distances, the axles' behaviour.
        geometry: the truck's.
    """

    def __init__(self, config: C, geometry: FourWheelSteering) -> None:
        self.config = config
        self.geometry = geometry
        self.axles = Axles(config.dead_time, config.lag, config.steering_rate)
        self.period = 1.0 / config.rate
        self.lead = config.dead_time
        """Seconds ahead for which ``steer`` is asked."""
        self._courses: dict[int, tuple[Run, Course, Pace]] = {}

    def reset(self) -> None:
        """See ``Tracker``."""
        self.axles.reset()
        self._courses.clear()

    @abstractmethod
    def steer(self, here: Here) -> Angles:
        """Wanted angles of front and rear axle, rad, not yet limited."""

    def prepare(self, line: Line, progress: Progress) -> bool:
        """See ``Tracker``."""
        run = line.runs[progress.run]
        known = self._courses.get(id(run))
        if known is not None and known[0] is run:
            return False
        self.course(run)
        return True

    def control(self, state: TruckState, line: Line, progress: Progress, t: float) -> Command:
        """See ``Tracker``."""
        self.axles.advance(t)
        if not all(map(math.isfinite, (*state.pose, state.speed))):
            return Command(0.0, *self.axles.asked, progress, 0.0, 0.0, Reason.NOT_FINITE)
        config = self.config
        run, foot = line.runs[progress.run], self._foot(state, line.runs[progress.run], progress.s)
        ended = run.length - foot.s <= config.goal_tolerance
        last = progress.run + 1 == len(line.runs)
        if ended and not last and abs(state.speed) <= REST:
            progress = Progress(progress.run + 1)
            run = line.runs[progress.run]
            foot, ended = self._foot(state, run, 0.0), False
            last = progress.run + 1 == len(line.runs)
        here = self._here(state, run, foot.s)
        outcome = Reason.DRIVING
        if math.hypot(state.pose[0] - foot.point[0], state.pose[1] - foot.point[1]) > config.lost_distance:
            outcome = Reason.PATH_LOST
        elif ended and last:
            outcome = Reason.GOAL_REACHED
        angles = self.limited(here.steering, *self.steer(here))
        if ended and not last:
            angles = self.axles.asked  # coming to rest at a cusp
        speed = 0.0
        if outcome is Reason.DRIVING and not ended and not self._turning_at_rest(state, angles):
            speed = self.speed(here)
        self.axles.ask(t, angles)
        return self._command(state, run, foot, here, speed, angles, Progress(progress.run, foot.s), outcome)

    def speed(self, here: Here) -> float:
        """Speed to ask for, m/s."""
        return here.wanted

    def limited(self, steering: Steering, front: float, rear: float) -> Angles:
        """Angles within the limits of a way of steering."""
        angle = self.config.angle
        front, rear = min(max(front, -STEEPEST), STEEPEST), min(max(rear, -STEEPEST), STEEPEST)
        if steering == "crab":
            front = rear = min(max(0.5 * (front + rear), -angle), angle)
            return front, rear
        ahead, behind = (0.0 if steering == "rear" else angle), (0.0 if steering == "front" else angle)
        if ahead == 0.0:
            return 0.0, min(max(rear, -angle), angle)
        front, rear = self.geometry.limit_keeping_curvature(front, rear, ahead, behind)
        return float(front), float(rear)

    def course(self, run: Run) -> tuple[Course, Pace]:
        """Reference and greatest speeds of a run, computed once."""
        known = self._courses.get(id(run))
        if known is None or known[0] is not run:
            if len(self._courses) >= MAX_RUNS:
                self._courses.clear()
            course = Course(run, self.geometry, self.config.steering)
            known = self._courses[id(run)] = (run, course, Pace(self.config, course))
        return known[1:]

    def _foot(self, state: TruckState, run: Run, s: float) -> Foot:
        low = min(s, run.length)
        return run.project(state.pose[0], state.pose[1], low, min(low + self.config.reach, run.length))

    def _here(self, state: TruckState, run: Run, s: float) -> Here:
        course, pace = self.course(run)
        speed = state.speed if state.speed * run.direction > self.config.min_speed else 0.0
        pose, angles = state.pose, self.axles.angles
        if self.lead:
            pose, angles = self.axles.ahead(pose, speed, self.geometry, self.lead)
        foot = run.project(pose[0], pose[1], s, s + self.config.reach)
        reference = course.spot(foot.s)
        normal = reference.heading
        dx, dy = pose[0] - foot.point[0], pose[1] - foot.point[1]
        return Here(
            pose=pose,
            angles=angles,
            speed=speed or run.direction * self.config.min_speed,
            wanted=wanted_speed(self.config, state, run, pace, s),
            acceleration=self.config.acceleration,
            run=run,
            course=course,
            s=foot.s,
            steering=_freed(course, foot.s),
            offset=math.cos(normal) * dy - math.sin(normal) * dx,
            reference=reference,
            turned=wrap_angle(pose[2] - reference.yaw),
        )

    def _turning_at_rest(self, state: TruckState, angles: Angles) -> bool:
        """Whether the truck stands with its wheels still turning to where they are wanted."""
        if abs(state.speed) > REST:
            return False
        now = self.axles.angles
        return max(abs(angles[0] - now[0]), abs(angles[1] - now[1])) > TURNED

    def _command(
        self,
        state: TruckState,
        run: Run,
        foot: Foot,
        here: Here,
        speed: float,
        angles: Angles,
        progress: Progress,
        outcome: Reason,
    ) -> Command:
        dx, dy = state.pose[0] - foot.point[0], state.pose[1] - foot.point[1]
        return Command(
            speed=speed,
            front=angles[0],
            rear=angles[1],
            progress=progress,
            cross_track=math.cos(foot.tangent) * dy - math.sin(foot.tangent) * dx,
            heading_error=wrap_angle(state.pose[2] - here.course.spot(foot.s).yaw),
            outcome=outcome,
        )


def _freed(course: Course, s: float) -> Steering:
    """How the axles steer: where a path crabs its headings are meant, so they may differ to keep them."""
    steering = course.steering(s)
    return "hybrid" if steering == "crab" and course.given else steering
