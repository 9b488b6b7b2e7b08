"""One robot in a simulated world, and the physics of its devices."""

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
    """One robot in its surroundings, with its sensors; it advances when a later instant is requested.

    Everything is a function of configuration, seed, commands and their instants. The start of time is the first
    instant anybody names.

    Args:
        config: see ``WorldConfig``.
        seed: of all noise.
        scene: surroundings that it shares with other robots; None = its own, of ``config``.
        name: of the robot.
        lidar: whether it carries one: a robot of rigid bodies feels the weight.

    Raises:
        InputError: unknown map name, a bad map or profile file, or a start pose in a wall, a robot or a person.
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
        self._plant, self._space, sweep, solids = make_engine(config, self._footprint, start, noise_seed, lidar=lidar)
        self._plant.together = self.scene.advance
        self._plant.on_blocked = self._footprint.blocked
        self.scene.add_body(self)
        cast = self._space.cast
        self._lidar = SimulatedLidar(self._plant, sweep, config.lidar, noise_seed)
        self.lidar: ScannedRoom = self._lidar
        pitch, roll = config.mount.pitch, config.mount.roll
        self._horns = Horn(pitch.zero, pitch.direction), Horn(roll.zero, roll.direction)
        self.view = make_view(config, self._plant, cast, self.scene, seed)
        self._lidar.board_at = self.view.board_at
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
        """Voltage behind the battery's divider."""
        return self.servos.analog_volts(self._battery_input, time_ns)

    @property
    def plant(self) -> Plant:
        """What moves the robot."""
        return self._plant

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles in the world that are not on its map."""
        return self._space.obstacles

    # As the others in the scene see it

    @property
    def outline(self) -> Box:
        """PlanOutline at its newest instant."""
        return self._footprint.box(self._plant.pose)

    @property
    def pace(self) -> float:
        """Speed of its fastest point, m/s, at its newest instant."""
        return self._footprint.pace(self._plant.twist)

    def integrate(self, time_ns: int) -> None:
        """Move this robot alone on to an instant."""
        self._plant.integrate(time_ns)

    def outlines(self, times_ns: NDArray[np.int64]) -> list[Box]:
        """Footprints at instants of the last half second."""
        return [self._footprint.box((x, y, yaw)) for x, y, yaw in self._plant.poses(times_ns)[:3].T.tolist()]

    def truth(self, time_ns: int) -> TruthState:
        """What is really the case at ``time_ns`` (or at the newest instant requested, if that is later)."""
        self._plant.advance(time_ns)
        return self._plant.truth()

    def horns(self) -> tuple[Horn, Horn]:
        """Of the mount's pitch and roll servo."""
        return self._horns

    def carry_lidar(self, joints: JointSource) -> None:
        """Put the lidar onto a mount with joints."""
        self._lidar.joints = self._plant.joints = joints

    def mount_torque(self, joint: int) -> float:
        """With which the lidar pushes its pitch (0) or roll (1) joint, Nm, at the newest instant."""
        return self._plant.mount_torque(joint)

    def is_free(self, pose: Pose2) -> bool:
        """Whether the robot at ``pose``, x, y (m) and yaw (rad) in the map frame, would touch nothing."""
        solid = self.scene.overlap(self.scene.solid, self._footprint.box(pose))
        return bool(solid + self._space.contact(*pose) <= 0)

    def carry(self, time_ns: int, pose: Pose2) -> None:
        """Put the truck down at another ``pose``: x, y (m) and yaw (rad) in the map frame.

        Raises:
            InputError: it would touch what is not free there.
        """
        if not self.is_free(pose):
            raise InputError(f"carry: the robot at {pose} touches what is not free")
        self._plant.advance(time_ns)
        self._plant.carry(pose)

    def add(self, time_ns: int, obstacle: Obstacle) -> None:
        """Put something into the world: seen by the lidar, stops the truck."""
        self._plant.advance(time_ns)
        self._space.add(obstacle)

    def remove(self, time_ns: int, obstacle: Obstacle) -> None:
        """Take it away again.

        Raises:
            InputError: it is not there.
        """
        self._plant.advance(time_ns)
        self._space.remove(obstacle)

    def set_charge(self, time_ns: int, charge: float) -> None:
        """Exchange the battery for one charged to 0..1."""
        self._plant.advance(time_ns)
        self._plant.battery.set_charge(charge)

    def connect_battery(self, time_ns: int, *, connected: bool) -> None:
        """Plug the battery in or pull its plug; what then has no supply is not the world's business."""
        self._plant.advance(time_ns)
        self._plant.battery.connected = connected

    def supply_servos(self, time_ns: int, *, on: bool) -> None:
        """Switch the steering servos' own 5 V: without it they stay where they are."""
        self._plant.advance(time_ns)
        self._plant.servo_supply = on

    def powered(self, time_ns: int) -> tuple[bool, ...]:
        """Which driven shafts have a motor whose power stage is on."""
        self._plant.advance(time_ns)
        return tuple(shaft.powered for shaft in self._plant.shafts)

    def block_shaft(self, time_ns: int, shaft: int = 0, *, on: bool) -> None:
        """Hold a driven shaft, or let it go."""
        self._plant.advance(time_ns)
        self._plant.shafts[shaft].blocked = on

    def shaft_blocked(self, shaft: int = 0) -> bool:
        """Whether a driven shaft is held."""
        return self._plant.shafts[shaft].blocked

    def set_tilt(self, time_ns: int, tilt: TiltConfig) -> None:
        """From now on tilt the truck in another way."""
        self._plant.advance(time_ns)
        self._space.set_tilt(tilt)


def make_engine(config: WorldConfig, footprint: PlanOutline, start: Pose2, seed: int | None, *, lidar: bool) -> Engine:
    """What computes one robot: ``engine`` of the configuration.

    Raises:
        NotInstalledError: its library is not there.
    """
    if config.engine == "mujoco":
        try:
            from monstertruck_sim.world3d.engine import rigid  # noqa: PLC0415  # the library of an extra
        except ModuleNotFoundError as error:
            raise not_installed(f"sim.world.engine mujoco: {error.name}", "sim3d") from error
        return rigid(config, footprint, start, lidar=lidar)
    return plane(config, footprint, start, seed)


def make_view(config: WorldConfig, plant: Plant, cast: Caster, scene: Surroundings, seed: int) -> SimulatedView:
    """What the camera sees, drawn in the plane or rendered.

    Raises:
        NotInstalledError: this computer cannot render, or tags need a library that is not there.
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
    """Surroundings for the robots of one world.

    Args:
        config: the first robot's; map and people are its.
        seed: of the people.
        others: the further robots' worlds, for the places where they begin.

    Raises:
        InputError: unknown map name, a bad map or profile file, or a person's way that is not free.
    """
    place = _find(config.map)
    return Surroundings(place, config.people, seed, [_start(each, place) for each in (config, *others)])


def _start(config: WorldConfig, place: BuiltIn) -> Pose2:
    start = config.start
    return (start.x, start.y, start.yaw) if start else place.start


def _find(name: str) -> BuiltIn:
    """A built-in world, or the map file of that path with the ground profile in the same folder."""
    if name in BUILT_IN:
        return BUILT_IN[name]()
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"map: {name!r}: expected one of {', '.join(BUILT_IN)}, or the path of a map's .yaml file")
    profile, known = profile_path(path), load_map(path)
    for remark in known.remarks:
        log.warning("%s", remark)
    return BuiltIn(known.trinary(), (0.0, 0.0, 0.0), load_profile(profile) if profile.exists() else None)
