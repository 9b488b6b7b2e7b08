"""The configuration of one robot or experiment: the root of the YAML file."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from monstertruck_drivers.config import Devices, Monitors
from monstertruck_drivers.scanning.config import sheet
from monstertruck_drivers.shafts import MotorLimits, SteeringOutputs, motor_limits
from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_estimation.catalog import AnyOdometry
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.ground.config import GroundConfig
from monstertruck_estimation.odometry import OdometryConfig
from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.rear_wheels import RearWheelConfig
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_kinematics.chassis import AXLES, WHEEL_REACH, Chassis, Dimensions, TricycleChassis
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_planners.behave.api import BehaviourConfig
from monstertruck_planners.behave.catalog import AnyBehaviour, AnyLevelling
from monstertruck_planners.behave.dock.config import DockConfig, DockingConfig, UndockConfig
from monstertruck_planners.behave.follow import FollowConfig
from monstertruck_planners.behave.lidar_sonars import LidarSonarsConfig
from monstertruck_planners.behave.move import MoveConfig
from monstertruck_planners.behave.stabiliser import StabiliserConfig
from monstertruck_planners.explore.catalog import AnyExplorer
from monstertruck_planners.goals.config import DRIVEN, PlannerConfig
from monstertruck_planners.track.catalog import AnyTracker
from monstertruck_planners.track.config import STEERING_MODES
from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_runtime.bodies import AnyBody, build_chassis
from monstertruck_runtime.slowness import Board
from monstertruck_schemas.base import Name, Schema
from monstertruck_schemas.body import Metres, TruckBody
from monstertruck_schemas.roles import SHAFTS, DeviceRole
from monstertruck_schemas.topics import COMPASS
from monstertruckd.bus.zenoh_config import PeerConfig, ZenohConfig
from monstertruckd.config.device_safety import beyond_devices, packs, unattended_times, weakened_devices
from monstertruckd.config.pace import too_slow
from monstertruckd.gate.catalog import AnyCheck
from monstertruckd.gate.config import BodyLimits, GateConfig, impossible_settings, weakened, weaker
from monstertruckd.gate.hand import HandConfig
from monstertruckd.recorder.config import BlackBoxConfig, MapRender, RecorderConfig

ROBOT: Final = "truck"
"""Default name of a robot."""
BLIND: Final = "devices: no range sensor: the robot does not stop for obstacles"

UNCOMPARED: Final = "consistency null: sensors with wrong readings are not found"

MOVE: Final = "move"
"""Name of the behaviour of every robot."""
DOCKING: Final = {"dock": DockingConfig, "undock": UndockConfig}
"""Behaviours of every robot with docks."""


class Geometry(Schema):
    """Dimensions of the truck's body (default: the author's robot)."""

    wheelbase: Metres = 0.32
    """Distance between front and rear axle, m; without axles, of the bicycle model in requests"""
    track: Metres = 0.26
    """Distance between left and right wheel centres, m"""
    wheel_radius: Metres = 0.075
    """Wheel radius, m"""
    drive_ratio: Annotated[float, Field(ge=1, le=5000)] = 644.0
    """Motor turns per wheel turn"""
    length: Metres = 0.47
    """Length over the bumpers, m"""
    width: Metres = 0.34
    """Width over the wheels, m"""
    mass: Annotated[float, Field(gt=0, le=1000)] = 7.25
    """Mass, kg"""
    pull: Annotated[float, Field(gt=0, le=10_000)] = 25.0
    """Maximum total force of all driven wheels at the ground, N, such as the slip limit of the clutch"""

    @model_validator(mode="after")
    def _possible(self) -> Self:
        impossible = (
            f"length {self.length} m is less than the wheelbase {self.wheelbase} m"
            if self.length < self.wheelbase
            else f"width {self.width} m is less than the track {self.track} m"
            if self.width < self.track
            else f"wheels of radius {self.wheel_radius} m touch at a wheelbase of {self.wheelbase} m"
            if self.wheelbase <= 2 * self.wheel_radius
            else None
        )
        if impossible is not None:
            raise ValueError(f"impossible geometry: {impossible}")
        return self


class PathConfig(Schema):
    """A path drawn in advance: started by name or, for an emulated robot, by arming."""

    file: Path
    """CSV with the header x,y,yaw,direction: metres, metres, radians, +1 or -1"""
    closed: bool = False
    """Whether the path is a closed lap"""


class PlacementConfig(Schema):
    """Placement of planners and tracker: in the daemon's loop, in a worker, or on another machine (`plan-server`)."""

    planner: Literal["loop", "worker", "remote"] = "worker"
    """Placement of the planner; `loop` is for studies only, because planning blocks the control tick"""
    local_planner: Literal["loop", "worker", "remote"] = "worker"
    """Placement of the tracker, as `planner`"""
    tracker: Literal["loop", "worker", "remote"] = "loop"
    """As `planner`."""
    explorer: Literal["loop", "worker", "remote"] = "worker"
    """As `planner`."""
    slowness: Annotated[float, Field(gt=0, le=1000)] | Board | None = None
    """For studies on the virtual clock only: factor on all computing times. `xu4` (5) and `pi2` (20) are estimates;
    null: declared latencies only, and runs are reproducible
    """


