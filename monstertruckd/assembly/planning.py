"""Builds path source, tracker, goals, levelling and map picture of a configuration, each with its ends of the bus."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

from monstertruck_drivers.config import Devices
from monstertruck_kinematics.chassis import Chassis
from monstertruck_planners.behave.api import BehaviourBody
from monstertruck_planners.behave.catalog import LEVELLING
from monstertruck_planners.behave.lidar_sonars import LidarSonars
from monstertruck_planners.behave.service import BehaviourService
from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.config import ExplorerConfig
from monstertruck_planners.explore.exchange import CameraView, ExploreSetup
from monstertruck_planners.explore.service import TILES, ExplorerInputs, ExplorerService
from monstertruck_planners.goals.config import PlannerConfig
from monstertruck_planners.goals.deformation import RouteDeformation
from monstertruck_planners.goals.exchange import Setup
from monstertruck_planners.goals.known_map import KnownMapService
from monstertruck_planners.goals.path_publisher import GoalInputs, GoalOutputs
from monstertruck_planners.goals.service import GoalService
from monstertruck_planners.missions.service import MissionInputs, MissionParts, MissionService
from monstertruck_planners.steps import DEFORMING, EXPLORING, PLANNING, PLANNING_BY_KIND, STEPS, TRACKING
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.drivable import require_drivable
from monstertruck_planners.track.paths import PathService, load_path
from monstertruck_planners.track.service import TrackerService, TrackSetup
from monstertruck_planners.zones.service import ZoneInputs, ZoneService
from monstertruck_runtime.actors.actor import ActorFactory
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.plugins import kind_of
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_runtime.service import Service
from monstertruck_runtime.threads import in_thread, inline
from monstertruck_schemas import topics
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import Writer
from monstertruckd.assembly.estimation import Body
from monstertruckd.bus.local import Bus
from monstertruckd.config.device_safety import packs
from monstertruckd.config.truck import PathConfig, TruckConfig
from monstertruckd.recorder.picture import MapService


def _drawn(config: PathConfig, frame: str, drivable: Callable[[Path], None], events: EventSink) -> Path | None:
    """The configured path; None, and an event, if its file cannot be used or the body cannot drive it."""
    try:
        path = load_path(config.file, closed=config.closed, frame=frame)
        drivable(path)
        return path
    except InputError as error:
        text = f"{error}; the robot starts without this path"
        events(Reason.FILE_DAMAGED, Severity.WARNING, ServiceName.PATH.value, text)
        return None


def build_planners(
    config: TruckConfig,
    bus: Bus,
    clock: Clock,
    body: Body,
    actors: ActorFactory,
    save_map: Callable[[], bool] | None = None,
) -> Iterator[Service]:
    """Path source and tracker where one is configured; goals, exploration; the lidar's levelling; the map's picture.

    ``save_map`` has the map saved as soon as possible, and returns whether it can be; None without mapping.
    """
    wanted = (config.tracker or config.behaviours) and config.missing_actuators() is None
    requests = bus.publisher(topics.PLAN_DRIVE, Writer.PLANNER) if wanted else None
    goals: GoalService | None = None
    explorer: ExplorerService | None = None
    if config.tracker is not None and requests is not None:
        tracker = config.tracker.model_copy(update={"angle": min(config.tracker.angle, body.chassis.reached_angle)})
        paths = bus.publisher(topics.PATH, Writer.PLANNER)
        frame = "odom" if config.slam is None else "map"
        drivable = partial(require_drivable, config=tracker, geometry=body.chassis.bicycle)
        yield PathService(
            None if config.path is None else _drawn(config.path, frame, drivable, bus.event_sink()),
            config.emulated,
            clock,
            bus.subscribe(topics.REQ_PATH, fifo(4)),
            bus.subscribe(topics.GATE, latest()),
            bus.subscribe(topics.BEHAVIOUR, latest()),
            bus.subscribe(topics.PATH, latest()),
            paths,
            bus.event_sink(),
            config.gate.max_request_age,
            drivable,
            inline if isinstance(clock, VirtualClock) else in_thread,
        )
        yield _build_tracker(config, tracker, bus, clock, body, requests, actors)
        if config.own_planner is not None:
            goals = build_goals(
                config, config.own_planner, bus, clock, body.chassis, body.footprint, paths, requests, actors
            )
            yield goals
            if config.own_planner.map is not None and (config.slam is None or config.slam.mode == "ros2"):
                yield KnownMapService(
                    config.own_planner.map,
                    frame,
                    clock,
                    bus.publisher(topics.MAP, Writer.ESTIMATION),
                    bus.event_sink(),
                    inline if isinstance(clock, VirtualClock) else in_thread,
                )
            if config.explorer is not None:
                explorer = _build_explorer(config, config.explorer, bus, clock, body, goals, actors, save_map)
                yield explorer
    lidar = config.devices.lidar
    if config.lidar_sonars is not None and lidar is not None:
        yield LidarSonars(
            config.lidar_sonars,
            lidar.mount.planar,
            clock,
            bus.subscribe(topics.SCAN, latest()),
            bus.publisher(topics.SONAR, Writer.DRIVER),
        )
    behaviours = None
    if config.behaviours and requests is not None:
        moved = BehaviourBody(body.chassis, config.gate.angle)
        behaviours = BehaviourService(config.all_behaviours, clock, bus, requests, config.gate.max_request_age, moved)
        yield behaviours
    if goals is not None:
        yield _build_missions(config, bus, clock, MissionParts(goals, behaviours, explorer, config.docks))
    if config.devices.stabiliser is not None and config.devices.compass is not None:
        yield LEVELLING.build(config.levelling, config.levelling, clock, bus)
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


def build_zones(config: TruckConfig, bus: Bus, clock: Clock, body: Body) -> ZoneService | None:
    """Build the zone service; None without zones."""
    zones = config.zones
    if zones is None:
        return None
    virtual = isinstance(clock, VirtualClock)
    return ZoneService(
        zones,
        clock,
        max_speed=config.gate.speed,
        footprint=body.footprint,
        file=None if virtual else config.state_directory / "zones.json",
        inputs=ZoneInputs(gate=bus.subscribe(topics.GATE, latest()), pose=bus.subscribe(topics.POSE, latest())),
        out=bus.publisher(topics.ZONES, Writer.PLANNER),
        events=bus.event_sink(),
        offload=inline if virtual else in_thread,
        max_age=config.gate.max_request_age,
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
        # 5.0: deadline of a remote tracker, s; the gate stops the truck long before
        actor = actors.actor(placement, TRACKING, STEPS[TRACKING], latency=0.0, deadline=5.0)
    return TrackerService(
        TrackSetup(
            with_response(tracker, config.devices),
            body.chassis.bicycle,
            body.footprint,
            body.points[0].mount,
            located=config.slam is not None,
            freedom=body.chassis.freedom if body.chassis.steered else None,
        ),
        clock,
        inputs=inputs,
        drive=requests,
        tracker=bus.publisher(topics.TRACKER, Writer.PLANNER),
        events=bus.event_sink(),
        actor=actor,
        points=body.points[0],
    )


def with_response(tracker: TrackerConfig, devices: Devices) -> TrackerConfig:
    """Return the tracker's settings; dead time and lag come from the servos unless configured."""
    steering = devices.steers()
    if steering is None or tracker.dead_time is not None or tracker.lag is not None:
        return tracker
    return tracker.model_copy(update={"dead_time": steering[1].dead_time, "lag": steering[1].lag})


