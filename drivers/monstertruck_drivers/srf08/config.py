"""Settings for SRF08 sonars behind a USB-ISS."""

from math import pi
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.srf08.protocol import ADDRESSES
from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import Mount


class SonarConfig(Schema):
    """One sonar."""

    address: Annotated[int, Field(ge=0xE0, le=0xFE)]
    """I2C address in the manufacturer's notation: even, 224 to 254"""
    mount: Mount
    """Place and axis in the base frame"""

    @model_validator(mode="after")
    def _even(self) -> Self:
        if self.address not in ADDRESSES:
            raise ValueError(f"address {self.address}: expected an even one, {ADDRESSES[0]} to {ADDRESSES[-1]}")
        return self


def five_sonars() -> dict[str, SonarConfig]:
    """Left, front-left, front, front-right and right sonars, as on the wall follower."""
    places = {
        "l": (0.05, 0.05, pi / 2),
        "fl": (0.10, 0.05, pi / 4),
        "f": (0.12, 0.0, 0.0),
        "fr": (0.10, -0.05, -pi / 4),
        "r": (0.05, -0.05, -pi / 2),
    }
    return {
        name: SonarConfig(address=address, mount=Mount(x=x, y=y, yaw=yaw))
        for address, (name, (x, y, yaw)) in zip(ADDRESSES, places.items(), strict=False)
    }


class Srf08Config(Schema):
    """Devantech SRF08 sonars on the I2C bus of a USB-ISS.

    All sonars of a group fire together, and the groups fire in turn at equal intervals. Sonars with overlapping cones
    belong in different groups.
    """

    kind: Literal["srf08"] = "srf08"
    sonars: dict[FrameId, SonarConfig] = Field(default_factory=five_sonars, min_length=1)
    """Sonars by name"""
    groups: Annotated[tuple[tuple[str, ...], ...], Field(strict=False)] = (("l", "f", "r"), ("fl", "fr"))
    """Names of the sonars in firing order"""
    rate: Annotated[float, Field(gt=0, le=20)] = 10.0
    """Message rate (Hz); each message contains a ping of every sonar"""
    range_min: Annotated[float, Field(gt=0, lt=6)] = 0.15
    """Minimum range (m)."""
    range_max: Annotated[float, Field(gt=0, le=6)] = 3.0
    """Maximum range (m)."""
    field_of_view: Annotated[float, Field(gt=0, le=3.1416)] = 0.87
    """Full opening angle of the cones (rad)"""
    gain: Annotated[int, Field(ge=0, le=31)] = 16
    """Maximum gain; a higher gain detects weaker echoes, but also echoes of the previous ping"""
    speed_of_sound: Annotated[float, Field(gt=300, lt=380)] = 343.0
    """Speed of sound (m/s); it rises by 0.6 per degree Celsius"""
    timeout: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Timeout of the USB-ISS's answer (s)"""
    silence: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Timeout without an answer from any sonar (s); then the session ends"""
    stuck_after: Annotated[int, Field(ge=2, le=10_000)] = 20
    """Number of consecutive echoes that are equal to the microsecond after which a sonar is reported as not
    answering
    """

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fired = [name for group in self.groups for name in group]
        if sorted(fired) != sorted(self.sonars):
            raise ValueError(f"groups {', '.join(fired)}: expected each of {', '.join(self.sonars)} once")
        addresses = [sonar.address for sonar in self.sonars.values()]
        if len(set(addresses)) < len(addresses):
            raise ValueError("sonars: two of them have the same address")
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min {self.range_min} m: expected less than range_max {self.range_max} m")
        slot, ranging = 1 / self.rate / len(self.groups), 2 * self.range_max / self.speed_of_sound
        if slot < ranging + 0.015:
            raise ValueError(
                f"rate {self.rate}: a group needs {ranging + 0.015:.3f} s, but only {slot:.3f} s are available"
            )
        return self
