"""Base of all trackers: progress, cusps, speed, prediction over the dead time, limits.

Dead time and lag are the configured ones until the truck's turns contradict them; without configured values they are
estimated (``response``).

A run that has ended never resumes. Its successor, with a separate direction and steering mode, begins once the truck is
at rest at the end, and rolls once the wheels have turned. No bearing decides the direction, so the direction cannot
chatter. The tracker judges each end by the pose at rest: a cusp by the clearance there, the path end by the tolerances.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.chassis import Freedom
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.axle_errors import AxleErrorEstimator, AxleErrors, AxleMotion
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.response import Response, ResponseEstimator, choose, rounded
from monstertruck_planners.track.segments import (
    PathProgress,
    PathRun,
    Projection,
    ReferenceState,
    RunStates,
    SegmentedPath,
)
from monstertruck_schemas.plan import MAX_RUNS, Steering
from monstertruck_schemas.reasons import Reason

Angles = tuple[float, float]

EXACT: Final = AxleErrors()
"""Errors of perfectly calibrated axles."""
FORGET: Final = 1.0
"""Maximum pause before the axle state is unknown (s); older requests no longer act."""


class AxleModel:
    """Model of both axle angles, driven by the requests: servos report their commands, not their positions.

    Args:
        dead_time: dead time (s).
        lag: time constant (s); 0 for none.
        rate: maximum turning rate (rad/s).
    """

    def __init__(self, dead_time: float, lag: float, rate: float) -> None:
        self.dead_time = dead_time
        self.lag = lag
        self.rate = rate
        self.reset()

    def reset(self) -> None:
        """Forget all requests."""
        self.angles: Angles = (0.0, 0.0)
        self.requested: Angles = (0.0, 0.0)
        """Axle angles of the latest request."""
        self.swept: Angles = (0.0, 0.0)
        """Time integrals of the angles since the start (rad s)."""
        self._due: deque[tuple[float, Angles]] = deque()
        self._requests: deque[tuple[float, Angles]] = deque()
        """Requests of the last second."""
        self._target: Angles = (0.0, 0.0)
        self._t: float | None = None

    def request(self, t: float, angles: Angles) -> None:
        """Record a request made at ``t``."""
        self.requested = angles
        self._due.append((t + self.dead_time, angles))
        self._requests.append((t, angles))
        while self._requests[0][0] < t - FORGET:
            self._requests.popleft()

    def respond(self, response: Response) -> None:
        """Change dead time and lag, including for the requests of the last second."""
        self.dead_time, self.lag = response
        if self._t is None or not self._requests:
            return
        now, requests = self._t, list(self._requests)
        self.reset()
        first = requests[0]
        self.angles = self._target = self.requested = first[1]
        self._t = first[0]
        for t, angles in requests:
            self.advance(t)
            self.request(t, angles)
        self.advance(now)

    def advance(self, t: float) -> None:
        """Advance the angles to time ``t``."""
        if self._t is None or not 0.0 <= t - self._t <= FORGET:
            asked = self.requested
            self.reset()
            self.angles = self._target = self.requested = asked
            self._t = t
            return
        for _, until, target in self._pieces(self._t, t):
            middle, end = (self._turned(self.angles, target, share * until) for share in (0.5, 1.0))
            f, r = (until / 6 * (a + 4 * b + c) for a, b, c in zip(self.angles, middle, end, strict=True))
            self.swept = self.swept[0] + f, self.swept[1] + r
            self.angles, self._target = end, target
        while self._due and self._due[0][0] <= t:
            self._target = self._due.popleft()[1]
        self._t = t

    def ahead(
        self,
        pose: Pose2,
        speed: float,
        geometry: FourWheelSteering,
        seconds: float,
        errors: AxleErrors = EXACT,
    ) -> tuple[Pose2, Angles]:
        """Predict pose and angles after ``seconds`` at constant speed without further requests.

        Args:
            pose: current pose (m, rad).
            speed: speed (m/s).
            geometry: geometry of the truck.
            seconds: prediction time (s).
            errors: axle errors.
        """
        grip = speed * speed / geometry.wheelbase
        angles = self.angles
        begin = self._t or 0.0
        for _, duration, target in self._pieces(begin, begin + seconds):
            count = max(math.ceil(duration / 0.05), 1)  # maximum time step of the prediction, s
            for _ in range(count):
                middle = self._turned(angles, target, 0.5 * duration / count)
                pose = geometry.integrate(
                    pose, *geometry.body_twist(speed, *errors.wheels(middle, grip)), duration / count
                )
                angles = self._turned(angles, target, duration / count)
        return pose, angles

    def _pieces(self, begin: float, end: float) -> list[tuple[float, float, Angles]]:
        """Return the intervals with a single target: start, duration, target."""
        pieces = []
        target, at = self._target, begin
        for due, angles in self._due:
            if due >= end:
                break
            if due > at:
                pieces.append((at, due - at, target))
                at = due
            target = angles
        if end > at:
            pieces.append((at, end - at, target))
        return pieces

    def _turned(self, angles: Angles, target: Angles, dt: float) -> Angles:
        return self._one(angles[0], target[0], dt), self._one(angles[1], target[1], dt)

    def _one(self, angle: float, target: float, dt: float) -> float:
        """Return the exact response of a first-order lag with limited rate."""
        gap = target - angle
        linear = self.rate * self.lag
        if abs(gap) > linear:
            # At full rate until the lag alone would be slower.
            ramp = min(dt, (abs(gap) - linear) / self.rate)
            angle += math.copysign(self.rate * ramp, gap)
            gap, dt = target - angle, dt - ramp
        if dt <= 0.0:
            return angle
        return target if self.lag == 0.0 else target - gap * math.exp(-dt / self.lag)


class TruckState(NamedTuple):
    """State of the truck as known to a tracker."""

    pose: tuple[float, float, float]
    """Pose in the path's frame: x, y (m), yaw (rad)."""
    speed: float
    """Forward speed (m/s)."""
    clearance: float = math.inf
    """Clearance around the footprint along the next part of the path (m)."""
    tilt: float = 0.0
    """Angle between the truck's z axis and the vertical (rad)."""
    roughness: float = 0.0
    """Standard deviation of the tilt over the last seconds (rad)."""
    obeyed: bool = True
    """Whether the axles follow the tracker's requests."""
    heading: tuple[float, float] | None = None
    """Stamp (s) and yaw (rad, in any frame) of a measurement that is independent of the requests; None without a
    compass: then the yaw of the pose shows the truck's turn.
    """
    located: bool = True
    """Whether the pose is measured, not computed from the requests."""


