"""Settings for a RoboClaw used as an encoder counter."""

import math
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_drivers.roboclaw.protocol import ADDRESSES
from monstertruck_schemas.base import Schema


class RoboclawConfig(Schema):
    """RoboClaw with an encoder on each rear wheel; its motor outputs are unused."""

    kind: Literal["roboclaw"] = "roboclaw"
    address: Annotated[int, Field(ge=ADDRESSES[0], le=ADDRESSES[1])] = ADDRESSES[0]
    """Packet serial address, 128 to 135"""
    counts_per_turn: Annotated[int, Field(ge=8, le=1_000_000)] = 4096
    """Counts (edges of both channels) per turn of the WHEEL"""
    left: Literal[1, 2] = 1
    """Encoder input of the left wheel; the right wheel uses the other input"""
    left_inverted: bool = False
    """Whether the left encoder counts down when the robot drives forward"""
    right_inverted: bool = False
    """Whether the right encoder counts down when the robot drives forward"""
    rate: Annotated[float, Field(ge=5, le=50)] = 25.0
    """Reading rate (Hz)"""
    answer_timeout: Annotated[float, Field(gt=0, le=0.2)] = 0.03
    """Timeout of an answer (s)"""
    max_rate: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Maximum rate of a wheel (rad/s); counts that imply a higher rate mean that the unit has restarted"""

    @property
    def count(self) -> float:
        """Wheel angle per count (rad)."""
        return math.tau / self.counts_per_turn
