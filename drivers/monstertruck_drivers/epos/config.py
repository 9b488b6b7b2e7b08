"""Settings of the drive controller in the configuration file."""

import math
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.shafts import MotorLimits
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]
RpmPerSecond = Annotated[int, Field(gt=0, lt=2**31)]


class EposConfig(Schema):
    """Drive controller EPOS 24/1 in profile velocity mode.

    The defaults suit the truck: 18000 rpm are 0.22 m/s; 82000 rpm/s are 1 m/s^2 (ratio 644, wheel radius 75 mm).
    """

    kind: Literal["epos"] = "epos"
    node: Annotated[int, Field(ge=0, le=127)] = 1
    """Node id on the cable; 0 = any single controller."""
    inverted: bool = True
    """Driving forward needs negative rpm."""

    max_motor_rpm: Annotated[int, Field(gt=0, le=100_000)] = 18_000
    """Set points are limited to this; also written to the controller as its own limit."""
    acceleration_rpm_s: RpmPerSecond = 60_000
    """Acceleration of the motor (rpm/s)."""
    deceleration_rpm_s: RpmPerSecond = 200_000
    """2.4 m/s^2, below the limit of the slipper clutch; the wheels follow the motor some 0.1 s later."""
    quick_stop_deceleration_rpm_s: RpmPerSecond = 240_000
    """Quick stop deceleration: full speed to rest in 0.08 s."""

    encoder_pulses_per_turn: Annotated[int, Field(gt=0, le=65_535)] | None = 500
    """Encoder pulses per motor turn (counts / 4); None = use the controller's own setting."""
    motor_type: Literal[1, 10, 11] | None = None
    """1 brushed DC, 10 sinusoidal EC, 11 block commutated EC; None = do not check."""

    rate: Annotated[float, Field(ge=1, le=25)] = 20.0
    """Feedback per second; one cycle needs four exchanges of 10 to 13 ms at 38400 baud."""
    status_period: Seconds = 0.1
    """Interval between readings of the controller's status (s)."""
    current_period: Annotated[float, Field(gt=0, le=2)] = 0.2
    """Interval between readings of the motor current (s)."""
    command_timeout: Seconds = 0.25
    """Age of the last command at which the target becomes 0 (s)."""
    quick_stop_after: Seconds = 1.0
    """Age of the last command at which the driver commands a quick stop (s)."""
    standstill_rpm: Annotated[int, Field(ge=1)] = 60
    """Slower than this counts as at rest."""

    fault_resets: Annotated[int, Field(ge=0, le=10)] = 3
    """Fault resets tried within ``fault_reset_window`` before the drive is given up."""
    fault_reset_window: Seconds = 10.0
    """Time in which ``fault_resets`` are counted (s)."""
    fault_reset_pause: Seconds = 0.3
    """Pause between two fault resets."""

    @property
    def motor_limits(self) -> MotorLimits:
        """Limits of the motor."""
        rpm = 2 * math.pi / 60
        return MotorLimits(
            self.max_motor_rpm * rpm, self.deceleration_rpm_s * rpm, self.quick_stop_deceleration_rpm_s * rpm
        )

    @property
    def stop_words(self) -> str:
        """Node id, for the stop script."""
        return str(self.node)
