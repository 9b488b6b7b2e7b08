"""Builds what thinks: estimation and planners of a configuration, each with its ends of the bus."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Self

from monstertruck_drivers.catalog import DEVICES
from monstertruck_estimation.catalog import ODOMETRY
from monstertruck_estimation.odometry import OdometryContext
from monstertruck_estimation.slam.service import SlamService
from monstertruck_estimation.transforms import TransformService, compose, invert, mount
from monstertruck_kinematics.chassis import Chassis
from monstertruck_planners.behave.catalog import BEHAVIOURS
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_planners.steps import STEPS, TRACKING
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.paths import PathService, load_path
from monstertruck_planners.track.service import TrackerService, TrackSetup
from monstertruck_runtime.actors.actor import ActorFactory
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.ports import Publisher, Subscription
from monstertruck_runtime.service import Service
from monstertruck_schemas import topics
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.topics import Writer
from monstertruckd.assembly.goals import build_goals
from monstertruckd.bus.local import Bus
from monstertruckd.config.load import Tree
from monstertruckd.config.truck import TruckConfig
from monstertruckd.recorder.picture import MapService

SCANS: Final = 16
"""Scans that may wait for the estimation worker."""
ODOMETRIES: Final = 256
"""Poses and angles that may wait for a scan."""
STEP_DEADLINE: Final = 5.0
"""Seconds after which a tracker elsewhere is given up; the gate stops the truck long before."""


@dataclass(frozen=True, slots=True)
class Body:
    """The robot's kinematics and outline, shared by gate, estimation and planners."""

    chassis: Chassis
    footprint: Footprint
    points: ScanPoints
    """Of the newest scan."""

    @classmethod
    def of(cls, config: TruckConfig) -> Self:
        """Of a configured robot."""
        lidar = config.devices.lidar
        points = ScanPoints(lidar.mount.planar if lidar is not None else (0.0, 0.0, 0.0))
        return cls(config.chassis(), Footprint(config.geometry.length, config.geometry.width), points)


def build_estimation(config: TruckConfig, bus: Bus, clock: Clock, body: Body) -> Iterator[Service]:
    """Transforms always; odometry where the robot can drive and steer."""
    mounts = {
        role: mount(role, (m.x, m.y, m.z), (m.roll, m.pitch, m.yaw))
        for role, m in ((role, device.mount) for role, device in config.devices.present().items())
        if DEVICES.roles[role].frame
    }
    joints = mounts.pop(DeviceRole.STABILISER, None)
    if joints is not None and DeviceRole.LIDAR in mounts:
        lidar = mounts[DeviceRole.LIDAR]
        mounts[DeviceRole.LIDAR] = compose(invert(joints), lidar)
    slam = _build_slam(config, bus, clock)
    yield TransformService(
        list(mounts.values()),
        clock,
        bus.subscribe(topics.ODOMETRY, latest()),
        bus.publisher(topics.TRANSFORMS, Writer.ESTIMATION),
        joints=None if joints is None else (joints, bus.subscribe(topics.STABILISER, latest())),
        localised=tuple if slam is None else slam.frames,
    )
    if slam is not None:
        yield slam
    if config.missing_actuators() is not None:
        return
    compass, slam_runs = config.devices.compass is not None, config.slam is not None
    context = OdometryContext(body.chassis, clock, bus, compass=compass, slam=slam_runs)
    yield ODOMETRY.implementation(config.odometry)(config.odometry, context)


def _build_slam(config: TruckConfig, bus: Bus, clock: Clock) -> SlamService | None:
    devices = config.devices
    if config.slam is None or devices.lidar is None:
        return None
    return SlamService(
        config.slam,
        devices.lidar.mount,
        clock,
        scan=bus.subscribe(topics.SCAN, fifo(SCANS)),
        odometry=bus.subscribe(topics.ODOMETRY, fifo(ODOMETRIES)) if config.missing_actuators() is None else None,
        compass=bus.subscribe(topics.COMPASS, fifo(ODOMETRIES)) if devices.compass is not None else None,
        joints=bus.subscribe(topics.STABILISER, fifo(ODOMETRIES)) if devices.stabiliser is not None else None,
        pose=bus.publisher(topics.POSE, Writer.ESTIMATION),
        whole=bus.publisher(topics.MAP, Writer.ESTIMATION),
        tiles=bus.publisher(topics.MAP_TILES, Writer.ESTIMATION),
        motion=bus.publisher(topics.SCAN_MOTION, Writer.ESTIMATION),
        health=bus.publisher(topics.SLAM, Writer.ESTIMATION),
        events=bus.event_sink(),
    )


