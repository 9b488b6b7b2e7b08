"""Emulated range finder."""

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import BeamSource, EmulatorSetup, RangeSheet
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import Clock
from truck_sonar.protocol import BAUD, FARTHEST, NEAREST, PERIOD

SHEET = RangeSheet(NEAREST / 1000, FARTHEST / 1000, 0.006, 0.0)
"""Ranges and error bound (m)."""


class Mb7360Emulator(FaultyDevice):
    """Sends a line every ``PERIOD`` and ignores input.

    Faults (`inject`): ``deaf on|off`` (receives no echo), ``garbage on|off``.

    Args:
        clock: Clock that paces the lines.
        source: Ranges to the surroundings of the truck.
        seed: Seed of the faults.
    """

    def __init__(self, clock: Clock, source: BeamSource, *, seed: int = 0) -> None:
        self.name = "mb7360"
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        self.faults = FaultTable(self.name, {"deaf|garbage on|off": False})
        self.signals = Signals(clock.now, {"range": SignalKind.NUMBER}, self._rng)

    async def run(self, end: DeviceEnd) -> None:
        """Measure until cancelled."""
        while True:
            await self._clock.sleep(PERIOD)
            end.write(self._line())

    def power_cycle(self) -> None:
        """Do nothing: the device stores no settings."""

    def _line(self) -> bytes:
        if self.faults["garbage"]:
            return self._rng.bytes(6)
        (ahead,) = self._source.beams(np.zeros(1), np.array([self._clock.now()]), SHEET)
        if self.faults["deaf"] or not np.isfinite(ahead):
            return b"R%04d\r" % FARTHEST
        shown = self.signals.report("range", round(1000 * ahead))
        return b"R%04d\r" % np.clip(shown, NEAREST, FARTHEST)


def emulated(setup: EmulatorSetup) -> Mb7360Emulator:
    """Return the range finder of a simulated truck, with the real baud rate."""
    setup.port.device.baud = BAUD
    return Mb7360Emulator(setup.clock, setup.physics.lidar, seed=setup.seed)
