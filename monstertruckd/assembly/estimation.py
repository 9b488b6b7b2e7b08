"""Builds transforms, odometry and SLAM of a configuration, each with its ends of the bus."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Final, Self

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.scanning.mounting import upright
from monstertruck_estimation.catalog import ODOMETRY
from monstertruck_estimation.consistency.config import SCAN_LIBRARIES, ConsistencyConfig
from monstertruck_estimation.consistency.service import START_TIMEOUT as SCANS_START
from monstertruck_estimation.consistency.service import TARGET as SCAN_ODOMETRY
from monstertruck_estimation.consistency.service import ConsistencyInputs, ConsistencyService, ScanSetup
from monstertruck_estimation.ground.service import GroundService
from monstertruck_estimation.gyro import GyroConfig
from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.odometry import OdometryContext
from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.service import READER_START_TIMEOUT as READER_START
from monstertruck_estimation.points.service import TARGET as READER
from monstertruck_estimation.points.service import PointFolders, PointInputs, PointService
from monstertruck_estimation.slam.outside import OutsideLocalisation
from monstertruck_estimation.slam.outside_map import OutsideMap
from monstertruck_estimation.slam.service import OtherLidar, SlamService
from monstertruck_estimation.transforms import TransformService, compose, invert, mount, quaternion_from_rpy
from monstertruck_kinematics.chassis import Chassis
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_runtime.actors.actor import ActorFactory, Placement, WorkerActor
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_runtime.extras import not_installed
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.map_folders import YAML
from monstertruck_runtime.service import Service
from monstertruck_runtime.threads import in_thread, inline
from monstertruck_schemas import topics
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.topics import Writer
from monstertruckd.assembly.devices import measures_battery, scan_angles
from monstertruckd.bus.local import Bus
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.rear_sonars import rear

SCANS: Final = 16
"""Scans that may wait for the estimation worker."""
ODOMETRIES: Final = 256
"""Poses and angles that may wait for a scan."""


@dataclass(frozen=True, slots=True)
class Body:
    """The robot's kinematics and outline, shared by gate, estimation and planners."""

    chassis: Chassis
    footprint: Footprint
    points: tuple[ScanPoints, ...]
    """Points of the latest scan of every lidar; of a robot without a lidar one that never gets a scan."""
    sonars: Mapping[str, tuple[float, float, float]]
    """Pose in base of every sonar of a robot without a lidar, m, m, rad."""
    rear_sonars: Mapping[str, tuple[float, float, float]]
    """Pose in base of every sonar that looks backwards on a robot with a lidar, m, m, rad."""
    peers: Mapping[str, Footprint]
    """Outlines of the robots whose poses it receives, by name."""

    @classmethod
    def of(cls, config: TruckConfig) -> Self:
        """Estimators of a configured robot."""
        mounts = [lidar.mount for lidar in config.devices.lidars().values()]
        points = tuple(ScanPoints(mount.planar) for mount in mounts or [Mount()])
        sonar = config.devices.sonar
        heard = {} if sonar is None else {name: one.mount.planar for name, one in sonar.driver.sonars.items()}
        length, width = config.geometry.length, config.geometry.width
        peers = {name: Footprint(peer.length or length, peer.width or width) for name, peer in config.peers.items()}
        sonars, rear_sonars = ({}, rear(heard)) if mounts else (heard, {})
        return cls(config.chassis(), Footprint(length, width), points, sonars, rear_sonars, peers)


def sensor_mounts(config: TruckConfig) -> dict[str, Mount]:
    """Mounts of all sensors on the base, by frame; for the stabiliser, the point that its joints turn about."""
    devices = config.devices.present()
    mounts = {role: device.mount for role, device in devices.items() if DEVICES.roles[role].frame}
    mounts |= {role: upright(device.mount) for role, device in config.devices.lidars().items()}
    for role, device in devices.items():
        if (elements := DEVICES.roles[role].elements) is not None:
            for name, element in getattr(device.driver, elements).items():
                mounts[f"{role}_{name}"] = element.mount
    if config.lidar_sonars is not None:
        mounts |= {f"sonar_{name}": place for name, place in config.lidar_sonars.sonars.items()}
    return mounts


