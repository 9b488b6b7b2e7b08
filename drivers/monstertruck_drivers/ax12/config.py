"""Configuration of the stabiliser's two joints: calibration, timing and recovery from alarms."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.ax12.protocol import AX12_BAUD, POSITION_MAX, SPEED_UNIT, STEP
from monstertruck_schemas.base import Positive, Schema

Steps = Annotated[int, Field(ge=0, le=POSITION_MAX)]
Seconds = Annotated[float, Field(ge=0)]


class JointConfig(Schema):
    """Calibration of one unit: ``position = zero + direction * angle / step``."""

    id: Annotated[int, Field(ge=0, le=252)]
    """Id of the unit on its bus."""
    zero: Steps
    """Servo position at joint angle 0, steps."""
    min_position: Steps
    """Smallest position commanded (steps)."""
    max_position: Steps
    """Largest position commanded (steps)."""
    direction: Literal[-1, 1] = 1
    """+1 if a rising position (shaft counter-clockwise) turns the joint in the positive direction (REP 103)."""

    @model_validator(mode="after")
    def _zero_within_limits(self) -> Self:
        if not self.min_position < self.zero < self.max_position:
            raise ValueError(
                f"expected min_position {self.min_position} < zero {self.zero} < max_position {self.max_position}"
            )
        return self

    def position(self, angle: float) -> int:
        """Goal position for a joint angle (rad), within the limits."""
        steps = round(self.zero + self.direction * angle / STEP)
        return min(max(steps, self.min_position), self.max_position)

    def angle(self, position: float) -> float:
        """Joint angle for a position in steps (rad)."""
        return (position - self.zero) * STEP * self.direction


class AlarmConfig(Schema):
    """Recovery of a joint that has lost its torque."""

    rest: Seconds = 3.0
    """Waiting time after an alarm (s); doubled if it trips again."""
    rest_max: Positive = 60.0
    """Maximum rest (s)."""
    settled_after: Positive = 30.0
    """Holding time that resets the next rest to ``rest`` (s)."""
    cool_below: Annotated[int, Field(ge=0, le=100)] = 60
    """Maximum temperature for switching the torque on again, degrees Celsius."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.rest > self.rest_max:
            raise ValueError(f"expected rest {self.rest} <= rest_max {self.rest_max}")
        return self


class Ax12Config(Schema):
    """Two Dynamixel AX-12A servos that move the lidar mount in pitch and roll."""

    kind: Literal["ax12"] = "ax12"
    pitch: JointConfig = JointConfig(id=1, zero=511, min_position=409, max_position=613)
    roll: JointConfig = JointConfig(id=2, zero=204, min_position=102, max_position=306)
    speed: Annotated[float, Field(gt=0, le=1023 * SPEED_UNIT)] = 4.0
    """Maximum speed of a joint (rad/s)."""
    margin: Annotated[int, Field(ge=0, le=255)] = 1
    """Distance from the goal at which a joint stops (steps)."""
    slope: Literal[2, 4, 8, 16, 32, 64, 128] = 32
    """Distance from the goal at which a joint applies full torque (steps)."""
    rate: Annotated[float, Field(gt=0, le=100)] = 25.0
    """Rate at which both joints are read (Hz); an adapter with its usual latency of 16 ms allows 31."""
    check_interval: Positive = 1.0
    """Seconds between two checks of a joint's torque settings."""
    absent_interval: Annotated[float, Field(ge=1)] = 1.0
    """Seconds between two requests to a joint that does not answer: each costs a whole timeout."""
    return_delay: Annotated[float, Field(ge=0, le=508e-6)] = 500e-6
    """Delay before a unit answers (s), as set in the unit."""
    usb_latency: Annotated[float, Field(ge=0, le=0.255)] = 0.016
    """Latency timer of the adapter (s); 0.001 only if confirmed."""
    command_timeout: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Age at which joint goals are stale (s): they are ignored and the joints hold."""
    alarm: AlarmConfig = AlarmConfig()

    @model_validator(mode="after")
    def _ids_differ(self) -> Self:
        if self.pitch.id == self.roll.id:
            raise ValueError(f"pitch and roll need different ids, both have {self.pitch.id}")
        return self

    @property
    def speed_word(self) -> int:
        """``speed`` as a register value; never 0, which would mean unlimited."""
        return max(1, round(self.speed / SPEED_UNIT))

    def timeout(self, size: int, baud: int = AX12_BAUD) -> float:
        """Timeout for an exchange of ``size`` bytes (s): transfer, return delay, and adapter latency both ways."""
        timeout_min = 0.005  # seconds; below this a busy host misses timely answers
        scheduling = 0.002  # additional delay by the host (s)
        return max(timeout_min, size * 10 / baud + self.return_delay + 2 * self.usb_latency + scheduling)
