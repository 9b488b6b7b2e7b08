"""The motion the gate commands: clipped to the limits, changing no faster than allowed."""

import math
from typing import Final

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_schemas.req import DriveRequest
from monstertruckd.gate.config import GateConfig

STEEPEST: Final = 1.4
"""Axle angles are cut here before anything else, rad: tangents stay meaningful."""


class Motion:
    """Commanded speed of the base (m/s, along its direction of travel) and axle angles (rad).

    Args:
        config: limits.
        steering: the truck's geometry.
    """

    def __init__(self, config: GateConfig, steering: FourWheelSteering) -> None:
        self._config = config
        self._steering = steering
        self.speed = 0.0
        self.front = 0.0
        self.rear = 0.0

    @property
    def wheel_speed(self) -> float:
        """What the drive has to do for it, m/s over ground."""
        return self._steering.drive_speed(self.speed, self.front, self.rear)

    def clipped_angles(self, request: DriveRequest) -> tuple[float, float, bool]:
        """Axle angles within the limits that keep the curvature asked for, and whether that changed them."""
        front = min(max(request.front, -STEEPEST), STEEPEST)
        rear = min(max(request.rear, -STEEPEST), STEEPEST)
        if max(abs(front), abs(rear)) <= self._config.angle:
            return front, rear, False
        return *self._steering.limit_keeping_curvature(front, rear, self._config.angle), True

    def cap(self, direction: float) -> float:
        """Greatest speed of the base at the present axle angles, m/s: the wheels must not exceed theirs."""
        wheels = self._config.speed if direction >= 0 else self._config.reverse_speed
        return wheels / max(self._steering.drive_speed(1.0, self.front, self.rear), 1.0)

    def steer(self, front: float, rear: float, dt: float) -> None:
        """Turn both axles towards (front, rear) by one common share of the way, within the steering rate."""
        step = max(abs(front - self.front), abs(rear - self.rear))
        share = min(self._config.steering_rate * dt / step, 1.0) if step > 0 else 1.0
        self.front += share * (front - self.front)
        self.rear += share * (rear - self.rear)

    def accelerate(self, target: float, dt: float) -> None:
        """Change the speed towards ``target``: braking and speeding up have their own rates, through zero."""
        if self.speed * target < 0:
            target = 0.0
        rate = self._config.acceleration if abs(target) > abs(self.speed) else self._config.deceleration
        change = min(abs(target - self.speed), rate * dt)
        self.speed += math.copysign(change, target - self.speed)

    def halt(self) -> None:
        """Command standstill now: the drive controller's own deceleration profile is the ramp."""
        self.speed = 0.0
