"""One simulated robot in its world, with its device models."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import (
    AttitudeSource,
    Horn,
    ImuSource,
    JointSource,
    ScannedRoom,
    ServoPlant,
    SonarSource,
    WheelSource,
)
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.extras import not_installed
from monstertruck_runtime.map_files import load_map
from monstertruck_sim.world.board import BoardHolder
from monstertruck_sim.world.built_in import BUILT_IN, BuiltIn
from monstertruck_sim.world.camera import SimulatedView
from monstertruck_sim.world.config import TiltConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Obstacle
from monstertruck_sim.world.plane import Engine, PlanOutline, plane
from monstertruck_sim.world.plant import Caster, Plant, TruthState
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.sensors import (
    SimulatedCompass,
    SimulatedImu,
    SimulatedLidar,
    SimulatedMotor,
    SimulatedRearWheels,
    SimulatedServos,
)
from monstertruck_sim.world.sonar import SimulatedSonars
from monstertruck_sim.world.terrain import load_profile, profile_path

log = logging.getLogger(__name__)


class World:
    """One robot in its surroundings, with its sensors; it advances when a later time is requested.

    The state is a function of the configuration, the seed, the commands and their times. Time starts at the first
    requested time.

    Args:
        config: see ``WorldConfig``.
        seed: seed for all noise.
        scene: surroundings shared with other robots, or None to build them from ``config``.
        name: robot name.
        lidar: whether the robot carries a lidar; its weight matters in the rigid-body engine.

    Raises:
        InputError: the map name is unknown, a map or profile file is invalid, or the start pose is in a wall, a robot
            or a person.
    """

    def __init__(
        self,
        config: WorldConfig,
        seed: int,
        scene: Surroundings | None = None,
        name: str = "truck",
        *,
        lidar: bool = True,
    ) -> None:
        self.scene = scene if scene is not None else make_scene(config, seed)
        self.name = name
        place = self.scene.place
        start = _start(config, place)
        noise_seed = seed if config.noise else None
        self.map = place.map
        self._footprint = PlanOutline(self.scene, config.truck, name)
        if self.scene.overlap(self.scene.solid, self._footprint.box(start)) > 0:
            raise InputError(f"start: the robot at {start} touches what is not free on the map {config.map}")
        self._plant, self._space, sweep_of, solids = make_engine(
            config, self._footprint, start, noise_seed, lidar=lidar
        )
        self._plant.together = self.scene.advance
        self._plant.chargers = config.chargers
        self._plant.on_blocked = self._footprint.blocked
        self.scene.add_body(self)
        cast = self._space.cast
        self._lidar = SimulatedLidar(self._plant, sweep_of(config.lidar), config.lidar, noise_seed)
        self.lidar: ScannedRoom = self._lidar
        other_seed = None if noise_seed is None else noise_seed + 1
        lidar_2 = SimulatedLidar(self._plant, sweep_of(config.lidar_2), config.lidar_2, other_seed)
        self.lidar_2: ScannedRoom = lidar_2
        pitch, roll = config.mount.pitch, config.mount.roll
        self._horns = Horn(pitch.zero, pitch.direction), Horn(roll.zero, roll.direction)
        self.view = make_view(config, self._plant, cast, self.scene, seed)
        self._lidar.board_at = lidar_2.board_at = self.view.board_at
        self.motors: tuple[SimulatedMotor, ...] = tuple(
            SimulatedMotor(self._plant, config.truck.motor, noise_seed, i) for i in range(len(self._plant.shafts))
        )
        self._battery_input = config.battery.channel
        self.servos: ServoPlant = SimulatedServos(self._plant, config.battery, noise_seed)
        self.compass: AttitudeSource = SimulatedCompass(self._plant, config.compass, noise_seed)
        self.sonars: SonarSource = SimulatedSonars(
            self._plant, cast, config.sonar, noise_seed, config.lidar.wall_height, solids
        )
        self.imu: ImuSource = SimulatedImu(self._plant, config.imu, noise_seed)
        self.wheels: WheelSource = SimulatedRearWheels(self._plant, config.truck)

    def battery_volts(self, time_ns: int) -> float:
        """Return the output voltage of the battery divider."""
        return self.servos.analog_volts(self._battery_input, time_ns)

    @property
    def plant(self) -> Plant:
        """The robot's physics."""
        return self._plant

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles in the world that are not on the map."""
        return self._space.obstacles

    # Interface to the other bodies in the scene

    @property
    def outline(self) -> Box:
        """Latest footprint."""
        return self._footprint.box(self._plant.pose)

    @property
    def pace(self) -> float:
        """Latest speed of the footprint's fastest point (m/s)."""
        return self._footprint.pace(self._plant.twist)

    def integrate(self, time_ns: int) -> None:
        """Integrate this robot alone up to a time."""
        self._plant.integrate(time_ns)

    def outlines(self, times_ns: NDArray[np.int64]) -> list[Box]:
        """Return the footprints at times within the last half second."""
        return [self._footprint.box((x, y, yaw)) for x, y, yaw in self._plant.poses(times_ns)[:3].T.tolist()]

    def truth(self, time_ns: int) -> TruthState:
        """Return the ground truth at ``time_ns``, or at the latest requested time if that is later."""
        self._plant.advance(time_ns)
        return self._plant.truth()

    def horns(self) -> tuple[Horn, Horn]:
        """Return the horns of the mount's pitch and roll servos."""
        return self._horns

    def carry_lidar(self, joints: JointSource) -> None:
        """Put the lidar on a jointed mount."""
        self._lidar.joints = self._plant.joints = joints

    def mount_torque(self, joint: int) -> float:
        """Return the latest load torque of the lidar on its pitch (0) or roll (1) joint (Nm)."""
        return self._plant.mount_torque(joint)

    def is_free(self, pose: Pose2) -> bool:
        """Whether ``pose`` is collision-free: x, y (m) and yaw (rad) in the map frame."""
        solid = self.scene.overlap(self.scene.solid, self._footprint.box(pose))
        return bool(solid + self._space.contact(*pose) <= 0)

    def carry(self, time_ns: int, pose: Pose2) -> None:
        """Move the truck to another ``pose``: x, y (m) and yaw (rad) in the map frame.

        Raises:
            InputError: the pose is not collision-free.
        """
        if not self.is_free(pose):
            raise InputError(f"carry: the robot at {pose} touches occupied or unknown cells")
        self._plant.advance(time_ns)
        self._plant.carry(pose)

    def add(self, time_ns: int, obstacle: Obstacle) -> None:
        """Add an obstacle that the lidar sees and that stops the truck."""
        self._plant.advance(time_ns)
        self._space.add(obstacle)

    def remove(self, time_ns: int, obstacle: Obstacle) -> None:
        """Remove an obstacle.

        Raises:
            InputError: the obstacle is not in the world.
        """
        self._plant.advance(time_ns)
        self._space.remove(obstacle)

    def set_charge(self, time_ns: int, charge: float) -> None:
        """Replace the battery with one whose state of charge is ``charge`` (0..1)."""
        self._plant.advance(time_ns)
        self._plant.battery.set_charge(charge)

    def connect_battery(self, time_ns: int, *, connected: bool) -> None:
        """Connect or disconnect the battery; the caller handles the devices that lose their supply."""
        self._plant.advance(time_ns)
        self._plant.battery.connected = connected

    def supply_servos(self, time_ns: int, *, on: bool) -> None:
        """Switch the 5 V supply of the steering servos, which hold their position without it."""
        self._plant.advance(time_ns)
        self._plant.servo_supply = on

    def powered(self, time_ns: int) -> tuple[bool, ...]:
        """Return for each driven shaft whether its motor's power stage is on."""
        self._plant.advance(time_ns)
        return tuple(shaft.powered for shaft in self._plant.shafts)

    def block_shaft(self, time_ns: int, shaft: int = 0, *, on: bool) -> None:
        """Block or release a driven shaft."""
        self._plant.advance(time_ns)
        self._plant.shafts[shaft].blocked = on

    def shaft_blocked(self, shaft: int = 0) -> bool:
        """Whether a driven shaft is blocked."""
        return self._plant.shafts[shaft].blocked

    def set_tilt(self, time_ns: int, tilt: TiltConfig) -> None:
        """Change the truck's tilt."""
        self._plant.advance(time_ns)
        self._space.set_tilt(tilt)


