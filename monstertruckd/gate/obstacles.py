"""Obstacle check: the speed allowed by the swept footprint against the newest scan."""

import math
from functools import lru_cache

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints, first_contact, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import LaserScan
from monstertruckd.gate.config import GateConfig

POSES = 20
"""Poses checked along the swept path."""

ANGLE_STEP = 0.005
"""Axle angles are rounded to this before the sweep, rad: an error of 2 mm at its end, and most sweeps are cached."""

SWEEPS = 256
"""Sweeps cached."""

Arcs = tuple[tuple[float, float], ...]


class ObstacleGuard:
    """Swept footprint against the newest scan.

    The scan's age is covered by distance: the truck may have moved since.

    Args:
        config: limits.
        steering: the truck's geometry.
        footprint: its outline.
        points: of scans, in base.
    """

    def __init__(
        self,
        config: GateConfig,
        steering: FourWheelSteering,
        footprint: Footprint,
        points: ScanPoints,
    ) -> None:
        self._config = config
        self._steering = steering
        self._footprint = footprint
        self._scan_points = points
        self._points = np.empty((0, 2))
        self._stamp = 0
        self._checked: tuple[float, tuple[tuple[int, int], ...]] | None = None
        self._free = math.inf
        delay = config.scan.stale_after + config.max_latency + config.reaction
        self._reach = config.obstacle.ahead + self._stopping(config.speed, delay, config.obstacle.deceleration)
        self._near = self._reach + footprint.circumscribed_radius + config.obstacle.beside
        self._distances = np.linspace(0.0, self._reach, POSES)
        self._sweep = lru_cache(SWEEPS)(self._swept)

    def observe(self, scan: LaserScan) -> None:
        """Take a scan."""
        points = self._scan_points.of(scan)
        self._points = points[np.hypot(points[:, 0], points[:, 1]) < self._near]
        self._stamp = scan.stamp
        self._checked = None

    def free_distance(self, direction: float, arcs: Arcs) -> float:
        """Distance the footprint can travel from where the scan was taken, m; +inf if no obstacle is within reach.

        Args:
            direction: +1 forward, -1 backward.
            arcs: (front, rear) axle angles, rad; the shortest distance of all of them counts.
        """
        rounded = tuple((round(front / ANGLE_STEP), round(rear / ANGLE_STEP)) for front, rear in arcs)
        if self._checked != (direction, rounded):
            self._checked = (direction, rounded)
            distances = (self._free_distance(direction, *arc) for arc in {*rounded})
            self._free = min(distances) if len(self._points) else math.inf
        return self._free

    def _swept(self, direction: float, front: int, rear: int) -> Array:
        """Poses along the arc with axle angles in steps of ``ANGLE_STEP``."""
        return swept_poses(self._steering, front * ANGLE_STEP, rear * ANGLE_STEP, direction * self._distances)

    def _free_distance(self, direction: float, front: int, rear: int) -> float:
        poses = self._sweep(direction, front, rear)
        contact = first_contact(self._footprint, poses, self._points, self._config.obstacle.beside)
        return math.inf if contact is None else float(self._distances[contact - 1])

    def allowed_speed(self, free: float, now: int) -> float:
        """Greatest speed from which the truck stops comfortably within ``free`` metres, m/s."""
        if math.isinf(free):
            return math.inf
        room = max(free - self._config.obstacle.ahead, 0.0)
        delay, deceleration = self._delay(now), self._config.obstacle.deceleration
        return deceleration * (math.sqrt(delay**2 + 2 * room / deceleration) - delay)

    def too_near(self, free: float, speed: float, now: int) -> bool:
        """Whether an ordinary stop from ``speed`` needs more than ``free`` metres."""
        return free < self._stopping(abs(speed), self._delay(now), self._config.deceleration)

    def _delay(self, now: int) -> float:
        return max(now - self._stamp, 0) / SECOND + self._config.reaction

    @staticmethod
    def _stopping(speed: float, delay: float, deceleration: float) -> float:
        return speed * delay + speed**2 / (2 * deceleration)
