"""Inputs of each kind of steps, and how outputs are compared."""

from typing import Any

import numpy as np

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.config import InformationConfig
from monstertruck_planners.explore.exchange import ExploreSetup, ExploreTask
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.exchange import DeformTask, PlanTask, Setup
from monstertruck_planners.local.config import RsbandConfig
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.config import HybridConfig
from monstertruck_planners.steps import CODEC
from monstertruck_planners.track.config import LqrConfig
from monstertruck_planners.track.service import TrackInput, TrackSetup
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry

BODY, TRUCK = Footprint(), FourWheelSteering()
HEAD = {"stamp": 5, "received": 5, "seq": 0}


def room() -> Grid:
    cells = np.zeros((60, 120), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    return Grid(
        **HEAD, frame="map", resolution=0.05, width=120, height=60, origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
        cells=cells.ravel(),
    )  # fmt: skip


def deform_tasks() -> list[DeformTask]:
    """Something stands on a straight route, seen three times."""
    poses = np.column_stack((np.arange(1.0, 5.01, 0.05), np.full(81, 1.5), np.zeros(81)))
    setup = Setup(PlannerConfig(local_planner=RsbandConfig()), TRUCK, BODY, (0.14, 0.0, 0.0))
    ranges = np.full(241, np.inf)
    ranges[110:125] = 1.2
    scan = LaserScan(
        **HEAD, frame="lidar", start_angle=-2.0, end_angle=2.0, time_increment=0.0, scan_time=0.1, range_min=0.02,
        range_max=4.1, ranges=ranges, codes=np.where(np.isfinite(ranges), 255, 0).astype(np.uint8),
    )  # fmt: skip
    first = DeformTask(scan, (1.0, 1.5, 0.0), setup, room(), PosePath(poses, np.ones(81)), 1)
    return [first, DeformTask(scan, (1.0, 1.5, 0.0)), DeformTask(scan, (1.02, 1.5, 0.0))]


def plan_task() -> PlanTask:
    setup = Setup(PlannerConfig(route=HybridConfig(effort=1000, margin=0.04)), TRUCK, BODY)
    points = np.array([[2.75, 1.5], [2.75, 1.45]])
    return PlanTask("route", (1.0, 1.5, 0.1), (4.5, 1.4, 0.3), points, setup=setup, grid=room())


def explore_task() -> ExploreTask:
    """The far half of the room is unknown."""
    cells = room().cells.reshape(60, 120).copy()
    cells[:, 60:] = -1
    setup = ExploreSetup(InformationConfig(), BODY, 0.5)
    whole = room().model_copy(update={"cells": cells.ravel()})
    return ExploreTask((1.0, 1.5, 0.1), whole=whole, setup=setup, choose=True, home=(0.8, 1.5, 0.0))


def track_inputs() -> list[TrackInput]:
    xs = np.linspace(0.0, 2.0, 41)
    path = Path(
        **HEAD, frame="odom", poses=np.column_stack((xs, 0.1 * xs**2, 0.2 * xs)).ravel(), directions=np.ones(41)
    )
    gate = GateState(**HEAD, mode=GateMode.DRIVING, nonce="n", speed_limit=0.2)
    setup = TrackSetup(LqrConfig(kind="lqr"), TRUCK, BODY, (0.0, 0.0, 0.0))
    inputs = []
    for i in range(5):
        odometry = Odometry(
            **{**HEAD, "received": 50_000_000 * i}, frame="odom", pose=Pose2D(x=0.01 * i, y=0.02, yaw=0.0),
            twist=Twist2D(vx=0.1, vy=0.0, wz=0.0), pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
        )  # fmt: skip
        news = {"pose": odometry} | ({"path": path, "gate": gate} if i == 0 else {})
        inputs.append(TrackInput(50_000_000 * i, news, setup if i == 0 else None))
    return inputs


def numbers(value: Any) -> list[float]:
    """All numbers of a tree."""
    match value:
        case {"array": _}:
            return CODEC.from_json(value).ravel().tolist()
        case dict():
            return [number for inner in value.values() for number in numbers(inner)]
        case list():
            return [number for inner in value for number in numbers(inner)]
        case bool() | str() | None:
            return []
    return [float(value)]
