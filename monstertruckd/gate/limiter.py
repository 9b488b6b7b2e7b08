"""Command limiting: from a request to the commanded motion, slowed by what the swept footprint would touch."""

import math
from functools import lru_cache
from typing import Final

import numpy as np

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints, first_contact, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.sensor import LaserScan
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.sensors import SensorMonitor

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
        self._near = self._reach + footprint.circumscribed_radius + config.obstacle.side_clearance
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
        contact = first_contact(self._footprint, poses, self._points, self._config.obstacle.side_clearance)
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


MAX_ANGLE: Final = 1.4
"""Axle angles are clipped to this before anything else, rad: keeps their tangents finite."""


class Motion:
    """Commanded speed of the base (m/s, along its direction of travel) and axle angles (rad).

    Args:
        config: limits.
        chassis: kinematics of the body.
    """

    def __init__(self, config: GateConfig, chassis: Chassis) -> None:
        self._config = config
        self._chassis = chassis
        self.speed = 0.0
        self.front = 0.0
        self.rear = 0.0
        self._servos = (0.0, 0.0), chassis.servos(0.0, 0.0)
        self._unit = (0.0, 0.0), chassis.shaft_speeds(1.0, 0.0, 0.0)
        self._shafts = (0.0, 0.0, 0.0), chassis.shaft_speeds(0.0, 0.0, 0.0)

    @property
    def servos(self) -> tuple[float, float]:
        """Servo angles front and rear that give the axle angles, rad."""
        if self._servos[0] != (self.front, self.rear):
            self._servos = (self.front, self.rear), self._chassis.servos(self.front, self.rear)
        return self._servos[1]

    @property
    def motor_velocities(self) -> tuple[float, ...]:
        """Motor rate of every driven shaft, as in ``DriveCommand``."""
        return tuple(map(self._chassis.drivetrain.motor_rate, self.shaft_speeds))

    @property
    def shaft_speeds(self) -> tuple[float, ...]:
        """Wheel speed over ground of every driven shaft, m/s."""
        command = self.speed, self.front, self.rear
        if self._shafts[0] != command:
            self._shafts = command, self._chassis.shaft_speeds(*command)
        return self._shafts[1]

    def clipped_angles(self, request: DriveRequest) -> tuple[float, float, bool]:
        """Axle angles within the limits that keep the requested curvature, and whether clipping changed them."""
        front = min(max(request.front, -MAX_ANGLE), MAX_ANGLE)
        rear = min(max(request.rear, -MAX_ANGLE), MAX_ANGLE)
        if max(abs(front), abs(rear)) <= self._config.angle:
            return front, rear, False
        return *self._chassis.limited(front, rear, self._config.angle), True

    def max_speed(self, direction: float) -> float:
        """Greatest speed of the base at the present axle angles, m/s, so that no wheel exceeds its limit."""
        wheels = self._config.speed if direction >= 0 else self._config.reverse_speed
        if self._unit[0] != (self.front, self.rear):
            self._unit = (self.front, self.rear), self._chassis.shaft_speeds(1.0, self.front, self.rear)
        return wheels / max(1.0, *map(abs, self._unit[1]))

    def steer(self, front: float, rear: float, dt: float) -> None:
        """Turn both axles towards (front, rear), rad, within the steering rate; both complete the same share of it."""
        step = max(abs(front - self.front), abs(rear - self.rear))
        share = min(self._config.steering_rate * dt / step, 1.0) if step > 0 else 1.0
        self.front += share * (front - self.front)
        self.rear += share * (rear - self.rear)

    def accelerate(self, target: float, dt: float) -> None:
        """Change the speed towards ``target``, m/s; a change of direction passes through zero."""
        if self.speed * target < 0:
            target = 0.0
        rate = self._config.acceleration if abs(target) > abs(self.speed) else self._config.deceleration
        change = min(abs(target - self.speed), rate * dt)
        self.speed += math.copysign(change, target - self.speed)

    def halt(self) -> None:
        """Command speed 0 at once: the drive controller's own deceleration profile is the ramp."""
        self.speed = 0.0


class CommandLimiter:
    """Moves the commanded motion towards the request of each tick, within all limits.

    Args:
        config: limits.
        motion: commanded motion.
        obstacles: swept footprint against the newest scan.
        sensors: newest samples.
    """

    def __init__(self, config: GateConfig, motion: Motion, obstacles: ObstacleGuard, sensors: SensorMonitor) -> None:
        self._config = config
        self._motion = motion
        self._obstacles = obstacles
        self._sensors = sensors
        self.blocked = False
        """An obstacle ahead allows no motion."""
        self.emergency = False
        """The obstacle is so near that only the quick stop avoids contact."""
        self.free: float | None = None
        """Distance the footprint can travel, m; None = no obstacle within the checked distance."""

    def halt(self) -> None:
        """Command standstill and clear the obstacle state."""
        self._motion.halt()
        self.blocked = self.emergency = False
        self.free = None

    def update(self, now: int, dt: float, request: DriveRequest, limits: dict[Reason, float]) -> None:
        """Advance by ``dt`` s towards ``request``; adds the speed limits that apply, m/s, to ``limits``."""
        motion = self._motion
        front, rear, clipped = motion.clipped_angles(request)
        motion.steer(front, rear, dt)
        direction = math.copysign(1.0, motion.speed or request.speed)
        max_speed = motion.max_speed(direction)
        if clipped or abs(request.speed) > max_speed * (1 + 1e-6):
            limits[Reason.CLIPPED] = max_speed
        if motion.speed != 0 or request.speed != 0:
            self._check_obstacles(now, direction, max(abs(request.speed), abs(motion.speed)), limits)
        allowed = min(*limits.values(), max_speed) if limits else max_speed
        if allowed == 0:
            motion.halt()
        else:
            motion.accelerate(min(max(request.speed, -allowed), allowed), dt)

    def stopping_distance(self, now: int) -> float:
        """Distance travelled if stopped now, m, by the greater of measured and commanded speed."""
        speed = max(abs(self._sensors.speed(now) or 0.0), *map(abs, self._motion.shaft_speeds))
        return speed * self._config.reaction + speed**2 / (2 * self._config.deceleration)

    def _check_obstacles(self, now: int, direction: float, requested: float, limits: dict[Reason, float]) -> None:
        if not self._sensors.scan_fresh(now):
            return
        arcs = [(self._motion.front, self._motion.rear)]
        if self._sensors.steering_fresh(now):
            arcs.append(self._sensors.axles)
        free = self._obstacles.free_distance(direction, tuple(arcs))
        self.free = free if math.isfinite(free) else None
        allowed = self._obstacles.allowed_speed(free, now)
        crawl = self._config.obstacle.crawl
        self.blocked = allowed < (2 * crawl if self.blocked else crawl)
        if self.blocked:
            limits[Reason.OBSTACLE_STOP] = 0.0
        elif allowed < requested:
            limits[Reason.OBSTACLE_SLOW] = allowed
        speed = self._sensors.speed(now) or 0.0
        approaching = speed * direction > self._config.standstill
        near = self.blocked and self._obstacles.too_near(free, speed, now)
        self.emergency = approaching and (self.emergency or near)
