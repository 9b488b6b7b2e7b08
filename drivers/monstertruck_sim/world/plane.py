"""The engine ``plane``: a footprint that moves over a map, tilted by the ground profile or as commanded."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from math import hypot, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import LidarConfig, SimTruckConfig, SinusoidTilt, SteadyTilt, TiltConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Obstacle
from monstertruck_sim.world.plant import Caster, Plant
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.sensors import PlaneSweep, Sweep
from monstertruck_sim.world.sonar import Solids
from monstertruck_sim.world.terrain import LEVEL, Terrain, rocking
from monstertruck_sim.world.truck_plant import TruckPlant


class PlanOutline:
    """Rectangular footprint of the robot in its surroundings.

    Args:
        scene: the surroundings.
        truck: robot dimensions.
        name: robot name.
    """

    def __init__(self, scene: Surroundings, truck: SimTruckConfig, name: str) -> None:
        self.scene, self._truck, self.name = scene, truck, name
        self._half_diagonal = hypot(truck.length, truck.width) / 2
        self._free: Pose2 | None = None
        """Pose with free space around it."""
        self._known: tuple[Obstacle, ...] = ()
        """Obstacles at the time of ``_free``."""

    def box(self, pose: Pose2, room: float = 0.0) -> Box:
        """Return the footprint at a pose, enlarged by ``room`` on all sides."""
        x, y, yaw = pose
        return Box(x, y, self._truck.length + 2 * room, self._truck.width + 2 * room, yaw)

    def pace(self, twist: Twist2) -> float:
        """Return the speed of the footprint's fastest point (m/s)."""
        vx, vy, wz = twist
        return hypot(vx, vy) + abs(wz) * self._half_diagonal

    def blocked(self, pose: Pose2, twist: Twist2) -> None:
        """Report contacts with the bodies that block the move to a pose."""
        self.scene.report(self.box(pose), self.name, self.pace(twist))

    def overlap(self, x: float, y: float, yaw: float) -> float:
        """Return the penetration into obstacles, robots and people (m); 0 if free."""
        pose = (x, y, yaw)
        return self._fixed(pose) + self.scene.moving_overlap(self.box(pose), self.name)

    def cast(
        self, xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None
    ) -> Array:
        """Return the ranges to walls, obstacles, people and other robots."""
        return self.scene.cast(xs, ys, angles, reach, times_ns, self.name)

    def _fixed(self, pose: Pose2) -> float:
        if self._known is not self.scene.obstacles:
            self._free, self._known = None, self.scene.obstacles
        # margin around the footprint known to be free, m: no contact test is needed until the truck has crossed it
        room = 0.05
        if self._free is not None and self._way(self._free, pose) < room:
            return 0.0
        self._free = pose if self._depth(pose, room) == 0.0 else None
        return 0.0 if self._free else self._depth(pose)

    def _way(self, a: Pose2, b: Pose2) -> float:
        """Return an upper bound of the displacement of any footprint point between two poses (m)."""
        return hypot(b[0] - a[0], b[1] - a[1]) + abs(b[2] - a[2]) * self._half_diagonal

    def _depth(self, pose: Pose2, room: float = 0.0) -> float:
        """Return how deep the footprint, enlarged by ``room`` on all sides, penetrates fixed objects (m)."""
        return self.scene.fixed_overlap(self.box(pose, room))


class Space(ABC):
    """One robot's surroundings.

    Args:
        footprint: the robot's footprint in its surroundings.
    """

    def __init__(self, footprint: PlanOutline) -> None:
        self._scene = footprint.scene
        self.contact = footprint.overlap
        """Penetration of the footprint at a pose into its surroundings (m); 0 if free."""
        self.cast: Caster = footprint.cast

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Obstacles that are not on the map."""
        return self._scene.obstacles

    def add(self, obstacle: Obstacle) -> None:
        """Add an obstacle that the lidar sees and that stops robots.

        Raises:
            InputError: there is no room for another obstacle.
        """
        self._scene.set_obstacles((*self.obstacles, obstacle))

    def remove(self, obstacle: Obstacle) -> None:
        """Remove an obstacle.

        Raises:
            InputError: the obstacle is not in the world.
        """
        if obstacle not in self.obstacles:
            raise InputError(f"obstacle {obstacle}: not in the world")
        index = self.obstacles.index(obstacle)
        self._scene.set_obstacles(self.obstacles[:index] + self.obstacles[index + 1 :])

    @abstractmethod
    def set_tilt(self, tilt: TiltConfig) -> None:
        """Change the robot's tilt.

        Raises:
            InputError: the engine computes the tilt itself.
        """


class Engine(NamedTuple):
    """Physics and surroundings of one robot."""

    plant: Plant
    space: Space
    sweep_of: Callable[[LidarConfig], Sweep]
    """Beams of a lidar on the robot."""
    solids: Solids | None = None
    """Objects that sonars detect in addition to the walls."""


class PlaneSpace(Space):
    """``Space`` of the plane engine.

    Args:
        footprint: the robot's footprint in its surroundings.
        config: world settings.
    """

    def __init__(self, footprint: PlanOutline, config: WorldConfig) -> None:
        super().__init__(footprint)
        self._truck = config.truck
        profile = self._scene.place.profile
        uneven = profile is not None or bool(config.rough)
        self.terrain = Terrain(profile or LEVEL, config.rough) if uneven else None
        """The ground, or None if level."""
        self._tilt: TiltConfig = config.tilt

    def set_tilt(self, tilt: TiltConfig) -> None:
        """Change the robot's tilt."""
        self._tilt = tilt

    def attitude(self, elapsed_ns: int, x: float, y: float, yaw: float) -> tuple[float, float]:
        """Return the robot's pitch and roll at a pose (rad)."""
        if isinstance(self._tilt, SinusoidTilt):
            return rocking(self._tilt, elapsed_ns)
        if isinstance(self._tilt, SteadyTilt):
            return radians(self._tilt.pitch_deg), radians(self._tilt.roll_deg)
        if self.terrain is None:
            return 0.0, 0.0
        return self.terrain.tilt(x, y, yaw, self._truck.wheelbase, self._truck.track)


def plane(config: WorldConfig, footprint: PlanOutline, start: Pose2, seed: int | None) -> Engine:
    """Create the plane engine for one robot."""
    space = PlaneSpace(footprint, config)
    plant = TruckPlant(config.truck, config.battery, start, space.contact, space.attitude, seed)
    return Engine(plant, space, partial(PlaneSweep, space.cast, space.terrain))
