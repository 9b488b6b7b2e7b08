"""VESC settings in the configuration file: the motors on one port, the servo output, the battery."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.shafts import MotorLimits, SteeringOutputs
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]
Position = Annotated[float, Field(ge=0, le=1)]
RAD_S_PER_RPM = 2 * math.pi / 60


class VescMotorConfig(Schema):
    """One controller: the one on the port, or one behind it on the CAN bus."""

    can_id: Annotated[int, Field(ge=0, le=254)] | None = None
    """CAN id; null: the connected controller"""
    inverted: bool = False
    """Whether driving forward needs negative speeds"""


class VescServoConfig(Schema):
    """Servo output: ``position = centre + direction * per_radian * servo angle``, 0 to 1 of its pulse range."""

    centre: Position = 0.5
    """Position that steers straight ahead"""
    per_radian: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Change in position per radian of servo angle"""
    direction: Literal[-1, 1] = -1
    """+1 if a larger position steers left, -1 if it steers right"""
    min: Position = 0.15
    """Minimum commanded position."""
    max: Position = 0.85
    """Maximum commanded position."""
    dead_time: Annotated[float, Field(ge=0, le=1)] | None = None
    """Dead time from a steering command to the first movement of the wheels (s); null if it was not measured"""
    lag: Annotated[float, Field(ge=0, le=1)] | None = None
    """Time constant of the wheels' movement after the dead time (s); null if it was not measured"""

    @model_validator(mode="after")
    def _centre_within_limits(self) -> Self:
        if not self.min < self.centre < self.max:
            raise ValueError(f"expected min {self.min} < centre {self.centre} < max {self.max}")
        return self

    def position(self, angle: float) -> float:
        """Position for a servo angle (rad, left positive), clamped to the limits."""
        return min(max(self.centre + self.direction * self.per_radian * angle, self.min), self.max)

    def angle(self, position: float) -> float:
        """Servo angle (rad, left positive) for a position."""
        return (position - self.centre) * self.direction / self.per_radian

    @property
    def reach(self) -> tuple[float, float]:
        """Servo angles (rad) at the limits: right (negative) and left."""
        right, left = sorted(map(self.angle, (self.min, self.max)))
        return right, left


class VescConfig(Schema):
    """VESC motor controllers on one port; motor i turns the body's shaft i.

    The defaults suit a 1:10 car with a sensored motor: with a gear ratio of 10 and 5 cm wheels, 6000 rpm are 3.1 m/s
    and 12000 rpm/s are 6.3 m/s^2.
    """

    kind: Literal["vesc"] = "vesc"
    motors: Annotated[tuple[VescMotorConfig, ...], Field(strict=False, min_length=1, max_length=4)] = (
        VescMotorConfig(),
    )
    pole_pairs: Annotated[int, Field(ge=1, le=50)] = 2
    """Electrical turns per turn of the motor"""
    max_motor_rpm: Annotated[int, Field(gt=0, le=100_000)] = 6000
    """Maximum motor speed (rpm); requests are limited to it"""
    min_motor_rpm: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    """Minimum motor speed (rpm): slower set-points brake instead, because the controller gives no torque below
    `s_pid_min_erpm`. Set it to that setting divided by pole_pairs
    """
    deceleration_rpm_s: Annotated[float, Field(gt=0)] = 12_000.0
    """Measured deceleration at a lower set-point (rpm/s); the controller's own ramp and current limits determine it"""
    quick_stop_deceleration_rpm_s: Annotated[float, Field(gt=0)] = 15_000.0
    """Measured deceleration at brake_current (rpm/s)"""
    brake_current: Annotated[float, Field(gt=0, le=200)] = 20.0
    """Current of the quick stop and of the controller's watchdog (A)"""
    standstill_rpm: Annotated[float, Field(gt=0, le=10_000)] = 60.0
    """Speed below which the motor is at rest (rpm)"""
    servo: VescServoConfig | None = None
    """Servo output, which steers the front axle; null: another device steers, or nothing does"""
    battery: PackConfig | None = None
    """Pack that supplies the first controller, measured by that controller; null if another device measures it"""
    battery_rate: Annotated[float, Field(gt=0, le=50)] = 10.0
    """Battery readings per second"""
    rate: Annotated[float, Field(ge=10, le=100)] = 40.0
    """Exchanges per second with every controller; at 115200 baud, an exchange takes 9 ms"""
    answer_timeout: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Timeout of an answer (s)"""
    command_timeout: Seconds = 0.25
    """Maximum age of the latest command (s), after which the driver brakes the motors"""
    watchdog: Annotated[float, Field(ge=0.05, le=1.0)] = 0.1
    """Watchdog time of the controller (s): it brakes without a set-point; the driver writes it at every start"""

    @property
    def shafts(self) -> int:
        """Number of driven shafts."""
        return len(self.motors)

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        return MotorLimits(
            self.max_motor_rpm * RAD_S_PER_RPM,
            self.deceleration_rpm_s * RAD_S_PER_RPM,
            self.quick_stop_deceleration_rpm_s * RAD_S_PER_RPM,
        )

    @property
    def steering_outputs(self) -> SteeringOutputs | None:
        """Output for the front axle servo; the rear axle is fixed."""
        if self.servo is None:
            return None
        return SteeringOutputs((self.servo.reach, (0.0, 0.0)), self.servo.dead_time, self.servo.lag)

    @property
    def stop_words(self) -> str:
        """Brake current (A), electrical standstill speed (rpm) and CAN ids, for the stop script."""
        ids = ",".join("" if motor.can_id is None else str(motor.can_id) for motor in self.motors)
        return f"{self.brake_current:g}:{self.standstill_rpm * self.pole_pairs:g}:{ids}"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [motor.can_id for motor in self.motors]
        if len(set(ids)) < len(ids):
            raise ValueError(f"motors: expected different can_ids, got {ids}")
        if self.watchdog <= 2.0 / self.rate:
            raise ValueError(f"watchdog {self.watchdog:g} s: expected more than two exchanges, {2.0 / self.rate:g} s")
        if self.min_motor_rpm >= self.max_motor_rpm:
            raise ValueError(f"min_motor_rpm {self.min_motor_rpm:g}: expected less than {self.max_motor_rpm}")
        return self
