"""Settings of driving to goals: route planner, map, deformation, recovery behaviours; light, no planner is loaded."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_planners.local.catalog import AnyLocalPlanner
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
"""Ways of steering in the routes of each kind of vehicle."""


class EscapeConfig(Schema):
    """Backing out, as by car_maneuver_recovery: away from the sides of the footprint that are not free."""

    room: Positive = 0.15
    """A side is free if there is no obstacle within this distance of it, m."""
    distance: Positive = 0.5
    """Driven at most, m."""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.362
    """Of the axles, away from a blocked side, rad; less where the servos reach less."""
    crab: bool = True
    """Both axles alike, where the vehicle can; else they turn the truck."""
    margin: NotNegative = 0.03
    """Kept to obstacles on the way, m; those that are nearer already may not come nearer."""


class WindowConfig(Schema):
    """Obstacles around the robot by which routes are deformed."""

    size: Annotated[float, Field(gt=0, le=20)] = 4.0
    """Side, m; the robot is in the middle"""
    resolution: Annotated[float, Field(ge=0.01, le=0.2)] = 0.04
    """Edge of a cell, m"""
    mark: Positive = 3.0
    """Returns up to this distance mark obstacles, m"""
    clear: Positive = 4.0
    """Beams clear cells up to this distance, m"""
    thickness: NotNegative = 0.12
    """Depth of obstacles where the cells behind them have never been seen, m"""


class LocalConfig(Schema):
    """When routes are deformed, and what is made of it."""

    window: WindowConfig = WindowConfig()
    """Where obstacles are kept"""
    clearance: NotNegative = 0.02
    """A route with an obstacle nearer than this is deformed, m; the gate's side clearance."""
    rejoin_clearance: NotNegative = 0.03
    """Clearance needed to return to the route, m."""
    rejoin_distance: Positive = 0.06
    """Distance from the route within which the truck may return to it, m, counting 0.3 m per radian."""
    blocked_timeout: Positive = 2.0
    """Seconds without a way round something after which the route counts as blocked."""
    detour: Positive = 45.0
    """Seconds of deformation that do not bring the truck on along its route, after which the same holds."""
    latency: Positive = 0.05
    """Seconds a deformation takes on the virtual clock"""
    deadline: Positive = 5.0
    """Seconds after which a silent worker is killed"""


class PlannerConfig(Schema):
    """How goals are reached."""

    route: AnyRoutePlanner = HybridConfig(margin=0.04, unknown="blocked", reverse_cost=2.0)
    """Route planner; its margin has to exceed the gate's side clearance; backward the lidar sees nothing"""
    steering: Literal["2ws", "counter", "4ws"] = "4ws"
    """Front axle alone, both opposite, or both in every way"""
    angle: Annotated[float, Field(gt=0, lt=1)] = 0.33
    """Greatest axle angle of routes, rad: circles of 0.47 m; the tracker has more. Less where the servos reach
    less"""
    map: Path | None = None
    """map_server YAML file to plan on where there is no slam"""
    local_planner: AnyLocalPlanner | None = None
    """What leads the truck round things that stand on its route; null = the route is planned again"""
    local: LocalConfig = LocalConfig()
    rate: Annotated[float, Field(ge=1, le=20)] = 10.0
    """Decisions per second."""
    position_tolerance: Positive = 0.2
    """The goal is reached if the truck stops within this distance, m."""
    yaw_tolerance: Positive = 0.2
    """The goal is reached if the heading differs by no more than this, rad."""
    waypoint_radius: Positive = 0.3
    """A waypoint has been passed if the truck was this near, m."""
    aim: Annotated[float, Field(gt=0, le=1)] = 0.4
    """Share of these beyond which it corrects its place first."""
    corrections: Annotated[int, Field(ge=0)] = 1
    """How often it does so."""
    timeout: Positive = 600.0
    """Seconds for a goal; those in which the truck is not armed or the goal is paused do not count."""
    unarmed_timeout: Positive = 300.0
    """Seconds a goal waits for the truck to be armed, or for a fresh pose."""
    stuck: Positive = 4.0
    """Seconds without progress after which the recovery behaviours begin."""
    progress: Positive = 0.03
    """Metres along the path that are progress."""
    look_ahead: Positive = 1.5
    """Distance ahead that is compared with the newest scan, m."""
    blocked_scans: Annotated[int, Field(ge=1)] = 3
    """Consecutive scans that have to show the path blocked."""
    recovery: Annotated[tuple[Recovery, ...], Field(strict=False)] = ("clear", "back_out", "wait", "replan")
    """Recovery behaviours, tried in turn before the goal is given up"""
    wait: Positive = 5.0
    """Seconds of the behaviour "wait"."""
    recovered: Positive = 0.5
    """Metres nearer to the goal along the route than ever before, after which the recovery behaviours start again"""
    routes: Annotated[int, Field(ge=1)] = 30
    """Routes for one goal at most."""
    max_tilt: Annotated[float, Field(gt=0, le=1.5)] = 0.1
    """A scan tilted more than this says nothing about the way, rad: it looks over obstacles, or onto the ground"""
    scan_tolerance: NotNegative = 0.08
    """Returns this near to an obstacle of the map are taken for it, m; up to twice as much where the pose is uncertain:
    two standard deviations of its position are added"""
    escape: EscapeConfig = EscapeConfig()
    latency: Positive = 0.5
    """Seconds a route takes on the virtual clock"""
    deadline: Positive = 30.0
    """Seconds after which a silent worker is killed"""

    @model_validator(mode="after")
    def _in_time(self) -> Self:
        if self.route.budget >= self.deadline:
            raise ValueError(f"deadline {self.deadline} s: expected more than route.budget, {self.route.budget} s")
        return self