@dataclass(slots=True)
class Command:
    """Command of one control step, and the state of the tracking."""

    speed: float
    """Speed of the base point in its direction of travel (m/s); negative backward."""
    front: float
    rear: float
    progress: PathProgress
    cross_track: float
    """Distance of the base point from the path (m), positive to the left in the direction of travel."""
    heading_error: float
    """Yaw relative to the path (rad)."""
    outcome: Reason
    """DRIVING, GOAL_REACHED, GOAL_MISSED, CUSP_MISSED, PATH_LOST, NOT_FINITE, or STUCK from the service."""


class SpeedProfile:
    """Speed profile of a run that respects curvature and path speeds ahead and lets the axles keep up.

    Args:
        config: accelerations, and the distance within which the axles can turn.
        run: part of a path, with its speeds.
        reference: reference states of the run.
    """

    def __init__(self, config: TrackerConfig, run: PathRun, reference: RunStates) -> None:
        s = reference.places
        least_curvature = 1e-6  # lower bound of curvatures (1/m) and turns (rad)
        allowed = config.lateral_acceleration / np.maximum(np.abs(reference.at(s).curvature), least_curvature)
        change = np.maximum(reference.axle_change(config.steering_distance), least_curvature)
        turning = config.steering_distance * config.steering_rate / change
        gained = 2 * config.deceleration * s
        limits = np.minimum(np.minimum(allowed, turning**2), run.speeds(s) ** 2)
        least = np.minimum.accumulate((limits + gained)[::-1])[::-1]
        self._rows = np.column_stack((s, np.maximum(least - gained, 0.0)))

    def at(self, s: float) -> float:
        """Return the maximum speed at ``s`` m (m/s)."""
        last = len(self._rows) - 1
        i = min(max(int(self._rows[:, 0].searchsorted(s, "right")) - 1, 0), last - 1)
        (begin, here), (end, there) = self._rows[i : i + 2].tolist()
        share = min(max((s - begin) / (end - begin), 0.0), 1.0)
        return math.sqrt(here + share * (there - here))


def target_speed(
    config: TrackerConfig, truck: TruckState, run: PathRun, profile: SpeedProfile, s: float, dead_time: float
) -> float:
    """Return the speed along the run (m/s) at ``s`` m that takes effect after ``dead_time`` s; signed by direction."""
    if truck.speed * run.direction < -config.min_speed:
        return 0.0  # still rolling in the opposite direction
    speed = config.speed if run.direction > 0 else config.reverse_speed
    speed *= min(max(truck.clearance, 0.0) / config.slow_clearance, 1.0)
    speed *= speed_share(truck.tilt, config.slow_tilt) * speed_share(truck.roughness, config.slow_roughness)
    left = run.length - s - abs(truck.speed) * dead_time
    speed = min(speed, math.sqrt(2 * config.deceleration * max(left, 0.0)), profile.at(s))
    return run.direction * max(speed, config.min_speed)


