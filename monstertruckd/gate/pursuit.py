"""From the request of whoever drives to the motion commanded, as far as limits and what lies ahead allow."""

import math

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.motion import Motion
from monstertruckd.gate.obstacles import ObstacleGuard
from monstertruckd.gate.watch import Watch


class Pursuit:
    """Moves the commanded motion towards each tick's request.

    Args:
        config: limits.
        motion: what is commanded.
        obstacles: what lies ahead.
        watch: what is measured.
    """

    def __init__(self, config: GateConfig, motion: Motion, obstacles: ObstacleGuard, watch: Watch) -> None:
        self._config = config
        self._motion = motion
        self._obstacles = obstacles
        self._watch = watch
        self.blocked = False
        """An obstacle ahead allows no speed at all."""
        self.emergency = False
        """It is so near that only the quick stop helps."""
        self.free: float | None = None
        """Way the footprint can go, m; None = further than anybody looks."""

    def halt(self) -> None:
        """Command standstill and forget what was ahead."""
        self._motion.halt()
        self.blocked = self.emergency = False
        self.free = None

    def follow(self, now: int, dt: float, request: DriveRequest, limits: dict[Reason, float]) -> None:
        """Advance by ``dt`` s towards ``request``, adding what limits the speed to ``limits``."""
        motion = self._motion
        front, rear, clipped = motion.clipped_angles(request)
        motion.steer(front, rear, dt)
        direction = math.copysign(1.0, motion.speed or request.speed)
        cap = motion.cap(direction)
        if clipped or abs(request.speed) > cap * (1 + 1e-6):
            limits[Reason.CLIPPED] = cap
        if motion.speed != 0 or request.speed != 0:
            self._heed_obstacles(now, direction, max(abs(request.speed), abs(motion.speed)), limits)
        allowed = min(*limits.values(), cap) if limits else cap
        if allowed == 0:
            motion.halt()
        else:
            motion.accelerate(min(max(request.speed, -allowed), allowed), dt)

    def stopping_distance(self, now: int) -> float:
        """Metres the truck would still travel if stopped now, by the greater of measured and commanded speed."""
        speed = max(abs(self._watch.speed(now) or 0.0), *map(abs, self._motion.shaft_speeds))
        return speed * self._config.reaction + speed**2 / (2 * self._config.deceleration)

    def _heed_obstacles(self, now: int, direction: float, wanted: float, limits: dict[Reason, float]) -> None:
        if not self._watch.scan_fresh(now):
            return
        arcs = [(self._motion.front, self._motion.rear)]
        if self._watch.steering_fresh(now):
            arcs.append(self._watch.axles)
        free = self._obstacles.free_distance(direction, tuple(arcs))
        self.free = free if math.isfinite(free) else None
        allowed = self._obstacles.allowed_speed(free, now)
        crawl = self._config.obstacle.crawl
        self.blocked = allowed < (2 * crawl if self.blocked else crawl)
        if self.blocked:
            limits[Reason.OBSTACLE_STOP] = 0.0
        elif allowed < wanted:
            limits[Reason.OBSTACLE_SLOW] = allowed
        speed = self._watch.speed(now) or 0.0
        moving_there = speed * direction > self._config.standstill
        near = self.blocked and self._obstacles.too_near(free, speed, now)
        self.emergency = moving_there and (self.emergency or near)