def build_planners(config: TruckConfig, bus: Bus, clock: Clock, body: Body, actors: ActorFactory) -> Iterator[Service]:
    """Path source and tracker where one is configured; the lidar's levelling; the map's picture."""
    if config.tracker is not None:
        paths, requests = bus.publisher(topics.PATH, Writer.PLANNER), bus.publisher(topics.PLAN_DRIVE, Writer.PLANNER)
        frame = "odom" if config.slam is None else "map"
        drawn = None
        if config.path is not None:
            drawn = load_path(config.path.file, closed=config.path.closed, frame=frame)
        yield PathService(
            drawn,
            clock,
            bus.subscribe(topics.REQ_PATH, fifo(4)),
            bus.subscribe(topics.GATE, latest()),
            paths,
            bus.event_sink(),
            config.gate.max_request_age,
        )
        yield _build_tracker(config, config.tracker, bus, clock, body, requests, actors)
        if config.planner is not None:
            yield build_goals(config, config.planner, bus, clock, body.chassis, body.footprint, paths, requests, actors)
    if config.devices.stabiliser is not None and config.devices.compass is not None:
        yield BEHAVIOURS.implementation(config.levelling)(config.levelling, clock, bus)
    if config.map is not None and config.devices.lidar is not None:
        yield MapService(
            config.map,
            config.devices.lidar.mount,
            clock,
            scan=bus.subscribe(topics.SCAN, latest()),
            pose=bus.subscribe(topics.POSE, latest()),
            path=bus.subscribe(topics.PATH, latest()),
            tracker=bus.subscribe(topics.TRACKER, fifo(256)),
            events=bus.event_sink(),
        )


def _build_tracker(
    config: TruckConfig, tracker: TrackerConfig, bus: Bus, clock: Clock, body: Body, requests: Publisher[DriveRequest],
    actors: ActorFactory,
) -> Service:  # fmt: skip
    lidar, placement = config.devices.lidar, config.placement.tracker
    inputs: dict[str, Subscription[Any]] = {
        "pose": bus.subscribe(topics.ODOMETRY if config.slam is None else topics.POSE, latest()),
        "path": bus.subscribe(topics.PATH, latest()),
        "gate": bus.subscribe(topics.GATE, latest()),
    }
    if lidar is not None:
        inputs["scan"] = bus.subscribe(topics.SCAN, latest())
    if config.devices.compass is not None:
        inputs["attitude"] = bus.subscribe(topics.COMPASS, latest())
    actor = None
    if placement != "loop":
        actor = actors.actor(placement, TRACKING, STEPS[TRACKING], latency=0.0, deadline=STEP_DEADLINE)
    return TrackerService(
        TrackSetup(tracker, body.chassis.bicycle, body.footprint, body.points.mount),
        clock,
        inputs=inputs,
        drive=requests,
        tracker=bus.publisher(topics.TRACKER, Writer.PLANNER),
        events=bus.event_sink(),
        actor=actor,
        points=body.points,
    )


def calibration(config: TruckConfig, chassis: Chassis, tree: Tree | None = None) -> dict[str, Any]:
    """Everything that was measured on this very truck, and the file it comes from, for the log."""
    devices = config.devices
    values: dict[str, Any] = {
        "file": None if tree is None or tree.calibration is None else str(tree.calibration),
        "wheel_radius_m": config.geometry.wheel_radius,
        "drive_ratio": config.geometry.drive_ratio,
        "linkage": None if chassis.linkage is None else dataclasses.asdict(chassis.linkage),
        "mounts": {role: device.mount.model_dump() for role, device in devices.present().items()},
    }
    values |= {f"{role}_inverted": device.driver.inverted for role, device in devices.shafts().items()}
    if devices.steering is not None:
        steering = devices.steering.driver
        values |= {"front_servo": steering.front.model_dump(), "rear_servo": steering.rear.model_dump()}
        if steering.battery is not None:
            values["battery"] = steering.battery.model_dump()
    return values