PLANNER_START_TIMEOUT: Final = 180.0
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
    planner = _within_reach(planner, chassis.reached_angle)
    if config.slam is not None and config.slam.mode != "ros2":
        planner = planner.model_copy(update={"map": None})
    mount = lidar.mount.planar if lidar is not None else (0.0, 0.0, 0.0)
    obstacle = config.gate.obstacle
    setup = Setup(
        planner,
        chassis.bicycle,
        footprint,
        mount,
        cusp_clearance=obstacle.side_clearance + obstacle.ahead,
        zone_margin=0.0 if config.zones is None else config.zones.margin,
        seen_for=obstacle.memory_time if obstacle.unseen == "stop" else None,
        timed=not isinstance(clock, VirtualClock),
        speed=config.tracker.speed,
    )
    return GoalService(
        setup,
        clock,
        actors.actor(
            config.placement.planner,
            PLANNING,
            PLANNING_BY_KIND.get(kind_of(type(planner.route)) or "", STEPS[PLANNING]),
            latency=planner.latency,
            deadline=planner.deadline,
            start_timeout=PLANNER_START_TIMEOUT,
        ),
        deceleration=config.tracker.deceleration,
        max_age=config.gate.max_request_age,
        inputs=GoalInputs(
            goals=bus.subscribe(topics.REQ_GOAL, fifo(4)),
            controls=bus.subscribe(topics.REQ_GOAL_CONTROL, fifo(4)),
            gate=bus.subscribe(topics.GATE, latest()),
            pose=bus.subscribe(topics.POSE if mapped else topics.ODOMETRY, latest()),
            tracker=bus.subscribe(topics.TRACKER, latest()),
            path=bus.subscribe(topics.PATH, latest()),
            scan=bus.subscribe(topics.SCAN, latest()) if lidar is not None else None,
            grid=bus.subscribe(topics.MAP, latest()) if mapped else None,
            ground=bus.subscribe(topics.GROUND, latest()),
            behaviour=bus.subscribe(topics.BEHAVIOUR, latest()),
            slam=bus.subscribe(topics.SLAM, latest()) if mapped else None,
            seen=bus.subscribe(topics.SEEN, latest()) if lidar is not None else None,
            zones=None if config.zones is None else bus.subscribe(topics.ZONES, latest()),
        ),
        outputs=GoalOutputs(path, planner_request, bus.publisher(topics.GOAL, Writer.PLANNER), bus.event_sink()),
        deformation=_deformation(config, setup, bus, clock, actors),
    )


