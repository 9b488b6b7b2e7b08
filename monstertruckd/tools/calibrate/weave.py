"""Dead time and lag of the steering from a weaving truck, fitted to the gate's commands and the turns of the compass.

The integral of the lagged curvature times the speed is the expected turn of the compass. Each weave has its own gain
(the linkage may turn less than expected) and trim (the axles may be off centre).

The accelerometers of the compass mistake starting (2 degrees in the first 0.1 s at speed) and turning (0.1 degrees to
either side) for tilt. Levelling the field by such a tilt changes the heading by one and a half times as much, depending
on the direction of north, which looks like a different delay and less lag. So headings are computed from the field with
a single tilt for each weave; the floor is level.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from monstertruck_drivers.os4000.attitude import level_field
from monstertruck_drivers.os4000.config import IronConfig
from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import Attitude
from monstertruckd.config.calibration import Estimate
from monstertruckd.config.wizards import STEERING
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.response import ResponseFit, Steps, unexplained
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep

ANGLE: Final = 0.12
"""Small axle angle, for which the curvature is almost linear, rad."""


def weaves(rounds: int) -> list[MoveStep]:
    """Return the moves of ``rounds`` weaves, alternately forward and back."""
    return [
        # Seconds between changes of side: many changes determine the lag, a long arc the gain. Evenly spaced changes
        # could not separate them.
        MoveStep(f"weaving {direction}", sign * 0.15, ANGLE, -ANGLE, 1.8, weave=(0.3, 0.3, 0.3, 0.3, 1.2))  # m
        for _ in range(rounds)
        for sign, direction in ((1, "ahead"), (-1, "back"))
    ]


@dataclass(frozen=True, slots=True)
class Weave:
    """One weaving move, prepared for the fit."""

    curvature: Steps
    """Commanded curvature, 1/m."""
    times: Array
    """Times of the headings, s; (n,)."""
    distances: Array
    """Distances travelled until these times, m; (n,)."""
    stride: int
    """Number of headings between two that are compared."""
    turns: Array
    """Turns measured between compared headings, rad; (n - stride,)."""

    @classmethod
    def of(cls, record: MoveRecord, chassis: TruckChassis, iron: IronConfig) -> Self | None:
        """Create a weave from readings at speed; None if there are too few."""
        times = np.array([reading.stamp for reading in record.drive]) / SECOND
        speeds = np.abs([reading.velocity for reading in record.drive])
        # 0.9: minimum fraction of the maximum speed for readings apart from start and stop
        steady = times[speeds >= 0.9 * speeds.max(initial=0.0)]
        if not (record.steering_commands and steady.size):
            return None
        seen = [reading for reading in record.attitude if steady[0] <= reading.stamp / SECOND <= steady[-1]]
        at = np.array([reading.stamp for reading in seen]) / SECOND
        # Seconds between two compared headings, about as long as the steering stays on one side.
        stride = max(round(0.3 * (at.size - 1) / float(at[-1] - at[0])), 1) if at.size > 1 else 1
        if at.size <= stride:
            return None
        yaws = -steady_headings(seen, iron)
        rolled = chassis.drivetrain.distance(np.array([reading.position for reading in record.drive]))
        sent = np.array([(command.stamp / SECOND, command.front, command.rear) for command in record.steering_commands])
        curvatures = chassis.bicycle.body_twist(np.ones(len(sent)), sent[:, 1], sent[:, 2])[2]
        return cls(
            curvature=Steps.of(sent[:, 0], np.asarray(curvatures)),
            times=at,
            distances=np.interp(at, times, rolled),
            stride=stride,
            turns=yaws[stride:] - yaws[:-stride],
        )

    def residuals(self, delay: float, squared: float) -> Array:
        """Residuals of the turns for the best gain and trim (rad); for the arguments see ``Steps.integral``."""
        turned = (
            np.diff(self.curvature.integral(self.times, delay, squared)) / np.diff(self.times) * np.diff(self.distances)
        )
        predicted = np.append(0.0, np.cumsum(turned))
        return unexplained(
            self.turns, *(series[self.stride :] - series[: -self.stride] for series in (predicted, self.distances))
        )


def steady_headings(readings: Sequence[Attitude], iron: IronConfig) -> Array:
    """Clockwise, unwrapped headings (rad) of a body with constant tilt, whatever its accelerometers report; shape (n,).

    Args:
        readings: readings in chronological order; without a field, the heading of the compass is used.
        iron: magnetic calibration of the unit.
    """
    fields = [(field.x, field.y, field.z) for reading in readings if (field := reading.magnetic_field) is not None]
    if len(fields) < len(readings):
        return np.unwrap([reading.heading for reading in readings])
    x, y, z = np.array(fields).T
    pitch, roll = (np.full_like(x, np.mean([getattr(r, angle) for r in readings])) for angle in ("pitch", "roll"))
    forward, left = level_field((x, y, z), pitch, roll, iron)
    return np.unwrap(np.arctan2(left, forward))


def response(records: Iterable[MoveRecord], chassis: TruckChassis, iron: IronConfig) -> ResponseFit:
    """Fit dead time and lag of the axles relative to the commands.

    Args:
        records: records of weaves.
        chassis: kinematics, for the turns expected from commands.
        iron: magnetic calibration used by the compass driver.

    Raises:
        InputError: there are too few turns were measured.
    """
    seen = [weave for record in records if (weave := Weave.of(record, chassis, iron)) is not None]
    samples = sum(weave.turns.size for weave in seen)
    least = 60  # minimum number of turns to fit dead time and lag
    if samples < least:
        raise InputError(f"only {samples} turns determine dead time and lag: expected {least}")

    def residuals(delay: float, squared: float) -> Array:
        return np.concatenate([weave.residuals(delay, squared) for weave in seen])

    return ResponseFit.of(residuals, ASSUMED.servo_wait, ASSUMED.weave_linearity)


def estimates(found: ResponseFit) -> list[Estimate]:
    """Estimates in the form in which they are saved."""
    meanings = (
        "from a command to the first movement of the wheels",
        "time constant of the turning wheels",
        "dead time plus lag",
    )
    covers = (
        "95 % interval from the compass's noise, a linkage nonlinearity of 2 %, and "
        f"{2000 * ASSUMED.servo_wait:g} ms of waiting for a pulse"
    )
    return found.estimates(meanings, covers, key=STEERING)
