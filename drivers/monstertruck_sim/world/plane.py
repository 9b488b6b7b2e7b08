"""The engine ``plane``: a footprint that moves over a map, tilted by a profile of the ground or as commanded."""

from abc import ABC, abstractmethod
from math import hypot, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import SimTruckConfig, SinusoidTilt, SteadyTilt, TiltConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Obstacle
from monstertruck_sim.world.plant import Caster, Plant
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.sensors import PlaneSweep, Sweep
from monstertruck_sim.world.sonar import Solids
from monstertruck_sim.world.terrain import LEVEL, Terrain, rocking
from monstertruck_sim.world.truck_plant import TruckPlant


class PlanOutline:
    """The robot's rectangle in the plane, among what is in its surroundings.

    Args:
        scene: the surroundings.
        truck: its size.
        name: of the robot.
    """

    def __init__(self, scene: Surroundings, truck: SimTruckConfig, name: str) -> None:
        self.scene, self._truck, self.name = scene, truck, name
        self._half_diagonal = hypot(truck.length, truck.width) / 2
        self._free: Pose2 | None = None
        """Pose with free room around."""
        self._known: tuple[Obstacle, ...] = ()
        """Obstacles at the time of ``_free``."""

    def box(self, pose: Pose2, room: float = 0.0) -> Box:
        """It at a pose, grown by ``room`` all around."""
        x, y, yaw = pose
        return Box(x, y, self._truck.length + 2 * room, self._truck.width + 2 * room, yaw)

    def pace(self, twist: Twist2) -> float:
        """Speed of its fastest point, m/s."""
        vx, vy, wz = twist
        return hypot(vx, vy) + abs(wz) * self._half_diagonal

    def blocked(self, pose: Pose2, twist: Twist2) -> None:
        """It cannot move on to a pose: a contact with who is there."""
        self.scene.report(self.box(pose), self.name, self.pace(twist))

    def overlap(self, x: float, y: float, yaw: float) -> float:
        """How deep it reaches into things, robots and people, m; 0 = free."""
        pose = (x, y, yaw)
        return self._fixed(pose) + self.scene.moving_overlap(self.box(pose), self.name)

    def cast(
        self, xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None
    ) -> Array:
        """Ranges to walls, things, people and the other robots."""
        return self.scene.cast(xs, ys, angles, reach, times_ns, self.name)

    def _fixed(self, pose: Pose2) -> float:
        if self._known is not self.scene.obstacles:
            self._free, self._known = None, self.scene.obstacles
        # metres around the footprint: known to be free, they spare the contact test until the truck has crossed them
        room = 0.05
        if self._free is not None and self._way(self._free, pose) < room:
            return 0.0
        self._free = pose if self._depth(pose, room) == 0.0 else None
        return 0.0 if self._free else self._depth(pose)

    def _way(self, a: Pose2, b: Pose2) -> float:
        """No point of the footprint is further from its place at the other pose than this, m."""
        return hypot(b[0] - a[0], b[1] - a[1]) + abs(b[2] - a[2]) * self._half_diagonal

    def _depth(self, pose: Pose2, room: float = 0.0) -> float:
        """How deep the footprint, grown by ``room`` all around, reaches into things that do not move, m."""
        return self.scene.fixed_overlap(self.box(pose, room))


class Space(ABC):
    """What is around one robot.

    Args:
        footprint: of the robot, in its surroundings.
    """

    def __init__(self, footprint: PlanOutline) -> None:
        self._scene = footprint.scene
        self.contact = footprint.overlap
        """How deep the footprint at a pose reaches into things, m; 0 = free."""
        self.cast: Caster = footprint.cast

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Things in it that are not on its map."""
        return self._scene.obstacles

    def add(self, obstacle: Obstacle) -> None:
        """Put something into it: seen by the lidar, stops robots.

        Raises:
            InputError: there is no room for more.
        """
        self._scene.set_obstacles((*self.obstacles, obstacle))

    def remove(self, obstacle: Obstacle) -> None:
        """Take it away again.

        Raises:
            InputError: it is not there.
        """
        if obstacle not in self.obstacles:
            raise InputError(f"obstacle {obstacle}: not in the world")
        index = self.obstacles.index(obstacle)
        self._scene.set_obstacles(self.obstacles[:index] + self.obstacles[index + 1 :])

    @abstractmethod
    def set_tilt(self, tilt: TiltConfig) -> None:
        """From now on tilt the robot in another way.

        Raises:
            InputError: the engine computes the tilt itself.
        """


class Engine(NamedTuple):
    """What moves one robot, and what is around it."""

    plant: Plant
    space: Space
    sweep: Sweep
    solids: Solids | None = None
    """What sonars hear beside the walls."""


class PlaneSpace(Space):
    """``Space`` of the plane.

    Args:
        footprint: of the robot, in its surroundings.
        config: of the world.
    """

    def __init__(self, footprint: PlanOutline, config: WorldConfig) -> None:
        super().__init__(footprint)
        self._truck = config.truck
        profile = self._scene.place.profile
        uneven = profile is not None or bool(config.rough)
        self.terrain = Terrain(profile or LEVEL, config.rough) if uneven else None
        """The ground; None: level."""
        self._tilt: TiltConfig = config.tilt

    def set_tilt(self, tilt: TiltConfig) -> None:
        """From now on tilt the robot in another way."""
        self._tilt = tilt

    def attitude(self, elapsed_ns: int, x: float, y: float, yaw: float) -> tuple[float, float]:
        """Pitch and roll of the robot at a pose, rad."""
        if isinstance(self._tilt, SinusoidTilt):
            return rocking(self._tilt, elapsed_ns)
        if isinstance(self._tilt, SteadyTilt):
            return radians(self._tilt.pitch_deg), radians(self._tilt.roll_deg)
        if self.terrain is None:
            return 0.0, 0.0
        return self.terrain.tilt(x, y, yaw, self._truck.wheelbase, self._truck.track)


def plane(config: WorldConfig, footprint: PlanOutline, start: Pose2, seed: int | None) -> Engine:
    """One robot of the plane."""
    space = PlaneSpace(footprint, config)
    plant = TruckPlant(config.truck, config.battery, start, space.contact, space.attitude, seed)
    return Engine(plant, space, PlaneSweep(space.cast, space.terrain, config.lidar))