def _build_explorer(
    config: TruckConfig, explorer: ExplorerConfig, bus: Bus, clock: Clock, body: Body, goals: GoalService,
    actors: ActorFactory, save_map: Callable[[], bool] | None,
) -> ExplorerService:  # fmt: skip
    planner, lidar, camera = config.own_planner, config.devices.lidar, config.devices.camera
    assert planner is not None
    assert lidar is not None
    planner = _within_reach(planner, body.chassis.reached_angle)
    setup = ExploreSetup(
        explorer,
        body.footprint,
        body.chassis.bicycle.minimum_radius("front" if planner.steering == "2ws" else "counter", planner.angle),
        planner.route.margin,
        lidar.mount.planar,
        CameraView() if camera is None else CameraView(mount=camera.mount.planar),
        zone_margin=0.0 if config.zones is None else config.zones.margin,
    )
    actor = actors.actor(
        config.placement.explorer,
        EXPLORING,
        STEPS[EXPLORING],
        latency=explorer.latency,
        deadline=explorer.deadline,
        start_timeout=PLANNER_START_TIMEOUT,
    )
    inputs = ExplorerInputs(
        gate=bus.subscribe(topics.GATE, latest()),
        pose=bus.subscribe(topics.POSE, latest()),
        goal=bus.subscribe(topics.GOAL, latest()),
        grid=bus.subscribe(topics.MAP, latest()),
        tiles=bus.subscribe(topics.MAP_TILES, fifo(TILES)),
        slam=bus.subscribe(topics.SLAM, latest()),
        battery=bus.subscribe(topics.BATTERY, latest()),
        events=bus.subscribe(topics.EVENT, fifo(256)),
        health=bus.subscribe(topics.HEALTH, latest()),
        points=None if config.points is None or camera is None else bus.subscribe(topics.POINTS, latest()),
        zones=None if config.zones is None else bus.subscribe(topics.ZONES, latest()),
    )
    return ExplorerService(
        setup,
        clock,
        actor,
        goals,
        save_map,
        max_age=config.gate.max_request_age,
        inputs=inputs,
        state=bus.publisher(topics.EXPLORE, Writer.PLANNER),
        events=bus.event_sink(),
    )


def _build_missions(config: TruckConfig, bus: Bus, clock: Clock, parts: MissionParts) -> MissionService:
    virtual = isinstance(clock, VirtualClock)
    return MissionService(
        parts,
        clock,
        file=None if virtual else config.state_directory / "mission.json",
        localised=config.slam is not None and config.slam.mode == "localisation",
        offload=inline if virtual else in_thread,
        max_age=config.gate.max_request_age,
        inputs=MissionInputs(
            gate=bus.subscribe(topics.GATE, latest()),
            pose=bus.subscribe(topics.ODOMETRY if config.slam is None else topics.POSE, latest()),
            goal=bus.subscribe(topics.GOAL, latest()),
            behaviour=bus.subscribe(topics.BEHAVIOUR, latest()),
            explore=bus.subscribe(topics.EXPLORE, latest()),
            points=None if config.points is None else bus.subscribe(topics.POINTS, latest()),
            slam=None if config.slam is None else bus.subscribe(topics.SLAM, latest()),
            battery=bus.subscribe(topics.BATTERY, latest()) if list(packs(config.devices, config.monitors)) else None,
            lidar=config.devices.lidar is not None,
            zones=None if config.zones is None else bus.subscribe(topics.ZONES, latest()),
        ),
        state=bus.publisher(topics.MISSION, Writer.PLANNER),
        events=bus.event_sink(),
    )


def _within_reach(planner: PlannerConfig, angle: float) -> PlannerConfig:
    """Axle angles at most as large as the servos reach (rad)."""
    escape = planner.escape.model_copy(update={"angle": min(planner.escape.angle, angle)})
    return planner.model_copy(update={"angle": min(planner.angle, angle), "escape": escape})


def _deformation(
    config: TruckConfig, setup: Setup, bus: Bus, clock: Clock, actors: ActorFactory
) -> RouteDeformation | None:
    mapped, local = config.slam is not None, setup.config.local
    if setup.config.local_planner is None or config.devices.lidar is None:
        return None
    return RouteDeformation(
        setup,
        clock,
        actors.actor(
            config.placement.local_planner,
            DEFORMING,
            STEPS[DEFORMING],
            latency=local.latency,
            deadline=local.deadline,
            start_timeout=PLANNER_START_TIMEOUT,
        ),
        scan=bus.subscribe(topics.SCAN, latest()),
        pose=bus.subscribe(topics.POSE if mapped else topics.ODOMETRY, latest()),
        grid=bus.subscribe(topics.MAP, latest()) if mapped else None,
        events=bus.event_sink(),
        zones=None if config.zones is None else bus.subscribe(topics.ZONES, latest()),
        odometry=bus.subscribe(topics.ODOMETRY, latest()) if mapped else None,
    )