class TruckConfig(Schema):
    """The configuration of one robot: the root of the YAML file."""

    FILE_KEYS: ClassVar[tuple[tuple[str, ...], ...]] = (
        ("path", "file"),
        ("planner", "map"),
        ("zones", "file"),
        ("zones", "keepout_mask", "map"),
        ("zones", "speed_mask", "map"),
    )
    """Keys of files that must exist; relative to the configuration file that contains the key."""

    version: Literal[2]
    robot: Name = ROBOT
    """Name of this robot in all keys"""
    body: AnyBody = TruckBody()
    """Kind of robot, with settings specific to this kind"""
    geometry: Geometry = Geometry()
    devices: Devices
    monitors: Monitors = Monitors()
    usb: UsbConfig = UsbConfig()
    machine: Path = Path("/")
    """Folder that contains proc, sys and dev of the computer, or of a simulated computer"""
    levelling: AnyLevelling = StabiliserConfig()
    """How the stabiliser follows the compass, if both exist"""
    gate: GateConfig = GateConfig()
    hand: HandConfig = HandConfig()
    """Use of the operator's radio control (`devices.hand`)"""
    checks: dict[Name, AnyCheck] = Field(default_factory=dict)
    """Additional checks of the safety gate, by name; they can only make it stricter"""
    odometry: AnyOdometry = OdometryConfig()
    """Dead reckoning, or the fusion of wheels, compass and scans"""
    tracker: AnyTracker | None = None
    """Tracker of paths; null: the robot follows none."""
    planner: PlannerConfig | None = None
    """How the robot drives to goals; null: it only follows given paths"""
    explorer: AnyExplorer | None = None
    """How the robot explores unknown ground; null: it does not explore"""
    behaviours: dict[Name, AnyBehaviour] = Field(default_factory=dict, validate_default=True)
    """Reactive behaviours (without a path) by name; started by `behave start`. `move` always exists"""
    docks: dict[Name, DockConfig] = Field(default_factory=dict)
    """Docks by name; with any dock, the behaviours `dock` and `undock` exist"""
    lidar_sonars: LidarSonarsConfig | None = None
    """Sonar ranges computed from the lidar, for behaviours of a robot without sonars; null: none"""
    peers: dict[Name, PeerConfig] = Field(default_factory=dict)
    """Other robots whose poses are received, by name, for behaviours such as `follow`"""
    placement: PlacementConfig = PlacementConfig()
    path: PathConfig | None = None
    map: MapRender | None = None
    slam: SlamConfig | None = None
    """Mapping, or localisation in a saved map, by the lidar; null: the pose in map is odometry"""
    consistency: ConsistencyConfig | None = ConsistencyConfig()
    """Comparison of independent motion measurements, which reveals wrong sensors; null: none"""
    ground: GroundConfig | None = GroundConfig()
    """Tilt and roughness of the ground, for the routes of a robot with a compass; null: none"""
    points: PointsConfig | None = None
    """Points of interest in the map: tags seen by the camera (extra vision), and marked places; null: none"""
    zones: ZonesConfig | None = None
    """Keepout and speed zones of the map; null: none, and operators cannot add any"""
    recorder: RecorderConfig | None = None
    blackbox: BlackBoxConfig | None = BlackBoxConfig()
    """Saves the last minute before every stop by the gate; null: off"""
    zenoh: ZenohConfig = ZenohConfig()
    state_directory: Path = Path("runs/state")
    """Folder of the e-stop latch and other state"""
    runtime_directory: Path | None = None
    """Folder on a tmpfs for the mark of an emergency stop that is not yet on the disk; null: the service's, the user's,
    or /run
    """
    calibration: Path | None = None
    """Folder of the calibration files; null: `calibration` in the state directory"""
    stand: Literal["none", "simulator", "overhead"] = "none"
    """Source of the true pose on `mt/stand/sensor/pose_<robot>`, which is recorded; with cameras, only the consistency
    check uses it
    """
    sim: Any = None
    """Settings of the simulation; `simulate` and `config show` check them, the daemon ignores them"""

    @field_validator("behaviours")
    @classmethod
    def _with_move(cls, behaviours: dict[str, BehaviourConfig]) -> dict[str, BehaviourConfig]:
        moves = {MOVE: MoveConfig(), **behaviours}
        if not isinstance(moves[MOVE], MoveConfig):
            raise ValueError(f"{MOVE}: expected kind move, which the command of this name starts")
        return moves

    @property
    def all_behaviours(self) -> dict[str, BehaviourConfig]:
        """Configured behaviours, and those added by docks."""
        if not self.docks:
            return dict(self.behaviours)
        given = {name: self.behaviours.get(name, kind()) for name, kind in DOCKING.items()}
        return {
            **self.behaviours,
            **{name: behaviour.model_copy(update={"docks": self.docks}) for name, behaviour in given.items()},
        }

    @property
    def own_planner(self) -> PlannerConfig | None:
        """Settings of the robot's own planner; None without one, or if ROS 2 plans."""
        return None if self.planner is None or self.planner.mode == "ros2" else self.planner

    def chassis(self) -> Chassis:
        """The body's kinematics.

        Raises:
            KinematicsError: the dimensions are impossible.
        """
        geometry, steering = self.geometry, self.devices.steers()
        dimensions = Dimensions(
            DriveTrain(geometry.drive_ratio, geometry.wheel_radius), geometry.wheelbase, geometry.track
        )
        if steering is not None:
            dimensions = replace(dimensions, servo_ranges=steering[1].axles)
        chassis: Chassis = build_chassis(self.body, dimensions)
        return chassis

    @property
    def emulated(self) -> bool:
        """Whether every device is emulated: decided by the section ``sim``, which is refused with real ports."""
        return self.sim is not None

    @property
    def calibration_folder(self) -> Path:
        """Folder of calibration files."""
        return self.calibration or self.state_directory / "calibration"

    @property
    def black_box_folder(self) -> Path | None:
        """Folder of black boxes; None without them."""
        if self.blackbox is not None and self.blackbox.directory is not None:
            return Path(self.blackbox.directory)
        return None if self.blackbox is None or self.recorder is None else Path(self.recorder.directory) / "blackbox"

    @property
    def body_limits(self) -> BodyLimits:
        """Physical limits of this body, which the gate's settings must respect."""
        geometry, lidar = self.geometry, self.devices.lidar
        train = DriveTrain(geometry.drive_ratio, geometry.wheel_radius)
        limits = [motor_limits(device.driver) for device in self.devices.shafts().values()]
        speeds = [train.speed(limit.rate) for limit in limits if limit is not None]
        return BodyLimits(
            length=geometry.length,
            mass=geometry.mass,
            pull=geometry.pull,
            motor_speed=min(speeds, default=None),
            sight=None if lidar is None else sheet(lidar.driver).sure - geometry.length / 2 + lidar.mount.x,
        )

    def weakened(self) -> tuple[str, ...]:
        """Settings less safe than their defaults, each with its value and the default."""
        opened = (f"zenoh.insecure: anyone who can reach {end} may drive" for end in self.zenoh.open_endpoints)
        sees = self.devices.lidar is not None or self.devices.sonar is not None
        blind = () if sees or self.gate.scan.critical else (BLIND,)
        devices = weakened_devices(self.devices, self.monitors)
        housings = (
            f"docks.{name}.housing: lidar returns in it are ignored while the robot docks"
            for name, dock in self.docks.items()
            if dock.housing is not None
        )
        return (*weakened(self.gate), *blind, *self._weakened_comparison(), *devices, *opened, *housings)

    def _weakened_comparison(self) -> Iterator[str]:
        usual, above = ConsistencyConfig(), ("slip", "slide", "delay", "drift")
        if self.consistency is None:
            yield UNCOMPARED
        else:
            yield from weaker("consistency", self.consistency, usual, above, ())

    def missing_actuators(self) -> str | None:
        """Missing devices without which the body cannot drive and steer."""
        chassis = self.chassis()
        needed = (*SHAFTS[: len(chassis.shafts)], *((DeviceRole.STEERING,) if chassis.steered else ()))
        steering = self.devices.steers()
        there = {DeviceRole.STEERING} if steering is not None else set()
        if set(needed) <= there | self.devices.present().keys() | self.devices.shafts().keys():
            return None
        return f"the devices {', '.join(needed[:-1])} and {needed[-1]}"

    @model_validator(mode="after")
    def _complete(self) -> Self:
        self._check_actuators()
        body = self.body_limits
        times = unattended_times(self.devices)
        devices = beyond_devices(self.devices, self.monitors, self.gate.standstill, body)
        compared = self.consistency is not None
        pace = too_slow(self.gate.speed, self.odometry, self.tracker, self.planner, self.slam, consistent=compared)
        for excess in (*impossible_settings(self.gate, body, times), *devices, *pace):
            raise ValueError(excess)
        if self.gate.attitude is None and self.devices.measures(COMPASS):
            raise ValueError("gate.attitude null: a device measures the attitude; expected limits, or omit the line")
        self._check_planner()
        if self.behaviours.keys() - {MOVE} and (lack := self.missing_actuators()):
            raise ValueError(f"behaviours need {lack}")
        if self.explorer is not None and (self.own_planner is None or self.slam is None or self.slam.mode != "mapping"):
            raise ValueError("an explorer needs a planner, which drives to its goals, and slam in mode mapping")
        for name, behaviour in self.behaviours.items():
            if isinstance(behaviour, FollowConfig) and behaviour.leader not in self.peers:
                raise ValueError(f"behaviours.{name}.leader {behaviour.leader}: expected one of peers")
        self._check_docks()
        if self.robot in self.peers:
            raise ValueError(f"peers.{self.robot}: expected other robots than this one")
        if self.lidar_sonars is not None and (self.devices.lidar is None or self.devices.sonar is not None):
            raise ValueError("lidar_sonars needs the device lidar, and no device sonar")
        self._check_slam()
        if self.devices.lidar_2 is not None and self.devices.lidar is None:
            raise ValueError("devices.lidar_2: expected as a second lidar; call the only one lidar")
        measuring = [place for place, _ in packs(self.devices, self.monitors)]
        if len(measuring) > 1:
            raise ValueError(f"{' and '.join(measuring)} both measure the battery; set one of them null")
        return self

    def _check_docks(self) -> None:
        for name, kind in DOCKING.items():
            if not isinstance(self.behaviours.get(name, kind()), kind):
                raise ValueError(f"behaviours.{name}: expected kind {name}, which the command of this name starts")
        if not self.docks:
            return
        if self.points is None or self.devices.camera is None:
            raise ValueError("docks need the section points and the device camera, which see their tags")
        if lack := self.missing_actuators():
            raise ValueError(f"docks need {lack}")
        measured = any(True for _ in packs(self.devices, self.monitors))
        for name, dock in self.docks.items():
            if dock.charging is not None and not measured:
                raise ValueError(f"docks.{name}.charging: no device measures the battery; expected null")

    def _check_actuators(self) -> None:
        chassis = self.chassis()
        shafts = self.devices.shafts()
        if shafts and set(shafts) != set(SHAFTS[: len(chassis.shafts)]):
            wanted = ", ".join(f"{role} ({shaft})" for role, shaft in zip(SHAFTS, chassis.shafts, strict=False))
            raise ValueError(f"body {self.body.kind} is driven by {wanted}; got {', '.join(shafts)}")
        if self.devices.encoders is not None and not isinstance(chassis, TricycleChassis):
            raise ValueError(f"devices.encoders: expected of body tricycle, body is {self.body.kind}")
        if isinstance(self.odometry, RearWheelConfig) and self.devices.encoders is None:
            raise ValueError("odometry.kind encoders needs the device encoders")
        if (steering := self.devices.steers()) is not None:
            self._check_servos(*steering, chassis)
        if self.tracker is not None:
            if lack := self.missing_actuators():
                raise ValueError(f"a tracker needs {lack}")
            if why := chassis.refusal(*STEERING_MODES[self.tracker.steering]):
                raise ValueError(
                    f"tracker.steering {self.tracker.steering}: impossible for body {self.body.kind}: {why}"
                )
        for role, device in shafts.items():
            if (limits := motor_limits(device.driver)) is not None:
                self._check_braking(role, limits)

    def _check_servos(self, role: str, outputs: SteeringOutputs, chassis: Chassis) -> None:
        wanted, reaches = len(chassis.straight), outputs.reaches
        if len(reaches) != wanted:
            has = f"has {wanted} servos" if chassis.steered else "has no steering"
            raise ValueError(
                f"body {self.body.kind} {has}: expected front_right and rear_right of devices.{role}"
                f" {'given' if wanted > len(reaches) else 'null'}"
            )
        if (0.0, 0.0) in reaches and chassis.freedom != "front":
            raise ValueError(f"body {self.body.kind} steers more than its front axle: devices.{role} has one servo")
        if wanted > len(AXLES) and (reach := min(abs(end) for ends in reaches for end in ends)) < WHEEL_REACH - 1e-3:
            raise ValueError(
                f"devices.{role}: pulses reach {math.degrees(reach):.0f} degrees to one side: expected "
                f"{math.degrees(WHEEL_REACH):.0f} for individually steered wheels"
            )

    def _check_slam(self) -> None:
        slam = self.slam
        if slam is None:
            return
        if slam.mode == "ros2" and (lack := self.missing_actuators()):
            raise ValueError(f"slam.mode ros2 needs {lack}: it corrects odometry")
        if slam.mode != "ros2" and self.devices.lidar is None:
            raise ValueError("slam needs the device lidar, except in mode ros2")
        if slam.mode == "localisation" and slam.map is None:
            raise ValueError("slam.mode localisation needs slam.map, the folder of a saved map")

    def _check_planner(self) -> None:
        planner = self.planner
        if planner is None:
            return
        if planner.mode == "ros2":
            if not self.gate.remote_trackers:
                raise ValueError(
                    "planner.mode ros2 needs gate.remote_trackers: the driving node, such as ros2:velocity_smoother"
                )
            return
        if self.tracker is None:
            raise ValueError("a planner needs a tracker, which follows its routes")
        if self.slam is None and planner.map is None:
            raise ValueError("a planner needs a map: set planner.map, or a slam mode that builds or loads one")
        if planner.angle > self.tracker.angle:
            raise ValueError(f"planner.angle {planner.angle} rad: expected at most tracker.angle, {self.tracker.angle}")
        chassis = self.chassis()
        for steering in DRIVEN[planner.steering]:
            if why := chassis.refusal(*STEERING_MODES[steering]):
                raise ValueError(f"planner.steering {planner.steering}: impossible for body {self.body.kind}: {why}")

    def _check_braking(self, role: str, limits: MotorLimits) -> None:
        """Check that the drive controller brakes at least as hard as the gate's stopping distances assume."""
        train = DriveTrain(self.geometry.drive_ratio, self.geometry.wheel_radius)
        for name, promised, rate in (
            ("deceleration", self.gate.deceleration, limits.deceleration),
            ("quick_deceleration", self.gate.quick_deceleration, limits.quick_deceleration),
        ):
            if promised > (braking := train.speed(rate)):
                raise ValueError(
                    f"gate.{name} {promised} m/s^2: the {role} is configured to brake with "
                    f"{rate / math.tau:.4g} motor turns/s^2, which is {braking:.2f} m/s^2"
                )
