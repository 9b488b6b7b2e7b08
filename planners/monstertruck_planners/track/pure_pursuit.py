"""Pure pursuit for a truck with two steered axles: drive the arc that passes through a point ahead on the path."""

import math
from dataclasses import dataclass
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.line import Foot, Line, Progress, Run
from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason

Positive = Annotated[float, Field(gt=0)]

STEERING_MODES: Final = {"front": (0.1, 0.0), "counter": (0.1, -0.1), "crab": (0.1, 0.1)}
"""An example of each way of steering: front and rear axle angle, rad."""


class PurePursuitConfig(Schema):
    """Pure pursuit and the tracker around it."""

    kind: Literal["pure_pursuit"] = "pure_pursuit"
    rate: Annotated[float, Field(gt=0, le=100)] = 20.0
    """Requests per second."""
    lease: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Lease of each request, s."""
    steering: Literal["front", "counter", "crab"] = "counter"
    """Steered axles: the front one alone, or both by opposite or (keeping the heading) equal angles."""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.4
    """Greatest axle angle, rad."""
    speed: Positive = 0.18
    """Forward, m/s."""
    reverse_speed: Positive = 0.12
    """Backward, m/s."""
    min_speed: Positive = 0.03
    """Slowest speed before a stop, m/s."""
    lookahead: Positive = 0.4
    """Distance along the path to the point driven at, m."""
    deceleration: Positive = 0.1
    """Deceleration towards the end of the path and where the direction changes, m/s^2."""
    goal_tolerance: Positive = 0.02
    """A run has ended when this much of it is left, m."""
    lost_distance: Positive = 0.5
    """Further away than this from the path the tracker gives up, m."""
    slow_clearance: Positive = 0.12
    """Clearance along the next metres below which the speed falls in proportion, m."""

    @model_validator(mode="after")
    def _ordered(self) -> "PurePursuitConfig":
        if self.min_speed > min(self.speed, self.reverse_speed):
            msg = f"min_speed {self.min_speed} m/s: expected at most speed and reverse_speed"
            raise ValueError(msg)
        if self.goal_tolerance >= self.lookahead:
            msg = f"goal_tolerance {self.goal_tolerance} m: expected less than lookahead, {self.lookahead} m"
            raise ValueError(msg)
        return self


@dataclass(frozen=True, slots=True)
class TruckState:
    """What the tracker knows of the truck."""

    pose: tuple[float, float, float]
    """x, y (m), yaw (rad) in the path's frame."""
    speed: float
    """Forward speed, m/s."""
    clearance: float = math.inf
    """Room around the footprint along the next part of the path, m."""


@dataclass(frozen=True, slots=True)
class Command:
    """What to do now, and how the tracking goes."""

    speed: float
    """Of the base point along its direction of travel, m/s; negative backwards."""
    front: float
    rear: float
    progress: Progress
    cross_track: float
    """Distance of the base point from the path, m; positive left of it, seen in the direction of travel."""
    heading_error: float
    """Yaw less the path's, rad."""
    outcome: Reason
    """DRIVING, GOAL_REACHED or PATH_LOST."""


class PurePursuit:
    """The control law, without memory: progress goes in and comes out.

    Args:
        config: speeds and distances.
        steering: the truck's geometry.
    """

    def __init__(self, config: PurePursuitConfig, steering: FourWheelSteering) -> None:
        self._config = config
        self._steering = steering

    def control(self, state: TruckState, line: Line, progress: Progress) -> Command:
        """One control step.

        Args:
            state: the truck now.
            line: the path.
            progress: place reached at the step before, ``line.start`` at first.
        """
        config = self._config
        run, foot = line.runs[progress.run], self._foot(state, line.runs[progress.run], progress.s)
        ended = run.length - foot.s <= config.goal_tolerance
        if ended and progress.run + 1 < len(line.runs):
            progress = Progress(progress.run + 1)
            run = line.runs[progress.run]
            foot, ended = self._foot(state, run, 0.0), False
        progress = Progress(progress.run, foot.s)
        x, y, yaw = state.pose
        dx, dy = x - foot.point[0], y - foot.point[1]
        heading = foot.tangent if run.direction > 0 else foot.tangent + math.pi
        front, rear = self._steer(state.pose, run, foot.s)
        outcome = Reason.DRIVING
        if math.hypot(dx, dy) > config.lost_distance:
            outcome = Reason.PATH_LOST
        elif ended:
            outcome = Reason.GOAL_REACHED
        return Command(
            speed=self._speed(state, run, foot) if outcome is Reason.DRIVING else 0.0,
            front=front,
            rear=rear,
            progress=progress,
            cross_track=math.cos(foot.tangent) * dy - math.sin(foot.tangent) * dx,
            heading_error=wrap_angle(yaw - heading),
            outcome=outcome,
        )

    def _foot(self, state: TruckState, run: Run, s: float) -> Foot:
        low = min(s, run.length)
        return run.project(state.pose[0], state.pose[1], low, min(low + self._config.lookahead, run.length))

    def _speed(self, state: TruckState, run: Run, foot: Foot) -> float:
        config = self._config
        if state.speed * run.direction < -config.min_speed:
            return 0.0  # still rolling the other way
        left = max(run.length - foot.s - config.goal_tolerance, 0.0)
        speed = config.speed if run.direction > 0 else config.reverse_speed
        speed *= min(max(state.clearance, 0.0) / config.slow_clearance, 1.0)
        return run.direction * max(min(speed, math.sqrt(2 * config.deceleration * left)), config.min_speed)

    def _steer(self, pose: tuple[float, float, float], run: Run, s: float) -> tuple[float, float]:
        """Axle angles of the arc from the truck through the point ``lookahead`` metres further on."""
        goal = run.at(s + self._config.lookahead)
        x, y, yaw = pose
        c, sn = math.cos(yaw), math.sin(yaw)
        dx, dy = goal.point[0] - x, goal.point[1] - y
        ahead, aside = c * dx + sn * dy, c * dy - sn * dx
        if self._config.steering == "crab":
            bearing = math.atan2(run.direction * aside, run.direction * ahead)
            angle = min(max(bearing, -self._config.angle), self._config.angle)
            return angle, angle
        arm = self._steering.l_r
        if self._config.steering == "counter":
            # The turning centre lies beside the base point: the arc is tangent to the truck there.
            turn = 2 * aside / max(ahead**2 + aside**2, 1e-6)
            slip = 0.0
        elif run.direction > 0:
            # The turning centre lies beside the rear axle; still it is the base point that has to meet the goal.
            turn = 2 * aside / max(ahead**2 + aside**2 + 2 * arm * ahead, 1e-6)
            slip = arm
        else:
            # Backwards the rear axle leads, and only its own arc is stable: it has to meet its own goal.
            tangent = goal.tangent - yaw
            ahead, aside = ahead + arm * math.cos(tangent) + arm, aside + arm * math.sin(tangent)
            turn = 2 * aside / max(ahead**2 + aside**2, 1e-6)
            slip = arm
        _, front, rear = self._steering.steer_for_twist(1.0, slip * turn, turn)
        rear_limit = self._config.angle if self._config.steering == "counter" else 0.0
        return self._steering.limit_keeping_curvature(front, rear, self._config.angle, rear_limit)
