"""Settings of driving to goals: route planner, map, deformation, recovery behaviours. Loads no planner."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_planners.local.catalog import AnyLocalPlanner
from monstertruck_planners.local.config import PeopleConfig
from monstertruck_planners.route.catalog import AnyRoutePlanner
from monstertruck_planners.route.config import HybridConfig
from monstertruck_schemas.base import NotNegative, Positive, Schema
from monstertruck_schemas.plan import Steering

Recovery = Literal["clear", "back_out", "wait", "replan"]

DRIVEN: dict[Literal["2ws", "counter", "4ws"], tuple[Steering, ...]] = {
    "2ws": ("front",),
    "counter": ("counter",),
    "4ws": ("counter", "crab"),
}
"""Steering modes in the routes of each kind of vehicle."""


class EscapeConfig(Schema):
    """Backing out, as in car_maneuver_recovery: away from the blocked sides of the footprint."""

    room: Positive = 0.15
    """Minimum distance of obstacles from a free side (m)."""
    distance: Positive = 0.5
    """Maximum distance travelled (m)."""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.362
    """Axle angle away from a blocked side (rad), limited by the servos."""
    crab: bool = True
    """Same angle on both axles if the vehicle can; otherwise the axles turn the truck."""
    margin: NotNegative = 0.03
    """Clearance from obstacles along the path (m); obstacles already within it may not come closer."""


class WindowConfig(Schema):
    """Obstacle window around the robot for deforming routes."""

    size: Annotated[float, Field(gt=0, le=20)] = 4.0
    """Side length (m), centred on the robot"""
    resolution: Annotated[float, Field(ge=0.01, le=0.2)] = 0.04
    """Cell size (m)"""
    mark: Positive = 3.0
    """Maximum distance of returns that mark obstacles (m)"""
    clear: Positive = 4.0
    """Maximum distance of cells cleared by beams (m)"""
    thickness: NotNegative = 0.12
    """Depth of obstacles if the cells behind them have never been seen (m)"""


class LocalConfig(Schema):
    """Conditions and limits of deforming routes."""

    window: WindowConfig = WindowConfig()
    """Window of remembered obstacles"""
    clearance: NotNegative = 0.02
    """Clearance below which a route is deformed (m); the side clearance of the gate."""
    rejoin_clearance: NotNegative = 0.03
    """Clearance required to return to the route (m)."""
    rejoin_distance: Positive = 0.06
    """Maximum distance from the route for returning to it (m), with 0.3 m per radian of heading error."""
    people: PeopleConfig | None = PeopleConfig()
    """Walking people; null: they are obstacles at their current places"""
    blocked_timeout: Positive = 2.0
    """Maximum time without a path around an obstacle (s); then the route is blocked."""
    detour: Positive = 45.0
    """Maximum time of deformation without progress along the route (s); then the route is blocked."""
    latency: Positive = 0.05
    """Latency of a deformation on the virtual clock (s)"""
    deadline: Positive = 5.0
    """Maximum silence of the worker before it is killed (s)"""


class PlannerConfig(Schema):
    """Driving to goals."""

    mode: Literal["robot", "ros2"] = "robot"
    """`ros2`: Nav2 serves goals and drives by `cmd_vel`, as a source in `gate.remote_trackers`; no route is planned
    here"""
    route: AnyRoutePlanner = HybridConfig(margin=0.04, unknown="blocked", reverse_cost=2.0)
    """Route planner; its margin must exceed the side clearance of the gate; the lidar sees nothing behind"""
    steering: Literal["2ws", "counter", "4ws"] = "4ws"
    """Steering: front axle only, both axles opposite, or both axles opposite and parallel"""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.33
    """Maximum axle angle of routes (rad), limited by the servos; the default gives circles of 0.47 m. The tracker may
    use more"""
    map: Path | None = None
    """map_server YAML file for planning without slam"""
    local_planner: AnyLocalPlanner | None = None
    """Local planner around obstacles on the route; null: replan the route"""
    local: LocalConfig = LocalConfig()
    rate: Annotated[float, Field(ge=1, le=20)] = 10.0
    """Decisions per second."""
    position_tolerance: Positive = 0.2
    """Maximum distance from the goal at a stop (m)."""
    yaw_tolerance: Positive = 0.2
    """Maximum heading error at the goal (rad)."""
    waypoint_radius: Positive = 0.3
    """Radius of a waypoint (m); the truck passes it by coming within this radius."""
    aim: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Fraction of the tolerances beyond which the truck first corrects its pose."""
    corrections: Annotated[int, Field(ge=0)] = 1
    """Number of such corrections."""
    timeout: Positive = 600.0
    """Time limit of a goal (s), without the time unarmed or paused."""
    unarmed_timeout: Positive = 300.0
    """Maximum wait for the truck to be armed, or for a fresh pose (s)."""
    stuck: Positive = 4.0
    """Maximum time without progress before the recovery behaviours begin (s)."""
    progress: Positive = 0.03
    """Minimum progress along the path (m)."""
    look_ahead: Positive = 1.5
    """Distance ahead that is checked against the latest scan (m)."""
    blocked_scans: Annotated[int, Field(ge=1)] = 3
    """Number of consecutive scans that must show the path blocked."""
    recovery: Annotated[tuple[Recovery, ...], Field(strict=False)] = ("clear", "back_out", "wait", "replan")
    """Recovery behaviours, tried in turn before the goal fails"""
    wait: Positive = 5.0
    """Duration of the behaviour "wait" (s)."""
    recovered: Positive = 0.5
    """Reduction of the minimum remaining route length that restarts the recovery behaviours (m)"""
    routes: Annotated[int, Field(ge=1)] = 30
    """Maximum number of routes for one goal."""
    max_tilt: Annotated[float, Field(gt=0, le=1.5)] = 0.1
    """Maximum tilt of a used scan (rad); a scan beyond it passes over obstacles or hits the ground"""
    scan_tolerance: NotNegative = 0.08
    """Maximum distance of a return from the map obstacle that explains it (m); two standard deviations of the position
    are added, up to twice this value in total"""
    escape: EscapeConfig = EscapeConfig()
    latency: Positive = 0.5
    """Latency of a route on the virtual clock (s)"""
    deadline: Positive = 30.0
    """Maximum silence of the worker before it is killed (s)"""

    @model_validator(mode="after")
    def _in_time(self) -> Self:
        if self.route.budget >= self.deadline:
            raise ValueError(f"deadline {self.deadline} s: expected more than route.budget, {self.route.budget} s")
        return self
