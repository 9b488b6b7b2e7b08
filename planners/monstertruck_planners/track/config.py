"""Settings of the trackers: what all share, and one model per ``kind``.

Light on purpose: reading a configuration loads no tracker. ``catalog`` names the class behind each kind.
"""

import math
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Positive, Schema
from monstertruck_schemas.plan import Steering

STEERING_MODES: Final[dict[Steering, tuple[float, float]]] = {
    "front": (0.1, 0.0),
    "rear": (0.0, 0.1),
    "counter": (0.1, -0.1),
    "crab": (0.1, 0.1),
    "hybrid": (0.1, 0.05),
}
"""An example of each way of steering: front and rear axle angle, rad."""


class TrackerConfig(Schema):
    """What every tracker knows."""

    rate: Annotated[float, Field(gt=0, le=100)] = 20.0
    """Requests per second."""
    lease: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Lease of each request, s."""
    steering: Steering = "counter"
    """Steered axles where the path does not say: one alone; both by opposite or (keeping the heading) equal angles;
    or hybrid, opposite for the curve and equal for the lateral error"""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.362
    """Greatest axle angle, rad: with both axles opposite a circle of 0.42 m; less where the servos reach less."""
    speed: Positive = 0.18
    """Forward, m/s."""
    reverse_speed: Positive = 0.12
    """Backward, m/s."""
    min_speed: Positive = 0.03
    """Slowest speed before a stop, m/s."""
    acceleration: Positive = 0.3
    """With which the truck is taken to gain speed, m/s^2."""
    deceleration: Positive = 0.1
    """Deceleration before curves, the end of the path and where the direction changes, m/s^2."""
    lateral_acceleration: Positive = 0.5
    """Greatest speed squared times curvature, m/s^2."""
    goal_tolerance: Positive = 0.02
    """A path is completed if the truck stops within this distance of its end, m."""
    goal_yaw_tolerance: Annotated[float, Field(gt=0, le=math.pi)] = 0.2
    """A path is completed if the heading differs from its end by no more than this, rad."""
    lost_distance: Positive = 0.5
    """Further away than this from the path the tracker gives up, m."""
    slow_clearance: Positive = 0.12
    """Clearance along the next metres below which the speed falls in proportion, m."""
    slow_tilt: Annotated[float, Field(gt=0, lt=math.pi / 4)] = 0.1
    """Tilt from which on the speed falls, to nothing but ``min_speed`` at twice as much, rad."""
    slow_roughness: Annotated[float, Field(gt=0, lt=math.pi / 4)] = 0.05
    """Standard deviation of the tilt over the last seconds from which on it falls likewise, rad."""
    dead_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """From a request to the first movement of the wheels, s; null: as the servos are configured, else estimated while
    driving. A value that the truck's motion contradicts is replaced by the estimate, with an event"""
    lag: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time constant with which the axles then turn, s; null likewise"""
    steering_rate: Positive = 1.0
    """Greatest turning rate of the axles, rad/s."""

    steering_distance: Positive = 0.05
    """Distance in which the axles can turn as the path asks at the speed chosen, m."""

    @property
    def reach(self) -> float:
        """How far ahead of its last place on the path the truck is looked for, m."""
        return 0.4

    @property
    def beyond(self) -> float:
        """How far the way has to go on behind the end of the path, m."""
        return 2 * self.reach

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_speed > min(self.speed, self.reverse_speed):
            msg = f"min_speed {self.min_speed} m/s: expected at most speed and reverse_speed"
            raise ValueError(msg)
        if self.goal_tolerance >= self.reach:
            msg = f"goal_tolerance {self.goal_tolerance} m: expected less than {self.reach} m, the look-ahead"
            raise ValueError(msg)
        return self


class PurePursuitConfig(TrackerConfig):
    """Drives the arc through a point ahead, chosen by the speed where ``lookahead_time`` is not 0."""

    kind: Literal["pure_pursuit"] = "pure_pursuit"
    lookahead: Positive = 0.4
    """Distance along the path to the point driven at, m; the greatest one if it depends on the speed."""
    min_lookahead: Positive = 0.2
    """The least one, m."""
    lookahead_time: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Seconds ahead; 0: always ``lookahead``."""

    @property
    def reach(self) -> float:
        """See the base class."""
        return self.lookahead


class StanleyConfig(TrackerConfig):
    """Points the leading axle back to where it belongs."""

    kind: Literal["stanley"]
    gain: Positive = 2.0
    """The leading axle's distance from its place falls at this rate, 1/s, while the speed allows."""
    softening: Positive = 0.1
    """Added to the speed, m/s: calms the truck at low speed."""
    heading_gain: Positive = 6.0
    """Turn per metre and radian where the axle that leads cannot steer, 1/m."""


class FuzzyConfig(TrackerConfig):
    """The fuzzy controller of rsband_local_planner: its rules as published, or with their slips corrected."""

    kind: Literal["fuzzy"]
    rules: Literal["published", "corrected"] = "corrected"
    sub_goal: Positive = 0.6
    """Distance along the path to the pose steered at, m."""
    near: Positive = 0.2
    """Up to this distance the sub-goal is close, from twice as much on it is far, m."""
    lateral_tolerance: Positive = 0.05
    """Lateral deviation called small, m."""

    @property
    def reach(self) -> float:
        """See the base class."""
        return self.sub_goal


class LqrConfig(TrackerConfig):
    """Linear-quadratic regulator with preview of the path, its gains for the present speed."""

    kind: Literal["lqr"]
    preview: Annotated[float, Field(gt=0, le=5)] = 1.5
    """Seconds of the path ahead that count."""
    lateral_scale: Positive = 0.01
    """Distance from the path that weighs 1, m."""
    heading_scale: Positive = 0.2
    """Heading error that weighs 1, rad."""
    rate_scale: Positive = 2.0
    """Steering rate that weighs 1, rad/s."""

    @property
    def beyond(self) -> float:
        """See the base class."""
        return self.reach + 2 * self.preview * max(self.speed, self.reverse_speed)


class MpcConfig(LqrConfig):
    """Model-predictive control: the same costs, with the limits of angles and rates, re-linearised at each step."""

    kind: Literal["mpc"]  # type: ignore[assignment]
    iterations: Annotated[int, Field(ge=10, le=2000)] = 200
    """Of the solver, at most."""
