"""One simulated world: map, obstacles, truck and the physics of its devices."""

from math import hypot
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import (
    AttitudeSource,
    ImuSource,
    JointSource,
    MotorPlant,
    RangeSource,
    ServoPlant,
    SonarSource,
    ViewSource,
)
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED, load_map
from monstertruck_sim.world.built_in import BUILT_IN, BuiltIn
from monstertruck_sim.world.config import SinusoidTilt, TiltConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Obstacle, discs_and_segments, penetration
from monstertruck_sim.world.raycast import cast_rays, clearance, grid_penetration
from monstertruck_sim.world.sensors import (
    SimulatedCompass,
    SimulatedImu,
    SimulatedLidar,
    SimulatedMotor,
    SimulatedServos,
    SimulatedView,
)
from monstertruck_sim.world.sonar import SimulatedSonars
from monstertruck_sim.world.terrain import LEVEL, Terrain, load_profile, profile_path, rocking
from monstertruck_sim.world.truck_plant import Pose, TruckPlant, TruthState

_ROOM = 0.05
"""Metres around the footprint: known to be free, they spare the contact test until the truck has crossed them."""


class World:
    """Map, truck and sensors in one simulation, which advances when a later instant is asked for.

    Everything is a function of configuration, seed, commands and their instants. The start of time is the first
    instant anybody names.

    Args:
        config: see ``WorldConfig``.
        seed: of all noise.

    Raises:
        InputError: unknown map name, a bad map or profile file, or a start pose in a wall.
    """

    def __init__(self, config: WorldConfig, seed: int) -> None:
        place = _find(config.map)
        start = (config.start.x, config.start.y, config.start.yaw) if config.start else place.start
        noise_seed = seed if config.noise else None
        self.map = place.map
        uneven = place.profile is not None or bool(config.rough)
        self._terrain = Terrain(place.profile or LEVEL, config.rough) if uneven else None
        self._tilt: TiltConfig = config.tilt
        self._truck = config.truck
        self._half_diagonal = hypot(config.truck.length, config.truck.width) / 2
        self._obstacles: tuple[Obstacle, ...] = ()
        self._discs, self._segments = discs_and_segments(())
        self._free: Pose | None = None
        """Pose with free room around."""
        if self._overlap(place.map.cells != FREE, start) > 0:
            raise InputError(f"start: the truck at {start} touches what is not free on the map {config.map}")
        self._occupied = place.map.cells == OCCUPIED
        self._clear = clearance(self._occupied)
        self._cast(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)  # compiles outside of any deadline
        self._plant = TruckPlant(config.truck, config.battery, start, self._contact, self._attitude, noise_seed)
        self._lidar = SimulatedLidar(self._plant, self._cast, self._terrain, config.lidar, noise_seed)
        self.lidar: RangeSource = self._lidar
        self.view: ViewSource = SimulatedView(self._plant, self._cast, config.camera)
        self.motors: tuple[MotorPlant, ...] = tuple(
            SimulatedMotor(self._plant, config.truck.motor, noise_seed, i) for i in range(len(self._plant.shafts))
        )
        self._battery_input = config.battery.channel
        self.servos: ServoPlant = SimulatedServos(self._plant, config.battery, noise_seed)
        self.compass: AttitudeSource = SimulatedCompass(self._plant, config.compass, noise_seed)
        self.sonars: SonarSource = SimulatedSonars(self._plant, self._cast, config.sonar, noise_seed)
        self.imu: ImuSource = SimulatedImu(self._plant, config.imu, noise_seed)

    def battery_volts(self, time_ns: int) -> float:
        """Voltage behind the battery's divider."""
        return self.servos.analog_volts(self._battery_input, time_ns)

    @property
    def motor(self) -> MotorPlant:
        """The first driven shaft, of the truck the only one."""
        return self.motors[0]

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles in the world that are not on its map."""
        return self._obstacles

    def truth(self, time_ns: int) -> TruthState:
        """What is really the case at ``time_ns`` (or at the newest instant asked for, if that is later)."""
        self._plant.advance(time_ns)
        return self._plant.truth()

    def carry_lidar(self, joints: JointSource) -> None:
        """Put the lidar onto a mount with joints."""
        self._lidar.joints = joints

    def carry(self, time_ns: int, pose: Pose) -> None:
        """Put the truck down at another ``pose``: x, y (m) and yaw (rad) in the map frame.

        Raises:
            InputError: it would touch what is not free there.
        """
        if self._overlap(self.map.cells != FREE, pose) > 0 or self._depth(pose) > 0:
            raise InputError(f"carry: the truck at {pose} touches what is not free")
        self._plant.advance(time_ns)
        self._plant.carry(pose)

    def add(self, time_ns: int, obstacle: Obstacle) -> None:
        """Put something into the world: seen by the lidar, stops the truck."""
        self._plant.advance(time_ns)
        self._set_obstacles((*self._obstacles, obstacle))

    def remove(self, time_ns: int, obstacle: Obstacle) -> None:
        """Take it away again.

        Raises:
            InputError: it is not there.
        """
        if obstacle not in self._obstacles:
            raise InputError(f"obstacle {obstacle}: not in the world")
        self._plant.advance(time_ns)
        index = self._obstacles.index(obstacle)
        self._set_obstacles(self._obstacles[:index] + self._obstacles[index + 1 :])

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
        self._tilt = tilt

    def _set_obstacles(self, obstacles: tuple[Obstacle, ...]) -> None:
        self._obstacles = obstacles
        self._discs, self._segments = discs_and_segments(obstacles)
        self._free = None

    def _contact(self, x: float, y: float, yaw: float) -> float:
        pose = (x, y, yaw)
        if self._free is not None and self._way(self._free, pose) < _ROOM:
            return 0.0
        self._free = pose if self._depth(pose, _ROOM) == 0.0 else None
        return 0.0 if self._free else self._depth(pose)

    def _way(self, a: Pose, b: Pose) -> float:
        """No point of the footprint is further from its place at the other pose than this, m."""
        return hypot(b[0] - a[0], b[1] - a[1]) + abs(b[2] - a[2]) * self._half_diagonal

    def _depth(self, pose: Pose, room: float = 0.0) -> float:
        """How deep the footprint, grown by ``room`` all around, reaches into things, m."""
        depth = self._overlap(self._occupied, pose, room)
        if self._obstacles:
            x, y, yaw = pose
            footprint = Box(x, y, self._truck.length + 2 * room, self._truck.width + 2 * room, yaw)
            depth += sum(penetration(footprint, obstacle) for obstacle in self._obstacles)
        return depth

    def _overlap(self, solid: NDArray[np.bool_], pose: Pose, room: float = 0.0) -> float:
        (x, y, yaw), (x0, y0), truck = pose, self.map.origin, self._truck
        depth: float = grid_penetration(
            solid, self.map.resolution, x - x0, y - y0, yaw, truck.length + 2 * room, truck.width + 2 * room
        )
        return depth

    def _cast(self, xs: Array, ys: Array, angles: Array, reach: float) -> Array:
        ranges: Array = cast_rays(
            self._clear, self.map.resolution, *self.map.origin, xs, ys, angles, reach, self._discs, self._segments
        )
        return ranges

    def _attitude(self, elapsed_ns: int, x: float, y: float, yaw: float) -> tuple[float, float]:
        if isinstance(self._tilt, SinusoidTilt):
            return rocking(self._tilt, elapsed_ns)
        if self._terrain is None:
            return 0.0, 0.0
        return self._terrain.tilt(x, y, yaw, self._truck.wheelbase, self._truck.track)


def _find(name: str) -> BuiltIn:
    """A built-in world, or the map file of that path with the ground profile in the same folder."""
    if name in BUILT_IN:
        return BUILT_IN[name]()
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"map: {name!r}: expected one of {', '.join(BUILT_IN)}, or the path of a map's .yaml file")
    profile = profile_path(path)
    return BuiltIn(load_map(path), (0.0, 0.0, 0.0), load_profile(profile) if profile.exists() else None)