def make_engine(config: WorldConfig, footprint: PlanOutline, start: Pose2, seed: int | None, *, lidar: bool) -> Engine:
    """Create the engine that the setting ``engine`` selects, for one robot.

    Raises:
        NotInstalledError: the engine's library is not installed.
    """
    if config.engine == "mujoco":
        try:
            from monstertruck_sim.world3d.engine import rigid  # noqa: PLC0415  # the library of an extra
        except ModuleNotFoundError as error:
            raise not_installed(f"sim.world.engine mujoco: {error.name}", "sim3d") from error
        return rigid(config, footprint, start, lidar=lidar)
    return plane(config, footprint, start, seed)


def make_view(config: WorldConfig, plant: Plant, cast: Caster, scene: Surroundings, seed: int) -> SimulatedView:
    """Create the camera view, drawn in the plane or rendered.

    Raises:
        NotInstalledError: this computer cannot render, or the library for tags is not installed.
    """
    drawn = SimulatedView(
        plant,
        cast,
        config.camera,
        tags=config.tags,
        crowd=scene,
        holder=None if config.board is None else BoardHolder(config.board, config.camera.field_of_view, seed),
        wall_height=config.lidar.wall_height,
        seed=seed if config.noise else None,
    )
    if not config.camera.rendered:
        return drawn
    from monstertruck_sim.world3d.camera import RenderedView  # noqa: PLC0415  # the library of an extra

    return RenderedView(drawn)


def make_scene(config: WorldConfig, seed: int, others: Sequence[WorldConfig] = ()) -> Surroundings:
    """Create the surroundings for the robots of one world.

    Args:
        config: world of the first robot, which defines the map and the people.
        seed: seed for the people.
        others: worlds of the other robots, which define their start poses.

    Raises:
        InputError: the map name is unknown, a map or profile file is invalid, or a person's path is not free.
    """
    place = _find(config.map)
    return Surroundings(place, config.people, seed, [_start(each, place) for each in (config, *others)])


def _start(config: WorldConfig, place: BuiltIn) -> Pose2:
    start = config.start
    return (start.x, start.y, start.yaw) if start else place.start


def _find(name: str) -> BuiltIn:
    """Return a built-in world, or load the map file at that path and the ground profile in the same folder."""
    if name in BUILT_IN:
        return BUILT_IN[name]()
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"map: {name!r}: expected one of {', '.join(BUILT_IN)}, or the path of a map's .yaml file")
    profile, known = profile_path(path), load_map(path)
    for remark in known.remarks:
        log.warning("%s", remark)
    return BuiltIn(known.trinary(), (0.0, 0.0, 0.0), load_profile(profile) if profile.exists() else None)
