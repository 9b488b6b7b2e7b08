"""The motion the gate commands: clipped to the limits, changing no faster than allowed."""

import math
from typing import Final

from monstertruck_kinematics.chassis import Chassis
from monstertruck_schemas.req import DriveRequest
from monstertruckd.gate.config import GateConfig

STEEPEST: Final = 1.4
"""Axle angles are cut here before anything else, rad: tangents stay meaningful."""


class Motion:
    """Commanded speed of the base (m/s, along its direction of travel) and axle angles (rad).

    Args:
        config: limits.
        chassis: what the body can do.
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
        """Motor rate of every driven shaft, as ``DriveCommand`` carries it."""
        return tuple(map(self._chassis.drivetrain.motor_rate, self.shaft_speeds))

    @property
    def shaft_speeds(self) -> tuple[float, ...]:
        """What the driven shafts have to do for it, m/s over ground."""
        wanted = self.speed, self.front, self.rear
        if self._shafts[0] != wanted:
            self._shafts = wanted, self._chassis.shaft_speeds(*wanted)
        return self._shafts[1]

    def clipped_angles(self, request: DriveRequest) -> tuple[float, float, bool]:
        """Axle angles within the limits that keep the curvature asked for, and whether that changed them."""
        front = min(max(request.front, -STEEPEST), STEEPEST)
        rear = min(max(request.rear, -STEEPEST), STEEPEST)
        if max(abs(front), abs(rear)) <= self._config.angle:
            return front, rear, False
        return *self._chassis.limited(front, rear, self._config.angle), True

    def cap(self, direction: float) -> float:
        """Greatest speed of the base at the present axle angles, m/s: the wheels must not exceed theirs."""
        wheels = self._config.speed if direction >= 0 else self._config.reverse_speed
        if self._unit[0] != (self.front, self.rear):
            self._unit = (self.front, self.rear), self._chassis.shaft_speeds(1.0, self.front, self.rear)
        return wheels / max(1.0, *map(abs, self._unit[1]))

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
