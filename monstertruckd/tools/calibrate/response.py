"""Dead time and lag of the steering, from a weaving truck: what the gate commanded, and how the compass turned.

Commands are piecewise constant. ``s`` seconds after the dead time a change of the curvature by ``k`` has added
``k (s - lag (1 - exp(-s / lag)))`` to its integral over time; sums of these, times the speed, are the turns that the
compass should see. They are fitted to its turns for the delay (dead time and lag together) and the square of the lag:
for slow commands the delay is all that shows, and the lag shows by its square in how turns round off. Each weave has
its own gain (the linkage may turn less than it should) and trim (the axles may be off centre).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.config.calibration import STEERING, Estimate
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, correlation_factor
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep

WEAVE: Final = (0.3, 0.3, 0.3, 0.3, 1.2)
"""Seconds between changes of side: many changes tell the lag, and a long arc tells the gain, which a lag resembles
where changes follow each other evenly."""
SPEED: Final = 0.15
ANGLE: Final = 0.12
"""Small, so that the curvature is about linear in it: what is not looks like a lag."""
METRES: Final = 1.8
START: Final = (0.08, 0.03**2)
"""First guess of the delay (s) and the square of the lag (s^2)."""
SLOWEST: Final = (0.5, 0.2**2)
"""Greatest delay (s) and square of the lag (s^2)."""
LEAST: Final = 60
"""Turns that dead time and lag have to rest on."""
BASE: Final = 0.3
"""Seconds between two headings that are compared, about as long as the steering keeps to one side."""
STEADY: Final = 0.9
"""Share of the greatest speed from which on a truck neither sets off nor stops."""
HALF_FRAME: Final = 0.010
"""Half the period of the servo pulses, s. How long a command waits for the next pulse is constant while the daemon
runs, and another time after each start: nothing between 0 and a period can be excluded."""


def weaves(rounds: int) -> list[MoveStep]:
    """Forward and back, in turn."""
    return [
        MoveStep(f"weaving {way}", sign * SPEED, ANGLE, -ANGLE, METRES, weave=WEAVE)
        for _ in range(rounds)
        for sign, way in ((1, "ahead"), (-1, "back"))
    ]


@dataclass(frozen=True, slots=True)
class Weave:
    """One weaving move, ready for the fit."""

    changed: Array
    """When the commanded curvature changed, s; (k,)."""
    changes: Array
    """By how much, 1/m; (k,)."""
    first: float
    """Curvature before, 1/m."""
    times: Array
    """Of the headings, s; (n,)."""
    ways: Array
    """Rolled until then, m; (n,)."""
    stride: int
    """Headings from one to the one it is compared with."""
    turns: Array
    """Measured between those, rad; (n - stride,)."""

    @classmethod
    def of(cls, record: MoveRecord, chassis: TruckChassis) -> Self | None:
        """From what was read while the truck was at speed; None where that is too little to compare headings."""
        times = np.array([reading.stamp for reading in record.drive]) / SECOND
        speeds = np.abs([reading.velocity for reading in record.drive])
        steady = times[speeds >= STEADY * speeds.max(initial=0.0)]
        if not (record.commands and steady.size):
            return None
        seen = [reading for reading in record.attitude if steady[0] <= reading.stamp / SECOND <= steady[-1]]
        if len(seen) < 2:
            return None
        at = np.array([reading.stamp for reading in seen]) / SECOND
        stride = max(round(BASE * (at.size - 1) / float(at[-1] - at[0])), 1)
        if at.size <= stride:
            return None
        yaws = -np.unwrap([reading.heading for reading in seen])
        rolled = chassis.drivetrain.distance(np.array([reading.position for reading in record.drive]))
        angles = np.array([(command.front, command.rear) for command in record.commands])
        curvatures = chassis.bicycle.body_twist(np.ones(len(angles)), angles[:, 0], angles[:, 1])[2]
        changes = np.diff(curvatures)
        sent = np.array([command.stamp for command in record.commands])[1:] / SECOND
        return cls(
            changed=sent[changes != 0.0],
            changes=changes[changes != 0.0],
            first=float(curvatures[0]),
            times=at,
            ways=np.interp(at, times, rolled),
            stride=stride,
            turns=yaws[stride:] - yaws[:-stride],
        )

    def residuals(self, delay: float, squared: float) -> Array:
        """Turns that remain unexplained, rad, whatever gain and trim are; (n - stride,).

        Args:
            delay: dead time and lag, s.
            squared: square of the lag, s^2; below 0, where nothing can be, the turns are extrapolated from 0.
        """
        lag = math.sqrt(abs(squared))
        integral = self._integral(delay - lag, lag)
        if squared < 0.0:
            integral = 2.0 * self._integral(delay, 0.0) - integral
        ways = np.diff(self.ways)
        predicted = np.append(0.0, np.cumsum(np.diff(integral) / np.diff(self.times) * ways))
        basis = np.column_stack([series[self.stride :] - series[: -self.stride] for series in (predicted, self.ways)])
        return np.asarray(self.turns - basis @ np.linalg.lstsq(basis, self.turns, rcond=None)[0])

    def _integral(self, dead_time: float, lag: float) -> Array:
        """Of the curvature over time, s/m; (n,)."""
        since = np.maximum(self.times[:, None] - self.changed - dead_time, 0.0)
        if lag > 0.0:
            since += lag * np.expm1(-since / lag)
        return np.asarray(self.first * self.times + since @ self.changes)


@dataclass(frozen=True, slots=True)
class ResponseFit:
    """How the axles follow commands."""

    delay: Interval
    """Dead time and lag together, s."""
    squared: Interval
    """Square of the lag, s^2; may be below 0 by the noise."""
    samples: int
    """Turns compared."""

    @property
    def lag(self) -> tuple[float, float, float]:
        """Value, least and greatest, s."""
        value, low, high = (math.sqrt(max(x, 0.0)) for x in (self.squared.value, self.squared.low, self.squared.high))
        return value, low, high


def response(records: Iterable[MoveRecord], chassis: TruckChassis) -> ResponseFit:
    """Dead time and lag of the axles behind the commands.

    Raises:
        InputError: too few turns were seen.
    """
    seen = [weave for record in records if (weave := Weave.of(record, chassis)) is not None]
    samples = sum(weave.turns.size for weave in seen)
    if samples < LEAST:
        raise InputError(f"only {samples} turns tell dead time and lag: expected {LEAST}")

    def residual(parameters: Array) -> Array:
        return np.concatenate([weave.residuals(*parameters.tolist()) for weave in seen])

    bounds = np.array(SLOWEST)
    fit = least_squares(residual, np.array(START), -bounds, bounds)
    if not np.isfinite(fit.standard_errors).all():
        raise InputError("the turns do not tell dead time and lag: did the wheels follow the commands?")
    halves = NORMAL * correlation_factor(fit.residuals) * fit.standard_errors
    delay, squared = (Interval(float(x), float(half)) for x, half in zip(fit.parameters, halves, strict=True))
    return ResponseFit(delay.widened(HALF_FRAME), squared, samples)


def estimates(found: ResponseFit) -> list[Estimate]:
    """What is saved of it."""
    lag, least, greatest = found.lag
    delay = found.delay
    noise = "95 % of the compass's noise"
    frame = f"{noise}, and {1000 * HALF_FRAME:g} ms, as a command waits up to {2000 * HALF_FRAME:g} ms for its pulse"
    dead_time = max(delay.value - lag, 0.0), max(delay.low - greatest, 0.0), max(delay.high - least, 0.0)
    rows = (
        ("dead_time", dead_time, f"from a command to the first movement; {frame}", True),
        ("lag", (lag, least, greatest), f"time constant of the turning wheels; {noise}", True),
        ("delay", (delay.value, delay.low, delay.high), f"dead time and lag together; {frame}", False),
    )
    return [
        Estimate(
            name=name,
            value=value,
            low=low,
            high=high,
            unit="s",
            samples=found.samples,
            meaning=meaning,
            key=f"{STEERING}.{name}" if saved else None,
        )
        for name, (value, low, high), meaning, saved in rows
    ]
