"""Tracker settings: a shared base and one model per ``kind``.

Light on purpose: loading a configuration imports no tracker. ``catalog`` maps each kind to its class.
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
"""Example of each steering mode: front and rear axle angle (rad)."""


class TrackerConfig(Schema):
    """Settings shared by all trackers."""

    rate: Annotated[float, Field(gt=0, le=100)] = 20.0
    """Rate of requests (1/s)."""
    lease: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Lease of each request (s)."""
    steering: Steering = "counter"
    """Steered axles if the path specifies none: one alone; both with opposite or (keeping the heading) equal angles; or
    hybrid, opposite for the curve and equal for the lateral error
    """
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.362
    """Maximum axle angle (rad), also limited by the servos; with both axles opposite it gives a circle of 0.42 m."""
    speed: Positive = 0.18
    """Forward speed (m/s)."""
    reverse_speed: Positive = 0.12
    """Reverse speed (m/s)."""
    min_speed: Positive = 0.03
    """Minimum speed before a stop (m/s)."""
    acceleration: Positive = 0.3
    """Assumed acceleration of the truck (m/s^2)."""
    deceleration: Positive = 0.1
    """Deceleration before curves, changes of direction and the end of the path (m/s^2)."""
    lateral_acceleration: Positive = 0.5
    """Maximum lateral acceleration: speed squared times curvature (m/s^2)."""
    goal_tolerance: Positive = 0.02
    """Maximum distance of a stopped truck from the end of a completed path (m)."""
    goal_yaw_tolerance: Annotated[float, Field(gt=0, le=math.pi)] = 0.2
    """Maximum heading error at the end of a completed path (rad)."""
    lost_distance: Positive = 0.5
    """Maximum distance from the path (m); beyond it the tracker gives up."""
    path_tolerance: Positive = 0.15
    """Maximum deviation of the best drive from a path that an operator sends or configures (m); paths that force the
    robot further away are refused.
    """
    slow_clearance: Positive = 0.12
    """Clearance along the next metres below which the tracker reduces the speed in proportion (m)."""
    slow_tilt: Annotated[float, Field(gt=0, lt=math.pi / 4)] = 0.1
    """Tilt above which the tracker reduces the speed, down to ``min_speed`` at twice this tilt (rad)."""
    slow_roughness: Annotated[float, Field(gt=0, lt=math.pi / 4)] = 0.05
    """Standard deviation of the tilt over the last seconds above which the tracker reduces the speed likewise (rad)."""
    dead_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time from a request to the first movement of the wheels (s); null: the configured value of the servos, else an
    estimate made while driving. If the truck's motion contradicts a value, the estimate replaces it, with an event
    """
    lag: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time constant of the axles after the dead time (s); null: as for ``dead_time``"""
    steering_rate: Positive = 1.0
    """Maximum turning rate of the axles (rad/s)."""

    steering_distance: Positive = 0.05
    """Distance in which the axles must reach the path's steering angles at the chosen speed (m)."""

    @property
    def reach(self) -> float:
        """Search range ahead of the truck's last position on the path (m)."""
        return 0.4

    @property
    def beyond(self) -> float:
        """Required length of the extension past the end of the path (m)."""
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
    """Pure pursuit: drives the arc through a point ahead, chosen by the speed unless ``lookahead_time`` is 0."""

    kind: Literal["pure_pursuit"] = "pure_pursuit"
    lookahead: Positive = 0.4
    """Distance along the path to the target point (m); the maximum if it depends on the speed."""
    min_lookahead: Positive = 0.2
    """Minimum look-ahead distance (m)."""
    lookahead_time: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Look-ahead time (s); 0 for the fixed distance ``lookahead``."""

    @property
    def reach(self) -> float:
        """See the base class."""
        return self.lookahead


class FuzzyConfig(TrackerConfig):
    """Fuzzy controller of rsband_local_planner, with its rules as published or corrected."""

    kind: Literal["fuzzy"]
    rules: Literal["published", "corrected"] = "corrected"
    """Use the rules as published, or with their errors corrected."""
    sub_goal: Positive = 0.6
    """Distance along the path to the target pose (m)."""
    near: Positive = 0.2
    """Maximum distance of a close sub-goal (m); at twice this distance it is far."""
    lateral_tolerance: Positive = 0.05
    """Lateral deviation classified as small (m)."""

    @property
    def reach(self) -> float:
        """See the base class."""
        return self.sub_goal


class LqrConfig(TrackerConfig):
    """Linear-quadratic regulator with path preview; gains computed for the current speed."""

    kind: Literal["lqr"]
    preview: Annotated[float, Field(gt=0, le=5)] = 1.5
    """Preview time (s)."""
    lateral_scale: Positive = 0.01
    """Distance from the path with a weight of 1 (m)."""
    heading_scale: Positive = 0.2
    """Heading error with a weight of 1 (rad)."""
    rate_scale: Positive = 2.0
    """Steering rate with a weight of 1 (rad/s)."""

    @property
    def beyond(self) -> float:
        """See the base class."""
        return self.reach + 2 * self.preview * max(self.speed, self.reverse_speed)


class MpcConfig(LqrConfig):
    """Model-predictive control: the same costs, with limits of angles and rates, re-linearised at each step."""

    kind: Literal["mpc"]  # type: ignore[assignment]
    iterations: Annotated[int, Field(ge=10, le=2000)] = 200
    """Maximum number of solver iterations."""
