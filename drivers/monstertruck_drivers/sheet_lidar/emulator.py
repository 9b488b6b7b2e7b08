"""Emulated laser scanner described by its data sheet."""

import asyncio
import math
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import Array, BeamSource, EmulatorSetup, ReceivedBytes
from monstertruck_drivers.fault_table import FaultRows, FaultTable, FaultyDevice
from monstertruck_drivers.scanning.head import TurningHead
from monstertruck_drivers.sheet_lidar.config import SheetLidarConfig
from monstertruck_drivers.sheet_lidar.protocol import STAMP_TURN, SheetScan, build
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

RANGE: Final = "range"
"""Signal: distances of a scan (mm)."""
COUNTER: Final = "counter"
"""Signal: time stamp (ms)."""


class SheetLidarEmulator(FaultyDevice):
    """Scanner that streams from power-up.

    Faults (``inject``): ``silent on|off``, ``bad_crc N`` (the next N scans), and the head's faults.

    Args:
        clock: time.
        source: range source.
        config: data sheet.
        seed: seed for covers.
    """

    def __init__(
        self, clock: Clock, source: BeamSource, config: SheetLidarConfig | None = None, *, seed: int = 0
    ) -> None:
        self.name = "lidar"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests; the scanner ignores them."""
        self._config = config or SheetLidarConfig()
        rng = np.random.default_rng(seed)
        kinds = {RANGE: SignalKind.ARRAY, COUNTER: SignalKind.NUMBER}
        self.signals = Signals(clock.now, kinds, rng, codes={RANGE: 1})
        self.head = TurningHead(clock, source, self._config.sheet, self._config.rate, rng)
        steps = np.arange(self._config.beams, dtype=np.float64)
        self._bearings: Array = self._config.start_angle + self._config.increment * steps
        self._clock = clock
        rows: FaultRows = {"silent on|off": False, "bad_crc N": 0, **self.head.fault_rows()}
        self.faults = FaultTable(self.name, rows)
        self._powered_at = 0

    async def run(self, end: DeviceEnd) -> None:
        """Stream until cancelled."""
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self.power_cycle()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._stream(end))
            while True:
                self.received.extend(await end.read())

    def power_cycle(self) -> None:
        """Switch the supply off and on: the clock restarts at 0, and the head is stationary."""
        self.head.stop()
        self._powered_at = self.head.now()

    async def _stream(self, end: DeviceEnd) -> None:
        begin = float(self.head.now())
        while True:
            period = SECOND / max(self.head.frequency, 2.0)  # the world draws beams of half a second at most
            each = period * abs(self._config.increment) / math.tau
            times = (begin + each * np.arange(self._config.beams)).astype(np.int64)
            await self._clock.sleep_until(self.head.world_time(int(times[-1])))
            # Maximum lag after the host's machine slept (ns); older scans are lost.
            overslept = 5 * SECOND // 10
            late = self.head.now() - int(times[-1]) > overslept
            begin = float(self.head.now() if late else begin + period)
            self.head.turn(times)
            if self.faults["silent"] or times[0] < self._powered_at:
                continue
            data = build(self._scan(times))
            if self.faults.strikes("bad_crc"):
                data = data[:-1] + bytes((data[-1] ^ 0x10,))
            end.write(data)

    def _scan(self, times: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> SheetScan:
        ranges = self.head.look(-self._bearings / math.tau, times)
        millimetres = self.signals.report(RANGE, np.rint(ranges * 1000).astype(np.int64))
        stamp = self.signals.report(COUNTER, (int(times[0]) - self._powered_at) // 1_000_000 % STAMP_TURN)
        return SheetScan(int(stamp) % STAMP_TURN, np.clip(millimetres, 0, 0xFFFF).astype(np.uint16))


def emulated(setup: EmulatorSetup) -> SheetLidarEmulator:
    """Create a simulated robot's scanner."""
    return SheetLidarEmulator(setup.clock, setup.room, setup.settings, seed=setup.seed)