def build_estimation(
    config: TruckConfig,
    bus: Bus,
    clock: Clock,
    body: Body,
    actors: ActorFactory,
    slam: SlamService | OutsideLocalisation | None,
    run: str = "",
) -> Iterator[Service]:
    """Transforms always; odometry where the robot can drive and steer. ``run`` names this run in saved maps."""
    mounts = {name: mount(name, (m.x, m.y, m.z), (m.roll, m.pitch, m.yaw)) for name, m in sensor_mounts(config).items()}
    joints = mounts.pop(DeviceRole.STABILISER, None)
    if joints is not None and DeviceRole.LIDAR in mounts:
        lidar = mounts[DeviceRole.LIDAR]
        mounts[DeviceRole.LIDAR] = compose(invert(joints), lidar)
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
    compass, imu = config.devices.compass is not None, config.devices.imu
    turned = None if imu is None else quaternion_from_rpy(imu.mount.roll, imu.mount.pitch, imu.mount.yaw)
    encoders = config.devices.encoders is not None
    context = OdometryContext(
        body.chassis, clock, bus, compass=compass, slam=config.slam is not None, imu=turned, encoders=encoders
    )
    yield ODOMETRY.build(config.odometry, config.odometry, context)
    if config.consistency is not None:
        yield _build_consistency(config, config.consistency, bus, clock, body, actors)
    ground = _build_ground(config, bus, clock, run)
    if ground is not None:
        yield ground
    if config.points is not None:
        mapper = slam if isinstance(slam, SlamService) else None
        yield _build_points(config, config.points, bus, clock, mapper, run)


def _build_consistency(
    config: TruckConfig, consistency: ConsistencyConfig, bus: Bus, clock: Clock, body: Body, actors: ActorFactory
) -> ConsistencyService:
    devices, chassis = config.devices, body.chassis
    scans = None
    if consistency.scans is not None and devices.lidar is not None and all(map(find_spec, SCAN_LIBRARIES)):
        # On the virtual clock nothing runs meanwhile: a separate process would only take time to start.
        placement: Placement = "loop" if isinstance(clock, VirtualClock) else "worker"
        actor = actors.actor(
            placement,
            ConsistencyService.name,
            SCAN_ODOMETRY,
            latency=consistency.latency,
            deadline=consistency.deadline,
            start_timeout=SCANS_START,
        )
        scans = ScanSetup(actor, devices.lidar.mount, scan_angles(config, bus, fifo(ODOMETRIES)))
    imu = devices.imu
    axes = None if imu is None else quaternion_from_rpy(imu.mount.roll, imu.mount.pitch, imu.mount.yaw)
    return ConsistencyService(
        consistency,
        chassis,
        clock,
        inputs=ConsistencyInputs(
            drives=[bus.subscribe(topic, latest()) for topic in topics.DRIVES[: len(chassis.shafts)]],
            steering=bus.subscribe(topics.STEERING, latest()) if chassis.steered else None,
            gate=bus.subscribe(topics.GATE, latest()),
            scan=None if scans is None else bus.subscribe(topics.SCAN, fifo(SCANS)),
            compass=None if devices.compass is None else bus.subscribe(topics.COMPASS, fifo(ODOMETRIES)),
            imu=None if imu is None else bus.subscribe(topics.IMU, fifo(ODOMETRIES)),
            encoders=None if devices.encoders is None else bus.subscribe(topics.ENCODERS, fifo(ODOMETRIES)),
            battery=bus.subscribe(topics.BATTERY, fifo(SCANS)) if measures_battery(config) else None,
            camera=None if devices.camera is None else bus.subscribe(topics.CAMERA, fifo(SCANS)),
            scan_2=None if devices.lidar_2 is None else bus.subscribe(topics.SCAN_2, fifo(SCANS)),
            stand=bus.subscribe(topics.STAND_POSE, fifo(ODOMETRIES)) if config.stand == "overhead" else None,
        ),
        scans=scans,
        inertial=None if axes is None else Inertial(GyroConfig(), axes),
        out=bus.publisher(topics.CONSISTENCY, Writer.ESTIMATION),
        events=bus.event_sink(),
        wheels=devices.controller() or DeviceRole.DRIVE,
    )


def _build_ground(config: TruckConfig, bus: Bus, clock: Clock, run: str) -> GroundService | None:
    """Route maps of a robot that measures its tilt."""
    devices, slam = config.devices, config.slam
    if config.ground is None or config.own_planner is None or devices.compass is None:
        return None
    lidar = devices.lidar
    known = config.own_planner.map if slam is None or slam.mode == "ros2" else slam.map
    geometry = config.geometry
    return GroundService(
        config.ground,
        clock,
        footprint=(geometry.length, geometry.width),
        wheelbase=geometry.wheelbase,
        mount=None if lidar is None else lidar.mount,
        compass=bus.subscribe(topics.COMPASS, fifo(ODOMETRIES)),
        angles=None if lidar is None else scan_angles(config, bus, fifo(ODOMETRIES)),
        pose=bus.subscribe(topics.ODOMETRY if slam is None else topics.POSE, fifo(ODOMETRIES)),
        scan=None if lidar is None else bus.subscribe(topics.SCAN, fifo(SCANS)),
        slip=bus.subscribe(topics.FUSION, latest()),
        out=bus.publisher(topics.GROUND, Writer.ESTIMATION),
        events=bus.event_sink(),
        offload=inline if isinstance(clock, VirtualClock) else in_thread,
        load=_folder(known),
        save=(slam.save, run) if slam is not None and slam.save is not None and slam.mode == "mapping" else None,
    )


