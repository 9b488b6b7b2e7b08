"""Scale of the battery voltage, measured with a multimeter, and its offset if the readings span different voltages.

``volts = gain * raw + offset``, where ``raw`` is the input's reading with gain 1 and offset 0. A pack changes by 4 V
between full and empty, so a second reading is usually taken days later: readings are saved with the result and reused.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery
from monstertruckd.config.calibration import Result, WizardName
from monstertruckd.config.wizards import STEERING
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, estimated
from monstertruckd.tools.calibrate.steps import Collect, Confirm, Number, Plot
from monstertruckd.tools.calibrate.wizard import WizardContext

METER: Final = Number("meter", "Pack voltage measured with the multimeter at the plug, V", 5.0, 70.0)
ANOTHER: Final = Confirm("another", "Take another reading now, with the pack charged to another voltage?", fact=True)
EARTHING: Final = 0.1
"""Maximum offset, V: 10 mV along the ground wire, times the divider."""
EVEN: Final = math.sqrt(3)
"""Ratio of maximum error to standard deviation of a uniform distribution."""


@dataclass(frozen=True, slots=True)
class MeterReading:
    """One pack voltage, measured by both the input and the multimeter."""

    raw: float
    volts: float
    error: float
    """Standard error of ``raw``."""


@dataclass(frozen=True, slots=True)
class BatteryWizard:
    """Wizard that compares the input with one or more multimeter readings."""

    name: ClassVar[WizardName] = "battery"
    doc: ClassVar[str] = "scale of the battery voltage from a multimeter; its offset if the readings cover two voltages"
    room: ClassVar[str] = ""
    meter_share: float = 0.005
    """Maximum error of the multimeter, as a fraction of its reading"""
    meter_digits: float = 0.02
    """Maximum constant error of the meter (V)"""
    samples: int = 50
    fresh: bool = False
    """Discard the readings of earlier runs"""

    @classmethod
    def of(cls, meter_error: float, meter_digits: float, fresh: bool) -> Self:
        """Create a wizard from the command's options: the proportional and constant error of the meter."""
        return cls(meter_error, meter_digits, fresh=fresh)

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        keys = self._keys(context)
        gain, offset = (float(context.value(key)) for key in keys)
        earlier = context.known.get("battery")
        readings = [] if self.fresh or earlier is None else [MeterReading(*row) for row in earlier.readings]
        context.say("Measure at rest, with all permanent loads switched on; the robot does not move.")
        while True:
            volts = await context.ask(METER)
            taken = await context.collect(Collect("battery voltage", topics.BATTERY, self.samples, 30.0))
            reading = self._reading(taken, volts, gain, offset, self._step(context))
            check_input(reading, gain)
            readings.append(reading)
            self._plot(context, readings)
            if not await context.confirm(ANOTHER):
                break
        result = context.fit("scale", lambda: self._result(readings, keys))
        self._plot(context, readings, self.scale(readings))
        return result

    @staticmethod
    def _plot(
        context: WizardContext, readings: list[MeterReading], scale: tuple[Interval, Interval] | None = None
    ) -> None:
        points = np.array([(reading.raw, reading.volts) for reading in readings])
        raw = np.array((points[:, 0].min(), points[:, 0].max()))
        line = None if scale is None else np.column_stack((raw, scale[0].value * raw + scale[1].value))
        context.plot(Plot("voltage of the pack", "input (V)", "multimeter (V)", points, line))

    @staticmethod
    def _keys(context: WizardContext) -> tuple[str, str]:
        config = context.config
        if config.monitors.battery is not None:
            return "monitors.battery.divider", "monitors.battery.offset"
        if config.devices.steering is not None and config.devices.steering.driver.battery is not None:
            return f"{STEERING}.battery.gain", f"{STEERING}.battery.offset"
        raise RequestRefusedError(Reason.NOT_SUPPORTED, "this robot does not measure a battery voltage")

    @staticmethod
    def _step(context: WizardContext) -> float:
        """Resolution of one raw reading (V); 0 if the converter's resolution is fine enough."""
        steering = context.config.devices.steering
        coarse = (
            context.config.monitors.battery is None and steering is not None and steering.driver.battery is not None
        )
        return float(context.value(f"{STEERING}.battery.volts_per_count")) if coarse else 0.0

    @staticmethod
    def _reading(taken: list[Battery], volts: float, gain: float, offset: float, step: float) -> MeterReading:
        raw = (np.array([message.raw_voltage for message in taken]) - offset) / gain
        if raw.min() <= 0 or raw.std() > 0.02 * raw.mean():
            raise InputError(
                f"the battery input varies from {raw.min():.2f} to {raw.max():.2f} V: the voltage must be "
                "steady for the comparison"
            )
        # 0.5: part of the rounding error of one reading that may remain in the mean; noise usually averages it out
        rounding = 0.5 * step / math.sqrt(12)
        return MeterReading(float(raw.mean()), volts, math.hypot(float(raw.std()) / math.sqrt(raw.size), rounding))

    def _result(self, readings: list[MeterReading], keys: tuple[str, str]) -> Result:
        volts = [reading.volts for reading in readings]
        gain, offset = self.scale(readings)
        observed = offset.half < 0.9 * EARTHING
        bounds = (
            f"pack volts; 95 % interval from the meter's accuracy ({self.meter_share:.1%} and "
            f"{self.meter_digits:g} V), the rounding of the input, and up to {EARTHING:g} V of drop on "
            "the ground wire"
        )
        estimates = tuple(
            estimated(name, found, unit, len(readings), f"{what} {bounds}", key)
            for name, found, unit, what, key in (
                ("gain", gain, "", "factor from the input voltage to", keys[0]),
                ("offset", offset, "V", "offset added to obtain", keys[1]),
            )
        )
        return Result(
            wizard="battery",
            measured=f"{len(readings)} multimeter readings from {min(volts):.2f} to {max(volts):.2f} V",
            estimates=estimates,
            unobserved=() if observed else ("the offset: it needs readings of a fuller and an emptier pack",),
            readings=tuple((reading.raw, reading.volts, reading.error) for reading in readings),
        )

    def scale(self, readings: list[MeterReading]) -> tuple[Interval, Interval]:
        """Fit gain and offset by least squares.

        The meter's proportional error is common to all readings; its digit error is independent. Errors with only a
        known bound are assumed to be uniformly distributed within it.

        Raises:
            InputError: no line fits every reading within its bounds.
        """
        raw = np.array([reading.raw for reading in readings])
        volts = np.array([reading.volts for reading in readings])
        noise = np.array([reading.error for reading in readings]) * volts / raw
        self._check(raw, volts, NORMAL * noise)
        # 1e-4: minimum error of a reading, V
        sigma = np.maximum(np.hypot(self.meter_digits / EVEN, noise), 1e-4)
        share = max(self.meter_share, 1e-6)
        rows = np.vstack(
            (
                np.column_stack((raw, np.ones_like(raw), volts)) / sigma[:, None],
                (0.0, EVEN / EARTHING, 0.0),
                (0.0, 0.0, EVEN / share),
            )
        )
        errors = np.linalg.inv(rows.T @ rows)
        gain, offset, _ = errors @ rows.T @ np.concatenate((volts / sigma, (0.0, 0.0)))
        halves = NORMAL * np.sqrt(np.diag(errors))
        # The ground wire limits the offset; the gain is adapted, so that both fit the readings.
        low, high = np.clip((offset - halves[1], offset + halves[1]), -EARTHING, EARTHING).tolist()
        within = Interval((low + high) / 2, (high - low) / 2)
        gain += errors[0, 1] / errors[1, 1] * (within.value - offset)
        return Interval(float(gain), float(halves[0])), within

    def _check(self, raw: Array, volts: Array, noise: Array) -> None:
        """Raise InputError if no gain and offset explain all readings.

        For a given offset, each reading allows a range of gains.
        """
        bounds = self.meter_share * volts + self.meter_digits + noise
        offsets = np.linspace(-EARTHING, EARTHING, 201)[:, None]
        low, high = (volts - bounds - offsets) / raw, (volts + bounds - offsets) / raw
        if not (low.max(axis=1) <= high.min(axis=1)).any():
            raise InputError(
                f"no scale fits all {len(raw)} readings: a reading was mistyped or the voltage divider "
                "has changed; discard the earlier readings with --fresh"
            )


def check_input(reading: MeterReading, gain: float) -> None:
    """Reject a reading that cannot come from the battery.

    Raises:
        InputError: the input reads less than half or more than twice the meter's voltage.
    """
    shown = reading.raw * gain
    if not volts_near(shown, reading.volts):
        raise InputError(
            f"the input reads {shown:.1f} V but the meter shows {reading.volts:.1f} V: check that the "
            "cable is on the configured input and that the divider matches the configuration"
        )


def volts_near(shown: float, volts: float) -> bool:
    """Return whether two voltages may belong to the same pack if the divider is wrong by at most a factor of two."""
    return volts / 2 < shown < 2 * volts
