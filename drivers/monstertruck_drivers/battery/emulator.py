"""Sysfs files of a converter with the battery divider connected to one channel."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.battery.iio import CONVERTERS
from monstertruck_drivers.emulation import EmulatorSetup, FileTree
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

FOLDER: Final = "iio:device0"
COUNTS: Final = "counts"
"""Signal: converted voltage, LSB."""


class IioEmulator(FaultyDevice):
    """An emulated 12-bit converter, 1 mV per count, as the kernel presents it.

    Faults (``inject``): ``zero on|off`` (upper resistor open), ``full on|off`` (lower resistor open), ``freeze
    on|off``, ``garbage on|off``, ``bounce [SECONDS]`` (0 for 50 ms), ``noise LSB``, ``volts V`` (at the pin,
    instead of the source), ``unplug``, ``plug``.

    Args:
        root: folder that replaces /.
        clock: time.
        source: pin voltage at a time (ns), V.
        seed: noise seed.
        channel: channel that the divider is connected to.
        device: converter name.
    """

    FULL_SCALE: Final = 4095

    def __init__(
        self,
        root: Path,
        clock: Clock,
        source: Callable[[int], float],
        *,
        seed: int = 0,
        channel: int = 0,
        device: str = "mcp3208",
    ) -> None:
        self.name = "battery"
        self.plugged = False
        """Whether the converter is plugged in."""
        self._files = FileTree(root / CONVERTERS)
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        self.signals = Signals(clock.now, {COUNTS: SignalKind.NUMBER}, self._rng)
        self._stem = f"in_voltage{channel}"
        self._device = device
        self.faults = FaultTable(
            self.name,
            {
                "zero on|off": partial(self._force, "0"),
                "full on|off": partial(self._force, str(self.FULL_SCALE)),
                "garbage on|off": partial(self._force, "-"),
                "freeze on|off": partial(self._force, "frozen"),
                "bounce [SECONDS]": self._bounce,
                "noise LSB": 1.0,
                "volts V": self._fix,
                "unplug": self.unplug,
                "plug": self.plug,
            },
        )
        self._forced: str | None = None
        self._bounce_until = 0
        self.plug()

    def plug(self) -> None:
        """Create the files, as when the kernel finds the converter."""
        self.plugged = True
        self._files.put(f"{FOLDER}/name", self._device)
        self._files.put(f"{FOLDER}/in_voltage_scale", "1.000000000")
        self._files.put(f"{FOLDER}/scan_elements/{self._stem}_type", "be:u12/16>>0")
        self.convert()

    def unplug(self) -> None:
        """Remove the files."""
        self.plugged = False
        self._files.remove(FOLDER)

    async def run(self) -> None:
        """Convert until cancelled."""
        while True:
            if self.plugged:
                self.convert()
            await self._clock.sleep(0.05)  # seconds between two conversions

    def convert(self) -> None:
        """Publish one conversion atomically."""
        now = self._clock.now()
        text = self._forced
        if now < self._bounce_until:
            text = "0"
        if text == "frozen":
            return
        if text is None:
            counts = self._source(now) * 1000 + self.faults["noise"] * float(self._rng.standard_normal())
            text = str(int(np.clip(self.signals.report(COUNTS, round(counts)), 0, self.FULL_SCALE)))
        self._files.put(f"{FOLDER}/{self._stem}_raw", text)

    def _force(self, text: str, on: bool) -> None:
        self._forced = text if on else None

    def _fix(self, volts: str) -> None:
        level = float(volts)
        self._source = lambda _: level

    def _bounce(self, seconds: str = "0.05") -> None:
        self._bounce_until = self._clock.now() + round(float(seconds) * SECOND)


def emulated(setup: EmulatorSetup) -> IioEmulator:
    """Create the converter that measures a simulated truck's battery."""
    config: IioConfig = setup.settings or IioConfig()
    device = config.device or "mcp3208"
    return IioEmulator(
        setup.root, setup.clock, setup.physics.battery_volts, seed=setup.seed, channel=config.channel, device=device
    )
