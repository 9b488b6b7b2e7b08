"""Emulated LD19, byte for byte: after power-up it is silent, then spins up, then streams packets."""

import asyncio
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import BeamSource, EmulatorSetup, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.ld19.config import Ld19Config
from monstertruck_drivers.ld19.protocol import (
    FULL_TURN,
    LD19_BAUD,
    MODELS,
    POINT,
    POINTS,
    STAMP_TURN,
    Ld19Packet,
    ModelSheet,
    build,
)
from monstertruck_drivers.scanning.head import TurningHead
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

RANGE: Final = "range"
"""Signal: distances of a packet (mm)."""
COUNTER: Final = "counter"
"""Signal: time stamp (ms)."""


class Ld19Emulator(FaultyDevice):
    """LD06, LD19 or STL-19P that streams from power-up.

    Faults (``inject``): ``silent on|off``, ``bad_crc N`` (the next N packets), ``half_packet``, and the head's faults.

    Args:
        clock: time.
        source: range source.
        sheet: the model's data sheet.
        seed: seed for covers.
    """

    def __init__(self, clock: Clock, source: BeamSource, sheet: ModelSheet = MODELS["ld19"], *, seed: int = 0) -> None:
        self.name = "lidar"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests; the unit ignores them."""
        rng = np.random.default_rng(seed)
        kinds = {RANGE: SignalKind.ARRAY, COUNTER: SignalKind.NUMBER}
        self.signals = Signals(clock.now, kinds, rng, codes={RANGE: 1})
        self.head = TurningHead(clock, source, sheet.ranges, sheet.frequency, rng)
        self._clock, self._period = clock, SECOND / sheet.rate
        self.faults = FaultTable(
            self.name,
            {
                "silent on|off": False,
                "bad_crc N": 0,
                "half_packet": 0,
                **self.head.fault_rows(),
            },
        )
        self._powered_at = 0

    async def run(self, end: DeviceEnd) -> None:
        """Stream until cancelled."""
        end.baud = LD19_BAUD
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self.power_cycle()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._stream(end))
            while True:
                self.received.extend(await end.read())

    def power_cycle(self) -> None:
        """Switch the supply off and on: the clock restarts at 0, and the head is stationary."""
        self.head.stop()
        self.faults["half_packet"] = 1
        self._powered_at = self.head.now()

    async def _stream(self, end: DeviceEnd) -> None:
        begin = float(self.head.now())
        while True:
            times = (begin + self._period * np.arange(1, POINTS + 1)).astype(np.int64)
            last = int(times[-1])
            await self._clock.sleep_until(self.head.world_time(last))
            # Maximum lag after the host's machine slept (ns); older packets are lost.
            overslept = 5 * SECOND // 10
            late = self.head.now() - last > overslept
            begin = float(self.head.now() if late else begin + self._period * POINTS)
            boot = 500_000_000  # nanoseconds from power-up to the first packet (maker's description of the start-up)
            if self.faults["silent"] or last - self._powered_at < boot:
                self.head.turn(times)
                continue
            data = build(self._packet(times))
            if self.faults.strikes("bad_crc"):
                data = data[:-1] + bytes((data[-1] ^ 0x10,))
            if self.faults.strikes("half_packet"):
                data = data[5:]
            end.write(data)

    def _packet(self, times: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> Ld19Packet:
        turned, ranges = self.head.measure(times)
        points = np.zeros(POINTS, POINT)
        millimetres = np.rint(ranges * 1000).astype(np.int64)
        points["distance"] = np.clip(self.signals.report(RANGE, millimetres), 0, 0xFFFF)
        bright = 230  # intensity of a near white surface; it falls with the distance
        fading = 6.0  # distance at which a quarter of the intensity remains (m)
        points["intensity"] = np.where(points["distance"] > 0, bright / (1.0 + 3.0 * (ranges / fading) ** 2), 0.0)
        angles = np.rint(turned[[0, -1]] * FULL_TURN).astype(np.int64) % FULL_TURN
        stamp = self.signals.report(COUNTER, (int(times[-1]) - self._powered_at) // 1_000_000 % STAMP_TURN)
        return Ld19Packet(
            round(self.head.speed * 360), int(angles[0]), points.tobytes(), int(angles[1]), int(stamp) % STAMP_TURN
        )


def emulated(setup: EmulatorSetup) -> Ld19Emulator:
    """Create a simulated robot's lidar."""
    settings = setup.settings if isinstance(setup.settings, Ld19Config) else Ld19Config()
    return Ld19Emulator(setup.clock, setup.room, MODELS[settings.model], seed=setup.seed)