def _folder(known: Path | None) -> Path | None:
    """Folder of a saved map, named by the folder or its YAML file; None for another map file.

    The folder of such a file may hold several maps.
    """
    if known is None or known.is_dir():
        return known
    return known.parent if known.name == YAML else None


def _build_points(
    config: TruckConfig, points: PointsConfig, bus: Bus, clock: Clock, mapper: SlamService | None, run: str
) -> PointService:
    camera, slam = config.devices.camera, config.slam
    if camera is not None and find_spec("cv2") is None:
        raise not_installed("points: opencv", "vision")
    planned = None if config.own_planner is None else config.own_planner.map
    known = planned if slam is None or slam.mode == "ros2" else slam.map
    folder = _folder(known)
    mapping = slam is not None and slam.mode == "mapping"
    return PointService(
        points,
        None if camera is None else (camera.mount, getattr(camera.driver, "lens", LensConfig())),
        clock,
        WorkerActor(
            "points", READER, clock, latency=points.latency, deadline=points.deadline, start_timeout=READER_START
        ),
        inputs=PointInputs(
            camera=None if camera is None else bus.subscribe(topics.CAMERA, latest()),
            pose=bus.subscribe(topics.ODOMETRY if slam is None else topics.POSE, fifo(ODOMETRIES)),
            slam=None if slam is None else bus.subscribe(topics.SLAM, latest()),
            attitude=None if config.devices.compass is None else bus.subscribe(topics.COMPASS, latest()),
            gate=bus.subscribe(topics.GATE, latest()),
            behaviour=bus.subscribe(topics.BEHAVIOUR, latest()),
        ),
        ask=None if mapper is None else mapper.bases_at,
        out=bus.publisher(topics.POINTS, Writer.ESTIMATION),
        tags=bus.publisher(topics.TAGS, Writer.ESTIMATION),
        events=bus.event_sink(),
        folders=PointFolders(
            load=None if mapping else folder,
            save=slam.save if slam is not None and mapping else folder,
            run=run if mapping else None,
        ),
        save_map=None if mapper is None else mapper.save_soon,
        offload=inline if isinstance(clock, VirtualClock) else in_thread,
        max_age=config.gate.max_request_age,
    )


def build_slam(config: TruckConfig, bus: Bus, clock: Clock, run: str = "") -> SlamService | OutsideLocalisation | None:
    """Build the service that maps, localises, or follows a client. ``run`` names this run in saved maps."""
    devices = config.devices
    if config.slam is not None and config.slam.mode == "ros2":
        planner, maps = config.own_planner, None
        if planner is None or planner.map is None:
            maps = OutsideMap(
                clock,
                bus.subscribe(topics.REQ_MAP, latest()),
                bus.subscribe(topics.GATE, latest()),
                bus.publisher(topics.MAP, Writer.ESTIMATION),
                bus.event_sink(),
                inline if isinstance(clock, VirtualClock) else in_thread,
            )
        return OutsideLocalisation(
            config.slam,
            clock,
            requests=bus.subscribe(topics.REQ_LOCALISATION, fifo(16)),
            gate=bus.subscribe(topics.GATE, latest()),
            odometry=bus.subscribe(topics.ODOMETRY, fifo(ODOMETRIES)),
            pose=bus.publisher(topics.POSE, Writer.ESTIMATION),
            health=bus.publisher(topics.SLAM, Writer.ESTIMATION),
            events=bus.event_sink(),
            max_age=config.gate.max_request_age,
            maps=maps,
        )
    if config.slam is None or devices.lidar is None:
        return None
    return SlamService(
        config.slam,
        devices.lidar.mount,
        clock,
        body=(config.geometry.length, config.geometry.width) if config.slam.grid.free_footprint else None,
        run=run,
        scan=bus.subscribe(topics.SCAN, fifo(SCANS)),
        odometry=bus.subscribe(topics.ODOMETRY, fifo(ODOMETRIES)) if config.missing_actuators() is None else None,
        angles=scan_angles(config, bus, fifo(ODOMETRIES)),
        other=_other_lidar(config, bus),
        pose=bus.publisher(topics.POSE, Writer.ESTIMATION),
        whole=bus.publisher(topics.MAP, Writer.ESTIMATION),
        tiles=bus.publisher(topics.MAP_TILES, Writer.ESTIMATION),
        motion=bus.publisher(topics.SCAN_MOTION, Writer.ESTIMATION),
        health=bus.publisher(topics.SLAM, Writer.ESTIMATION),
        events=bus.event_sink(),
    )


def _other_lidar(config: TruckConfig, bus: Bus) -> OtherLidar | None:
    lidar, role = config.devices.lidar_2, DeviceRole.LIDAR_2
    if lidar is None:
        return None
    angles = scan_angles(config, bus, fifo(ODOMETRIES), role)
    return OtherLidar(lidar.mount, bus.subscribe(topics.SCAN_2, latest()), angles)
