"""Calibration proposed by trackers: learned while driving, kept across restarts, used after an operator accepts it.

A tracker learns gain and trim of an axle with their covariance. If they differ significantly from the calibration, the
tracker proposes the pulse map that would steer the axle as requested. Nothing uses the proposal until an operator
accepts it (``calibrate accept``). A proposal learned with a calibration other than the current one is void.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from monstertruck_kinematics.chassis import Chassis
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.small_files import make_folder, put_aside, replace_file
from monstertruck_schemas.base import Schema
from monstertruck_schemas.plan import AxleDeviation, TrackerState
from monstertruckd.config.calibration import Estimate, Result, value_at
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import STEERING, WIZARDS

WIZARD: Final = "steering"
"""Wizard whose values are proposed."""
SPAN: Final = 0.2
"""Axle angles to both sides for which the proposed pulse map is fitted, rad; servos of every truck reach them."""
HALF: Final = 1.96
"""Half-width of a 95 % interval in standard deviations."""


class _File(Schema):
    """Content of the proposal file."""

    base: str
    """Calibration file used by the daemon; empty: none."""
    result: Result


@dataclass
class SteeringProposal:
    """Store for the latest proposal.

    Args:
        config: running configuration, including the calibration.
        base: calibration file in use; empty if there is none.
        file: file for the proposal; None if it is not saved.
    """

    config: TruckConfig
    base: str
    file: Path | None
    result: Result | None = None
    _chassis: Chassis = field(init=False)
    _closed: bool = False
    """The steering was calibrated in this run: ignore trackers until the next start."""

    def __post_init__(self) -> None:
        self._chassis = self.config.chassis()

    def load(self) -> str:
        """Read the file; may block.

        Returns:
            Fault of the file; empty if it is intact or missing.
        """
        if self.file is None:
            return ""
        expected = "a proposed calibration"
        try:
            data = contents_if_present(self.file, expected, 100_000)  # maximum size of a proposal, bytes
            if data is None:
                return ""
            with reading(self.file, expected):
                found = _File.model_validate_json(data)
        except InputError as error:
            return str(error)
        if found.base == self.base:
            self.result = found.result
        return ""

    def put_aside(self) -> str:
        """Rename a damaged file and return a sentence about it; may block."""
        return "" if self.file is None else put_aside(self.file)

    def save(self) -> None:
        """Write the file, or remove it if there is no proposal; may block.

        Raises:
            OSError: the file cannot be written.
        """
        if self.file is None:
            return
        if self.result is None:
            self.file.unlink(missing_ok=True)
            return
        make_folder(self.file.parent)
        replace_file(self.file, _File(base=self.base, result=self.result).model_dump_json(indent=1) + "\n")

    def consider(self, state: TrackerState, date: str) -> bool:
        """Propose a tracker's estimate if it differs from the current proposal; return whether it does.

        Args:
            state: latest state of the tracker.
            date: current time (UTC).
        """
        if self._closed or not WIZARDS[WIZARD].fits(self.config):
            return False
        rows = [row for row in state.steering if row.servo_differs]
        estimates = [estimate for row in rows for estimate in self._estimates(row, date)]
        if not estimates or not self._news(estimates):
            return False
        self.result = Result(
            wizard=WIZARD,
            date=date,
            measured=f"learnt while driving: {state.steering_differs}",
            estimates=tuple(estimates),
            unobserved=("travel of the wheels", "direction of the servos"),
            partial=True,
        )
        return True

    def close(self) -> None:
        """Drop the proposal because the steering was calibrated, or its calibration was undone."""
        self.result, self._closed = None, True

    def _news(self, estimates: list[Estimate]) -> bool:
        """Return whether any value differs, or is proposed for the first time."""
        for new in estimates:
            old = None if self.result is None else self.result.estimate(new.name)
            if old is None or old.low is None or old.high is None or not old.low <= new.value <= old.high:
                return True
        return False

    def _estimates(self, row: AxleDeviation, date: str) -> tuple[Estimate, ...]:
        """Centre and scale of the pulse map that steers an axle as requested."""
        data, servo = self.config.model_dump(), f"{STEERING}.{row.axle}"
        centre, scale, direction = (
            value_at(data, f"{servo}.{key}") for key in ("centre_us", "scale_us_per_deg", "direction")
        )
        if centre is None or scale is None or direction is None:
            return ()
        wanted = np.linspace(-SPAN, SPAN, 21)
        # To reach `wanted`, the axle must be commanded this angle.
        asked = (wanted - row.trim) / row.gain
        right, sent = (np.degrees([self._servo(row.axle, angle) for angle in angles]) for angles in (wanted, asked))
        slope, begin = np.polyfit(right, sent, 1).tolist()
        by_angle = (right[-1] - right[0]) / (2 * SPAN)  # degrees of servo angle per radian of axle angle
        centre_half = HALF * scale * slope * by_angle * row.trim_deviation
        scale_half = HALF * scale * slope * row.gain_deviation / abs(row.gain)
        values = (
            ("centre", "centre_us", "us", centre + direction * scale * begin, centre_half, "pulse straight ahead"),
            ("scale", "scale_us_per_deg", "us/deg", scale * slope, scale_half, "pulse per degree of the servo"),
        )
        return tuple(
            Estimate(
                name=f"{row.axle}_{name}",
                value=round(value, 3),
                unit=unit,
                low=round(value - abs(half), 3),
                high=round(value + abs(half), 3),
                samples=max(row.samples, 1),
                meaning=f"{meaning}, learnt by the tracker",
                key=f"{servo}.{key}",
                date=date,
            )
            for name, key, unit, value, half, meaning in values
        )

    def _servo(self, axle: str, angle: float) -> float:
        """Servo angle (rad) for an axle angle while the other axle is straight."""
        front, rear = self._chassis.servos(*((angle, 0.0) if axle == "front" else (0.0, angle)))
        return math.remainder(front if axle == "front" else rear, math.tau)
