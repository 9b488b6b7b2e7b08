"""Dead time and lag of the steering, from a weaving truck: the gate's commands against the turns of the compass.

The integral of the lagged curvature, times the speed, is the turn that the compass should see. Each weave has its own
gain (the linkage may turn less than it should) and trim (the axles may be off centre).

The unit's accelerometers mistake starting (2 degrees in the first 0.1 s at speed) and turning (0.1 degrees to either
side) for tilt. A field that is levelled by such a tilt turns the heading by half as much again, by where north is,
which looks like another delay and less lag. So headings are computed from the field with one tilt for the whole weave;
the floor is level.
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
"""Small, so that the curvature is about linear in it."""


def weaves(rounds: int) -> list[MoveStep]:
    """Forward and back, in turn."""
    return [
        # Seconds between changes of side: many changes determine the lag, and a long arc the gain, which has a
        # similar effect where changes follow each other evenly.
        MoveStep(f"weaving {direction}", sign * 0.15, ANGLE, -ANGLE, 1.8, weave=(0.3, 0.3, 0.3, 0.3, 1.2))  # m
        for _ in range(rounds)
        for sign, direction in ((1, "ahead"), (-1, "back"))
    ]


@dataclass(frozen=True, slots=True)
class Weave:
    """One weaving move, ready for the fit."""

    curvature: Steps
    """Commanded, 1/m."""
    times: Array
    """Times of the headings, s; (n,)."""
    distances: Array
    """Distances rolled until then, m; (n,)."""
    stride: int
    """Headings from one to the one it is compared with."""
    turns: Array
    """Measured between those, rad; (n - stride,)."""

    @classmethod
    def of(cls, record: MoveRecord, chassis: TruckChassis, iron: IronConfig) -> Self | None:
        """Build it from readings at speed; None if they are too few to compare headings."""
        times = np.array([reading.stamp for reading in record.drive]) / SECOND
        speeds = np.abs([reading.velocity for reading in record.drive])
        # 0.9: minimum fraction of the maximum speed of a truck that neither starts nor stops
        steady = times[speeds >= 0.9 * speeds.max(initial=0.0)]
        if not (record.steering_commands and steady.size):
            return None
        seen = [reading for reading in record.attitude if steady[0] <= reading.stamp / SECOND <= steady[-1]]
        at = np.array([reading.stamp for reading in seen]) / SECOND
        # Seconds between two headings that are compared, about as long as the steering keeps to one side.
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
        """Turns that remain unexplained, rad, whatever gain and trim are; arguments as ``Steps.integral``."""
        turned = (
            np.diff(self.curvature.integral(self.times, delay, squared)) / np.diff(self.times) * np.diff(self.distances)
        )
        predicted = np.append(0.0, np.cumsum(turned))
        return unexplained(
            self.turns, *(series[self.stride :] - series[: -self.stride] for series in (predicted, self.distances))
        )


def steady_headings(readings: Sequence[Attitude], iron: IronConfig) -> Array:
    """Headings of a body that keeps its tilt, whatever its accelerometers feel: clockwise, rad, unwrapped; (n,).

    Args:
        readings: in their order; where one has no field, the unit's own headings are taken.
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
    """Dead time and lag of the axles behind the commands.

    Args:
        records: records of weaves.
        chassis: for the turns that commands mean.
        iron: magnetic calibration that the compass runs with.

    Raises:
        InputError: too few turns were seen.
    """
    seen = [weave for record in records if (weave := Weave.of(record, chassis, iron)) is not None]
    samples = sum(weave.turns.size for weave in seen)
    least = 60  # turns that dead time and lag have to rest on
    if samples < least:
        raise InputError(f"only {samples} turns determine dead time and lag: expected {least}")

    def residuals(delay: float, squared: float) -> Array:
        return np.concatenate([weave.residuals(delay, squared) for weave in seen])

    return ResponseFit.of(residuals, ASSUMED.servo_wait, ASSUMED.weave_linearity)


def estimates(found: ResponseFit) -> list[Estimate]:
    """Saved form."""
    meanings = (
        "from a command to the first movement of the wheels",
        "time constant of the turning wheels",
        "dead time and lag together",
    )
    covers = (
        f"95 % of the compass's noise, a linkage 2 % from linear, "
        f"and {2000 * ASSUMED.servo_wait:g} ms of waiting for a pulse"
    )
    return found.estimates(meanings, covers, key=STEERING)
