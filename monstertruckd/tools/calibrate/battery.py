"""Scale of the battery voltage from a multimeter, and its offset as far as readings lie apart.

``volts = gain * raw + offset``, ``raw`` being what the input would show with gain 1 and offset 0. A pack moves by 4 V
between full and empty, so a second reading usually comes days later: readings are kept with the result and used again.
"""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery
from monstertruckd.config.calibration import STEERING, Result
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, estimated
from monstertruckd.tools.calibrate.steps import Collect, Confirm, Number
from monstertruckd.tools.calibrate.wizard import Wizard, WizardContext

METER: Final = Number("meter", "Voltage of the pack at its plug by the multimeter, V", 5.0, 70.0)
ANOTHER: Final = Confirm("another", "Take another reading now, with the pack at another voltage?", fact=True)
GROUND: Final = 0.1
"""Greatest offset, V: 10 mV along the ground wire, times the divider."""
ROUNDING: Final = 0.5
"""Part of the rounding of one reading that is left in their mean: noise averages it out, but is never relied on."""


@dataclass(frozen=True, slots=True)
class MeterReading:
    """The same pack by input and by meter."""

    raw: float
    volts: float
    error: float
    """Standard error of ``raw``."""


@dataclass(frozen=True, slots=True)
class BatteryWizard:
    """One or more readings of a multimeter."""

    meter_share: float = 0.005
    """Greatest error of the multimeter as a share of its reading"""
    meter_digits: float = 0.02
    """And the rest of it, V"""
    samples: int = 50
    fresh: bool = False
    """Forget the readings of earlier runs"""

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        keys = self._keys(context)
        gain, offset = (float(context.value(key)) for key in keys)
        earlier = context.known.get("battery")
        readings = [] if self.fresh or earlier is None else [MeterReading(*row) for row in earlier.readings]
        context.say("Measure at rest, with everything switched on that is always on; the truck does not move.")
        while True:
            volts = await context.ask(METER)
            taken = await context.collect(Collect("battery voltage", topics.BATTERY, self.samples, 30.0))
            readings.append(self._reading(taken, volts, gain, offset, self._step(context)))
            if not await context.confirm(ANOTHER):
                break
        return context.fit("scale", lambda: self._result(readings, keys))

    @staticmethod
    def _keys(context: WizardContext) -> tuple[str, str]:
        config = context.config
        if config.monitors.battery is not None:
            return "monitors.battery.divider", "monitors.battery.offset"
        if config.devices.steering is not None and config.devices.steering.driver.battery is not None:
            return f"{STEERING}.battery.gain", f"{STEERING}.battery.offset"
        raise RequestRefusedError(Reason.NOT_SUPPORTED, "this truck measures no battery voltage")

    @staticmethod
    def _step(context: WizardContext) -> float:
        """Rounding of one raw reading, V; 0 where the converter is fine enough."""
        steering = context.config.devices.steering
        coarse = (
            context.config.monitors.battery is None and steering is not None and steering.driver.battery is not None
        )
        return float(context.value(f"{STEERING}.battery.volts_per_count")) if coarse else 0.0

    @staticmethod
    def _reading(taken: list[Battery], volts: float, gain: float, offset: float, step: float) -> MeterReading:
        raw = (np.array([message.raw_voltage for message in taken]) - offset) / gain
        if raw.min() <= 0 or raw.std() > 0.02 * raw.mean():
            raise InputError(f"the input reads {raw.min():.2f} to {raw.max():.2f} V: no steady voltage to compare with")
        rounding = ROUNDING * step / math.sqrt(12)
        return MeterReading(float(raw.mean()), volts, math.hypot(float(raw.std()) / math.sqrt(raw.size), rounding))

    def _result(self, readings: list[MeterReading], keys: tuple[str, str]) -> Result:
        volts = [reading.volts for reading in readings]
        gain, offset = self.bounds(readings)
        observed = offset.half < 0.9 * GROUND
        bounds = (
            f"pack volts; bounds from the meter's {self.meter_share:.1%} and {self.meter_digits:g} V, the input's "
            f"rounding, and at most {GROUND:g} V along the ground wire"
        )
        estimates = tuple(
            estimated(name, found, unit, len(readings), f"{what} {bounds}", key)
            for name, found, unit, what, key in (
                ("gain", gain, "", "factor from the input's reading to", keys[0]),
                ("offset", offset, "V", "added to get", keys[1]),
            )
        )
        return Result(
            wizard="battery",
            measured=f"{len(readings)} readings of a multimeter, {min(volts):.2f} to {max(volts):.2f} V",
            estimates=estimates,
            unobserved=() if observed else ("the offset: it takes readings of a fuller and an emptier pack",),
            readings=tuple((reading.raw, reading.volts, reading.error) for reading in readings),
        )

    def bounds(self, readings: list[MeterReading]) -> tuple[Interval, Interval]:
        """Gain and offset: the middle and half the extent of all lines that pass every reading within its bounds.

        Raises:
            InputError: there is no such line.
        """
        rows, limits = [(0.0, 1.0), (0.0, -1.0)], [GROUND, GROUND]
        for reading in readings:
            noise = NORMAL * reading.error * reading.volts / reading.raw
            bound = self.meter_share * reading.volts + self.meter_digits + noise
            rows += [(reading.raw, 1.0), (-reading.raw, -1.0)]
            limits += [reading.volts + bound, bound - reading.volts]
        sides, ends = np.array(rows), np.array(limits)
        corners = [
            np.linalg.solve(sides[[i, j]], ends[[i, j]])
            for i, j in combinations(range(len(rows)), 2)
            if abs(np.linalg.det(sides[[i, j]])) > 1e-9
        ]
        inside = np.array([corner for corner in corners if (sides @ corner <= ends + 1e-9).all()])
        if not inside.size:
            raise InputError(
                f"no scale fits all {len(readings)} readings: a slip, or the divider has changed; forget the earlier "
                "readings with --fresh"
            )
        low, high = inside.min(axis=0), inside.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        return Interval(float(middle[0]), float(half[0])), Interval(float(middle[1]), float(half[1]))


def battery_wizard(settings: BatteryWizard | None = None) -> Wizard:
    """Voltage scale."""
    doc = "scale of the battery voltage from a multimeter, and its offset from two readings apart"
    return Wizard("battery", doc, "", settings or BatteryWizard())