def speed_share(amount: float, limit: float) -> float:
    """Return the speed factor: 1 up to the limit, falling to 0 at twice the limit; 0 for NaN."""
    return min(max(2.0 - amount / limit, 0.0), 1.0) if math.isfinite(amount) else 0.0


C = TypeVar("C", bound=TrackerConfig)

REST: Final = 0.01
"""Maximum speed of a truck at rest (m/s)."""
STEEPEST: Final = 1.4
"""Clipping limit of the angles before their curvature is kept (rad)."""


class TrackingState(NamedTuple):
    """Predicted state when a request made at this step takes effect, and the reference there."""

    pose: Pose2
    """x, y (m), yaw (rad)."""
    angles: Angles
    """Effective axle angles, as seen by the steering mode (rad)."""
    requested: Angles
    """Axle angles of the latest request, as seen by the steering mode (rad)."""
    speed: float
    """Forward speed (m/s); magnitude at least ``min_speed``."""
    target_speed: float
    """Speed to be requested (m/s)."""
    acceleration: float
    """Acceleration towards ``target_speed`` (m/s^2)."""
    run: PathRun
    reference: RunStates
    """Reference states along the run."""
    s: float
    """Distance from the start of the run (m)."""
    steering: Steering
    lateral_error: float
    """Distance to the left of the reference, seen along ``target.heading`` (m)."""
    target: ReferenceState
    """The reference at ``s``."""
    heading_error: float
    """Yaw minus the reference yaw and the sideslip of axles out of trim (rad)."""

    def speeds(self, times: Array) -> Array:
        """Return the forward speed after ``times`` s: it never decreases, as braking depends on the path ahead."""
        size, most = abs(self.speed), max(abs(self.target_speed), abs(self.speed))
        return self.run.direction * np.minimum(size + self.acceleration * times, most)

    def distances(self, times: Array) -> Array:
        """Return the distance from the start of the run after ``times`` s (m)."""
        size, most = abs(self.speed), max(abs(self.target_speed), abs(self.speed))
        gaining = np.minimum(times, (most - size) / self.acceleration)
        return self.s + size * times + self.acceleration * gaining * (times - 0.5 * gaining)


def as_steered(steering: Steering, angles: Angles) -> Angles:
    """Return the angles of a steering mode that turn the truck as these do (crab: move it sideways) (rad)."""
    front, rear = angles
    match steering:
        case "front":
            return front - rear, 0.0
        case "rear":
            return 0.0, rear - front
        case "counter":
            return 0.5 * (front - rear), 0.5 * (rear - front)
        case "crab":
            return 0.5 * (front + rear), 0.5 * (front + rear)
    return angles


