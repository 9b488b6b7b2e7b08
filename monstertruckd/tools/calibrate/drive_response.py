"""Dead time and lag of the drive, from straight runs: what the gate commanded, and how far the motor had turned.

Setting off and stopping are apart: drivers pass on a slower speed at once, a faster one with their next cycle.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration import Estimate
from monstertruckd.tools.calibrate.response import ResponseFit, Steps, unexplained
from monstertruckd.tools.calibrate.steps import MoveRecord

Part = Literal["start", "stop"]
LEAST: Final = 8
"""Positions of a motor from rest to half the way, or from there to rest, that dead time and lag have to rest on."""


@dataclass(frozen=True, slots=True)
class HalfRun:
    """A run from rest to the middle of its way, or from there to rest."""

    speed: Steps
    """Commanded, rad/s of the motor."""
    times: Array
    """Of the positions, s; (n,)."""
    positions: Array
    """Of the motor, rad; (n,)."""

    @classmethod
    def of(cls, record: MoveRecord, part: Part) -> Self | None:
        """None where there is too little of it."""
        if not record.drive_commands:
            return None
        times = np.array([reading.stamp for reading in record.drive]) / SECOND
        positions = np.array([reading.position for reading in record.drive])
        first = np.abs(positions - positions[0]) <= np.abs(positions - positions[-1])
        kept = first if part == "start" else ~first
        if int(kept.sum()) < LEAST:
            return None
        sent = np.array([(command.stamp / SECOND, command.motor_velocity) for command in record.drive_commands])
        return cls(Steps.of(sent[:, 0], sent[:, 1]), times[kept], positions[kept])

    def residuals(self, delay: float, squared: float) -> Array:
        """Positions that remain unexplained, rad, whatever gain and origin are; arguments as ``Steps.integral``."""
        due = self.speed.integral(self.times, delay, squared)
        return unexplained(self.positions - self.positions[0], due, np.ones_like(due))


def drive_response(records: Iterable[MoveRecord], part: Part, cycle: float) -> ResponseFit:
    """How the motor follows the gate's commands.

    Args:
        records: straight runs, rests included.
        part: which half of them.
        cycle: seconds between two looks of the driver at its commands.

    Raises:
        InputError: too little was read.
    """
    seen = [half for record in records if (half := HalfRun.of(record, part)) is not None]
    if not seen:
        raise InputError(f"{part}: no run with {LEAST} readings of the drive and the gate's commands")

    def residuals(delay: float, squared: float) -> Array:
        return np.concatenate([half.residuals(delay, squared) for half in seen])

    return ResponseFit.of(residuals, cycle / 2, cycle**2 / 6)


def drive_estimates(records: Iterable[MoveRecord], rate: float) -> list[Estimate]:
    """Of both parts, for information; ``rate`` is that of the driver's cycles, 1/s.

    Raises:
        InputError: as ``drive_response``.
    """
    runs, found = list(records), []
    parts: tuple[tuple[Part, str], ...] = (("start", "setting off"), ("stop", "stopping"))
    for part, what in parts:
        meanings = (
            f"{what}: from a command to the first change of the motor's speed",
            f"{what}: time constant of the motor's speed",
            f"{what}: dead time and lag together; gate.reaction has to cover it, and wheels that follow later",
        )
        covers = f"95 % of the runs' spread, and the driver's cycle of {1000 / rate:g} ms"
        found += drive_response(runs, part, 1 / rate).estimates(meanings, covers, prefix=f"{part}_")
    return found
