"""One robot in a simulated world, and the physics of its devices."""

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
from monstertruck_runtime.map_files import load_map
from monstertruck_sim.world.built_in import BUILT_IN, BuiltIn
from monstertruck_sim.world.config import SinusoidTilt, TiltConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Obstacle
from monstertruck_sim.world.scene import Surroundings
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
from monstertruck_sim.world.truck_plant import Pose, TruckPlant, TruthState, Twist

_ROOM = 0.05
"""Metres around the footprint: known to be free, they spare the contact test until the truck has crossed them."""


class World:
    """One robot in its surroundings, with its sensors; it advances when a later instant is asked for.

    Everything is a function of configuration, seed, commands and their instants. The start of time is the first
    instant anybody names.

    Args:
        config: see ``WorldConfig``.
        seed: of all noise.
        scene: surroundings that it shares with other robots; None = its own, of ``config``.
        name: of the robot.

    Raises:
        InputError: unknown map name, a bad map or profile file, or a start pose in a wall, a robot or a person.
    """

    def __init__(self, config: WorldConfig, seed: int, scene: Surroundings | None = None, name: str = "truck") -> None:
        self.scene = scene if scene is not None else make_scene(config, seed)
        self.name = name
        place = self.scene.place
        start = (config.start.x, config.start.y, config.start.yaw) if config.start else place.start
        noise_seed = seed if config.noise else None
        self.map = place.map
        uneven = place.profile is not None or bool(config.rough)
        self._terrain = Terrain(place.profile or LEVEL, config.rough) if uneven else None
        self._tilt: TiltConfig = config.tilt
        self._truck = config.truck
        self._half_diagonal = hypot(config.truck.length, config.truck.width) / 2
        self._free: Pose | None = None
        """Pose with free room around."""
        self._known: tuple[Obstacle, ...] = ()
        """Obstacles at the time of ``_free``."""
        if self.scene.overlap(self.scene.solid, self._box(start)) > 0:
            raise InputError(f"start: the truck at {start} touches what is not free on the map {config.map}")
        self._plant = TruckPlant(config.truck, config.battery, start, self._contact, self._attitude, noise_seed)
        self._plant.together = self.scene.advance
        self._plant.on_blocked = self._blocked
        self.scene.add_body(self)
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
        return self.scene.obstacles

    # As the others in the scene see it

    @property
    def outline(self) -> Box:
        """Footprint at its newest instant."""
        return self._box(self._plant.pose)

    @property
    def pace(self) -> float:
        """Speed of its fastest point, m/s, at its newest instant."""
        return self._pace(self._plant.twist)

    def integrate(self, time_ns: int) -> None:
        """Move this robot alone on to an instant."""
        self._plant.integrate(time_ns)

    def outlines(self, times_ns: NDArray[np.int64]) -> list[Box]:
        """Footprints at instants of the last half second."""
        return [self._box((x, y, yaw)) for x, y, yaw in self._plant.poses(times_ns)[:3].T.tolist()]

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
        box = self._box(pose)
        depth = self.scene.overlap(self.scene.solid, box) + self._depth(pose)
        if depth + self.scene.moving_overlap(box, self.name) > 0:
            raise InputError(f"carry: the truck at {pose} touches what is not free")
        self._plant.advance(time_ns)
        self._plant.carry(pose)

    def add(self, time_ns: int, obstacle: Obstacle) -> None:
        """Put something into the world: seen by the lidar, stops the truck."""
        self._plant.advance(time_ns)
        self.scene.set_obstacles((*self.obstacles, obstacle))

    def remove(self, time_ns: int, obstacle: Obstacle) -> None:
        """Take it away again.

        Raises:
            InputError: it is not there.
        """
        if obstacle not in self.obstacles:
            raise InputError(f"obstacle {obstacle}: not in the world")
        self._plant.advance(time_ns)
        index = self.obstacles.index(obstacle)
        self.scene.set_obstacles(self.obstacles[:index] + self.obstacles[index + 1 :])

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

    def _contact(self, x: float, y: float, yaw: float) -> float:
        pose = (x, y, yaw)
        return self._fixed_contact(pose) + self.scene.moving_overlap(self._box(pose), self.name)

    def _fixed_contact(self, pose: Pose) -> float:
        if self._known is not self.obstacles:
            self._free, self._known = None, self.obstacles
        if self._free is not None and self._way(self._free, pose) < _ROOM:
            return 0.0
        self._free = pose if self._depth(pose, _ROOM) == 0.0 else None
        return 0.0 if self._free else self._depth(pose)

    def _way(self, a: Pose, b: Pose) -> float:
        """No point of the footprint is further from its place at the other pose than this, m."""
        return hypot(b[0] - a[0], b[1] - a[1]) + abs(b[2] - a[2]) * self._half_diagonal

    def _depth(self, pose: Pose, room: float = 0.0) -> float:
        """How deep the footprint, grown by ``room`` all around, reaches into things that do not move, m."""
        return self.scene.fixed_overlap(self._box(pose, room))

    def _box(self, pose: Pose, room: float = 0.0) -> Box:
        x, y, yaw = pose
        return Box(x, y, self._truck.length + 2 * room, self._truck.width + 2 * room, yaw)

    def _pace(self, twist: Twist) -> float:
        vx, vy, wz = twist
        return hypot(vx, vy) + abs(wz) * self._half_diagonal

    def _blocked(self, pose: Pose, twist: Twist) -> None:
        self.scene.report(self._box(pose), self.name, self._pace(twist))

    def _cast(
        self, xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None
    ) -> Array:
        return self.scene.cast(xs, ys, angles, reach, times_ns, self.name)

    def _attitude(self, elapsed_ns: int, x: float, y: float, yaw: float) -> tuple[float, float]:
        if isinstance(self._tilt, SinusoidTilt):
            return rocking(self._tilt, elapsed_ns)
        if self._terrain is None:
            return 0.0, 0.0
        return self._terrain.tilt(x, y, yaw, self._truck.wheelbase, self._truck.track)


def make_scene(config: WorldConfig, seed: int) -> Surroundings:
    """Surroundings for the robots of one world.

    Raises:
        InputError: unknown map name, a bad map or profile file, or a person's way that is not free.
    """
    return Surroundings(_find(config.map), config.people, seed)


def _find(name: str) -> BuiltIn:
    """A built-in world, or the map file of that path with the ground profile in the same folder."""
    if name in BUILT_IN:
        return BUILT_IN[name]()
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"map: {name!r}: expected one of {', '.join(BUILT_IN)}, or the path of a map's .yaml file")
    profile = profile_path(path)
    return BuiltIn(load_map(path), (0.0, 0.0, 0.0), load_profile(profile) if profile.exists() else None)