class PathTracker(ABC, Generic[C]):
    """Tracker of segmented paths; subclasses steer. It keeps only past requests, to predict the axles.

    Args:
        config: speeds, distances, axle behaviour.
        geometry: geometry of the truck.
    """

    def __init__(self, config: C, geometry: FourWheelSteering) -> None:
        self.config = config
        self.geometry = geometry
        self.configured: Response | None = None
        """Configured dead time and lag."""
        if config.dead_time is not None or config.lag is not None:
            self.configured = Response(config.dead_time or 0.0, config.lag or 0.0)
        self.estimator = ResponseEstimator(geometry, config.steering_rate)
        self.response = self.configured or rounded(self.estimator.estimate)
        """Dead time and lag in use."""
        self.axles = AxleModel(*self.response, config.steering_rate)
        """Axle model in requested angles."""
        self.axle_errors = AxleErrorEstimator(geometry)
        self.period = 1.0 / config.rate
        self._stop = min(config.min_speed**2 / (2 * config.deceleration), config.goal_tolerance)
        """Stopping distance before the end, at minimum speed (m)."""
        self._prepared: dict[int, tuple[PathRun, RunStates, SpeedProfile]] = {}

    def reset(self) -> None:
        """Forget requests that were not obeyed."""
        self.axles.reset()
        self.axle_errors.restart()
        self.estimator.forget_requests()
        self._prepared.clear()

    def limit_learning(self, freedom: Freedom | None) -> None:
        """Restrict learning to the errors that a body with this freedom can have; None for unsteered axles."""
        self.axle_errors = AxleErrorEstimator(self.geometry, freedom)

    @property
    def prediction(self) -> float:
        """Prediction time of ``steer`` (s)."""
        return self.response.dead_time

    @property
    def contradicted(self) -> bool:
        """Whether the truck's response contradicts the configured one, so that the estimate is used."""
        return self.configured is not None and self.response != self.configured

    def respond(self, response: Response) -> None:
        """Use another dead time and lag from now on."""
        self.response = response
        self.axles.respond(response)
        self.axle_errors.restart()

    @abstractmethod
    def steer(self, state: TrackingState) -> Angles:
        """Return the wanted angles of front and rear axle (rad), without limits."""

    def prepare(self, path: SegmentedPath, progress: PathProgress) -> bool:
        """Prepare the path's current run for ``control`` once; return whether this was necessary."""
        run = path.runs[progress.run]
        known = self._prepared.get(id(run))
        if known is not None and known[0] is run:
            return False
        self._prepare(run)
        return True

    def control(self, truck: TruckState, path: SegmentedPath, progress: PathProgress, t: float) -> Command:
        """Compute one control step.

        Args:
            truck: state of the truck at ``t``.
            path: path to follow.
            progress: place reached in the previous step, initially ``path.start``.
            t: increasing time (s).
        """
        self.axles.advance(t)
        if not all(map(math.isfinite, (*truck.pose, truck.speed))):
            return Command(0.0, *self.axles.requested, progress, 0.0, 0.0, Reason.NOT_FINITE)
        config = self.config
        self._observe(truck, t)
        run = path.runs[progress.run]
        nearest = self._project(truck, run, progress.s)
        ended = self._ended(run, nearest)
        last = progress.run + 1 == len(path.runs)
        judged = progress.outcome
        if ended and judged is Reason.DRIVING:
            judged = self._judge(truck, run, last=last)
        if judged is Reason.OK:
            progress, judged = PathProgress(progress.run + 1), Reason.DRIVING
            run = path.runs[progress.run]
            nearest, ended = self._project(truck, run, 0.0), False
            last = progress.run + 1 == len(path.runs)
        state = self._predict(truck, run, nearest.s)
        outcome = judged
        if math.hypot(truck.pose[0] - nearest.point[0], truck.pose[1] - nearest.point[1]) > config.lost_distance:
            outcome = Reason.PATH_LOST
        wanted = self.limited(state.steering, *self.steer(state))
        angles = self._request(state.steering, wanted, truck.speed)
        if ended and not last:
            angles = self.axles.requested  # coming to rest at a cusp
        speed = 0.0
        if outcome is Reason.DRIVING and not ended and not self._turning_at_rest(truck, angles):
            speed = self.speed(state)
        self.axles.request(t, angles)
        self.estimator.request(t, angles)
        dx, dy = truck.pose[0] - nearest.point[0], truck.pose[1] - nearest.point[1]
        return Command(
            speed=speed,
            front=angles[0],
            rear=angles[1],
            progress=PathProgress(progress.run, nearest.s, judged),
            cross_track=math.cos(nearest.tangent) * dy - math.sin(nearest.tangent) * dx,
            heading_error=wrap_angle(truck.pose[2] - state.reference.state(nearest.s).yaw),
            outcome=outcome,
        )

    def _ended(self, run: PathRun, nearest: Projection) -> bool:
        """Whether the truck is close enough to the end of the run to stop."""
        return run.length - nearest.s <= self._stop

    def _judge(self, truck: TruckState, run: PathRun, *, last: bool) -> Reason:
        """Judge how a stopping truck met the end of a run: OK at a cusp within tolerance, DRIVING while it rolls."""
        config, end = self.config, run.at(run.length)
        dx, dy = truck.pose[0] - end.point[0], truck.pose[1] - end.point[1]
        past = math.cos(end.tangent) * dx + math.sin(end.tangent) * dy
        if abs(truck.speed) > REST and past <= config.goal_tolerance:
            return Reason.DRIVING
        away = math.hypot(dx, dy)
        reference = self._prepare(run)[0]
        turned = abs(wrap_angle(truck.pose[2] - reference.state(run.length).yaw))
        if not reference.has_yaw(run.length):
            turned = 0.0
        if last:
            reached = away <= config.goal_tolerance and turned <= config.goal_yaw_tolerance
            return Reason.GOAL_REACHED if reached else Reason.GOAL_MISSED
        # 0.5: usable share of the clearance at a cusp; the rest is for the motion after it. 0.01: minimum tolerance at
        # a cusp, m
        tolerance = max(0.5 * run.clearance, 0.01)
        # A corner moves by about one wheelbase per radian.
        off = away + self.geometry.wheelbase * turned
        return Reason.OK if off <= tolerance else Reason.CUSP_MISSED

    def speed(self, state: TrackingState) -> float:
        """Return the speed to request (m/s)."""
        return state.target_speed

    def limited(self, steering: Steering, front: float, rear: float) -> Angles:
        """Return the angles clipped to the limits of a steering mode."""
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

    def _request(self, steering: Steering, wheels: Angles, speed: float) -> Angles:
        """Return the request that turns the truck like these effective angles; an unsteered axle stays."""
        errors, grip, most = self.axle_errors.errors, speed * speed / self.geometry.wheelbase, self.config.angle
        front, rear = errors.requests(wheels, grip)
        turn = wheels[0] - wheels[1]
        if steering == "front":
            fixed = errors.wheels((front, 0.0), grip)[1]
            front, rear = errors.requests((turn + fixed, fixed), grip)[0], 0.0
        elif steering == "rear":
            fixed = errors.wheels((0.0, rear), grip)[0]
            front, rear = 0.0, errors.requests((fixed, fixed - turn), grip)[1]
        return min(max(front, -most), most), min(max(rear, -most), most)

    def _observe(self, truck: TruckState, t: float) -> None:
        """Learn the axles' response and errors from the truck's motion."""
        if not truck.obeyed:
            self.estimator.forget_requests()
            self.axle_errors.restart()
            return
        axles = self.axles
        motion = AxleMotion(t, axles.swept, axles.angles, truck.pose, truck.speed, truck.heading, truck.located)
        self.axle_errors.observe(motion, self.estimator.estimate.deviation)
        measured = truck.heading is not None
        at, yaw = truck.heading or (t, truck.pose[2])
        if self.estimator.observe(at, yaw, truck.speed, measured=measured):
            response = choose(self.response, self.configured, self.estimator.estimate)
            if response is not self.response:
                self.respond(response)

    def _prepare(self, run: PathRun) -> tuple[RunStates, SpeedProfile]:
        """Return reference and maximum speeds of a run, computed once."""
        known = self._prepared.get(id(run))
        if known is None or known[0] is not run:
            if len(self._prepared) >= MAX_RUNS:
                self._prepared.clear()
            reference = RunStates(run, self.geometry, self.config.steering)
            known = self._prepared[id(run)] = (run, reference, SpeedProfile(self.config, run, reference))
        return known[1:]

    def _project(self, truck: TruckState, run: PathRun, s: float) -> Projection:
        low = min(s, run.length)
        return run.project(truck.pose[0], truck.pose[1], low, min(low + self.config.reach, run.length))

    def _predict(self, truck: TruckState, run: PathRun, s: float) -> TrackingState:
        reference, profile = self._prepare(run)
        speed = truck.speed if truck.speed * run.direction > self.config.min_speed else 0.0
        pose, angles = truck.pose, self.axles.angles
        errors, grip = self.axle_errors.errors, speed * speed / self.geometry.wheelbase
        if self.prediction:
            pose, angles = self.axles.ahead(pose, speed, self.geometry, self.prediction, errors)
        nearest = run.project(pose[0], pose[1], s, s + self.config.reach)
        target, steering = reference.state(nearest.s), reference.steering(nearest.s)
        dx, dy = pose[0] - nearest.point[0], pose[1] - nearest.point[1]
        wheels = errors.wheels(self.axles.requested, grip)
        return TrackingState(
            pose=pose,
            angles=as_steered(steering, errors.wheels(angles, grip)),
            requested=as_steered(steering, wheels),
            speed=speed or run.direction * self.config.min_speed,
            target_speed=target_speed(self.config, truck, run, profile, s, self.response.dead_time),
            acceleration=self.config.acceleration,
            run=run,
            reference=reference,
            s=nearest.s,
            steering=steering,
            lateral_error=math.cos(target.heading) * dy - math.sin(target.heading) * dx,
            target=target,
            heading_error=wrap_angle(pose[2] - target.yaw + self._slip_besides(steering, wheels)),
        )

    def _slip_besides(self, steering: Steering, angles: Angles) -> float:
        """Return the sideslip of axle angles beyond the steering mode's sideslip (rad)."""
        front, rear = as_steered(steering, angles)
        return float(self.geometry.tan_sideslip(angles[0] - front, angles[1] - rear))

    def _turning_at_rest(self, truck: TruckState, angles: Angles) -> bool:
        """Whether the truck is at rest while its wheels still turn to the wanted angles."""
        if abs(truck.speed) > REST:
            return False
        now = self.axles.angles
        # 0.03: maximum difference between turned axles and their request, rad
        return max(abs(angles[0] - now[0]), abs(angles[1] - now[1])) > 0.03
