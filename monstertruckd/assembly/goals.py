"""The goal service of a configuration, with its ends of the bus."""

from typing import Final

from monstertruck_kinematics.chassis import Chassis
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.deform import Deformation
from monstertruck_planners.goals.exchange import Setup
from monstertruck_planners.goals.parts import Inputs, Outputs
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.steps import DEFORMING, PLANNING, STEPS
from monstertruck_runtime.actors.actor import ActorFactory
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.ports import Publisher
from monstertruck_schemas import topics
from monstertruck_schemas.plan import Path
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.topics import Writer
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import TruckConfig

START_TIMEOUT: Final = 180.0
"""Real seconds the worker may take to start: the first time it compiles."""


def build_goals(
    config: TruckConfig,
    planner: PlannerConfig,
    bus: Bus,
    clock: Clock,
    chassis: Chassis,
    footprint: Footprint,
    path: Publisher[Path],
    planner_request: Publisher[DriveRequest],
    actors: ActorFactory,
) -> GoalService:
    """Goals are in map where the robot localises itself, else in odom, which is then taken for the map's frame."""
    lidar, mapped = config.devices.lidar, config.slam is not None
    assert config.tracker is not None
    planner = planner.model_copy(update={"map": None}) if mapped else planner
    mount = lidar.mount.planar if lidar is not None else (0.0, 0.0, 0.0)
    setup = Setup(planner, chassis.bicycle, footprint, mount, timed=not isinstance(clock, VirtualClock))
    return GoalService(
        setup,
        clock,
        actors.actor(
            config.placement.planner,
            PLANNING,
            STEPS[PLANNING],
            latency=planner.latency,
            deadline=planner.deadline,
            start_timeout=START_TIMEOUT,
        ),
        deceleration=config.tracker.deceleration,
        max_age=config.gate.max_request_age,
        inputs=Inputs(
            goals=bus.subscribe(topics.REQ_GOAL, fifo(4)),
            controls=bus.subscribe(topics.REQ_GOAL_CONTROL, fifo(4)),
            gate=bus.subscribe(topics.GATE, latest()),
            pose=bus.subscribe(topics.POSE if mapped else topics.ODOMETRY, latest()),
            tracker=bus.subscribe(topics.TRACKER, latest()),
            path=bus.subscribe(topics.PATH, latest()),
            scan=bus.subscribe(topics.SCAN, latest()) if lidar is not None else None,
            grid=bus.subscribe(topics.MAP, latest()) if mapped else None,
        ),
        outputs=Outputs(path, planner_request, bus.publisher(topics.GOAL, Writer.PLANNER), bus.event_sink()),
        deformation=_deformation(config, setup, bus, clock, actors),
    )


def _deformation(config: TruckConfig, setup: Setup, bus: Bus, clock: Clock, actors: ActorFactory) -> Deformation | None:
    mapped, local = config.slam is not None, setup.config.local
    if setup.config.deform is None or config.devices.lidar is None:
        return None
    return Deformation(
        setup,
        clock,
        actors.actor(
            config.placement.deformer,
            DEFORMING,
            STEPS[DEFORMING],
            latency=local.latency,
            deadline=local.deadline,
            start_timeout=START_TIMEOUT,
        ),
        scan=bus.subscribe(topics.SCAN, latest()),
        pose=bus.subscribe(topics.POSE if mapped else topics.ODOMETRY, latest()),
        grid=bus.subscribe(topics.MAP, latest()) if mapped else None,
        events=bus.event_sink(),
    )
