"""Drive controller settings in the configuration file."""

import math
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.shafts import MotorLimits
from monstertruck_schemas.base import Schema

Seconds = Annotated[float, Field(gt=0)]
RpmPerSecond = Annotated[int, Field(gt=0, lt=2**31)]


class EposConfig(Schema):
    """EPOS 24/1 drive controller in profile velocity mode.

    The defaults suit the truck: 18000 rpm are 0.22 m/s; 82000 rpm/s are 1 m/s^2 (ratio 644, wheel radius 75 mm).
    """

    kind: Literal["epos"] = "epos"
    node: Annotated[int, Field(ge=0, le=127)] = 1
    """Node id on the cable; 0: any single controller."""
    inverted: bool = True
    """Whether driving forward needs negative rpm."""

    max_motor_rpm: Annotated[int, Field(gt=0, le=100_000)] = 18_000
    """Maximum set-point (rpm); also written to the controller as its limit."""
    acceleration_rpm_s: RpmPerSecond = 60_000
    """Acceleration of the motor (rpm/s)."""
    deceleration_rpm_s: RpmPerSecond = 200_000
    """Deceleration (rpm/s): 2.4 m/s^2, below the limit of the slipper clutch; the wheels lag the motor by about 0.1
    s.
    """
    quick_stop_deceleration_rpm_s: RpmPerSecond = 240_000
    """Quick stop deceleration (rpm/s): full speed to rest in 0.08 s."""

    encoder_pulses_per_turn: Annotated[int, Field(gt=0, le=65_535)] | None = 500
    """Encoder pulses per motor turn (counts / 4); None uses the controller's setting."""
    motor_type: Literal[1, 10, 11] | None = None
    """Motor type: 1 brushed DC, 10 sinusoidal EC, 11 block commutated EC; None: not checked."""

    rate: Annotated[float, Field(ge=1, le=25)] = 20.0
    """Feedback rate (Hz); one cycle needs four exchanges of 10 to 13 ms at 38400 baud."""
    status_period: Seconds = 0.1
    """Interval between readings of the controller's status (s)."""
    current_period: Annotated[float, Field(gt=0, le=2)] = 0.2
    """Interval between readings of the motor current (s)."""
    command_timeout: Seconds = 0.25
    """Age of the last command at which the target becomes 0 (s)."""
    quick_stop_after: Seconds = 1.0
    """Age of the last command at which the driver commands a quick stop (s)."""
    standstill_rpm: Annotated[int, Field(ge=1)] = 60
    """Speed below which the motor is at rest (rpm)."""

    fault_resets: Annotated[int, Field(ge=0, le=10)] = 3
    """Maximum number of fault resets within ``fault_reset_window`` before the drive fails."""
    fault_reset_window: Seconds = 10.0
    """Time in which ``fault_resets`` are counted (s)."""
    fault_reset_pause: Seconds = 0.3
    """Pause between two fault resets (s)."""

    @property
    def motor_limits(self) -> MotorLimits:
        """Motor limits."""
        rpm = 2 * math.pi / 60
        return MotorLimits(
            self.max_motor_rpm * rpm, self.deceleration_rpm_s * rpm, self.quick_stop_deceleration_rpm_s * rpm
        )

    @property
    def stop_words(self) -> str:
        """Arguments of the stop script: the node id."""
        return str(self.node)
