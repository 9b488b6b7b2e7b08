"""Emulated WT61, byte for byte."""

import asyncio
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ImuSource, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.wt61.protocol import RATE, TOGGLE_SLEEP, WT61_BAUD, Wt61Kind, Wt61Packet, build, measured
from monstertruck_runtime.clock import SECOND, Clock

REPORTED: Final = (
    *(f"{kind.name.lower()}_{axis}" for kind in (Wt61Kind.ACCELERATION, Wt61Kind.ANGULAR_VELOCITY) for axis in "xyz"),
    "temperature",
)
"""Numbers in its packets, as raw counts."""
SLEEP: Final = "toggle_sleep"


class Wt61Emulator(FaultyDevice):
    """WT61 that streams from power-up.

    Faults (`inject`): ``frozen on|off`` (repeats the same packets), ``silent on|off``, ``asleep on|off`` (in standby
    until it receives the standby command), ``bad_checksum N`` (the next N packets), ``inverted on|off`` (mounted upside
    down: yaw rate with the wrong sign), ``half_packet``.

    Args:
        clock: time.
        source: physics to measure.
        seed: seed for the converter noise.
    """

    def __init__(self, clock: Clock, source: ImuSource, *, seed: int = 0) -> None:
        self.name = "wt61"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        kinds = dict.fromkeys(REPORTED, SignalKind.NUMBER) | {SLEEP: SignalKind.SWITCH}
        self.signals = Signals(clock.now, kinds, self._rng)
        self.faults = FaultTable(
            self.name,
            {
                "frozen|silent|inverted|asleep on|off": False,
                "bad_checksum N": 0,
                "half_packet": 0,
            },
        )
        self._last = b""
        self._awake_at = 0

    async def run(self, end: DeviceEnd) -> None:
        """Stream packets and execute commands."""
        end.baud = WT61_BAUD
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self.power_cycle()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._stream(end))
            while True:
                self.received.extend(await end.read())
                if self.received.endswith(TOGGLE_SLEEP):
                    self.signals.order(SLEEP, None, self._toggle_sleep)

    def _toggle_sleep(self, _: None) -> None:
        self.faults["asleep"] = not self.faults["asleep"]

    def power_cycle(self) -> None:
        """Switch the supply off and on, which wakes the unit up."""
        self.faults["asleep"] = False
        self.faults["half_packet"] = 1
        self._awake_at = self._clock.now() + 300_000_000  # nanoseconds from power-up to the first packet

    async def _stream(self, end: DeviceEnd) -> None:
        due = self._clock.now()
        while True:
            due += SECOND // RATE
            await self._clock.sleep_until(due)
            if due < self._awake_at or self.faults["silent"] or self.faults["asleep"]:
                continue
            if not (self.faults["frozen"] and self._last):
                self._last = self._packets(due)
            data = self._last
            if self.faults.strikes("bad_checksum"):
                data = data[:15] + bytes((data[15] ^ 0x10,)) + data[16:]
            if self.faults.strikes("half_packet"):
                data = data[5:]
            end.write(data)

    def _packets(self, now: int) -> bytes:
        reading = self._source.imu(now)
        x, y, z = reading.angular_velocity
        if self.faults["inverted"]:
            z = -z
        force = measured(Wt61Kind.ACCELERATION, reading.acceleration, reading.temperature_c)
        rate = measured(Wt61Kind.ANGULAR_VELOCITY, (x, y, z), reading.temperature_c)
        angle = Wt61Packet(Wt61Kind.ANGLE, 0, 0, 0, 0)
        return b"".join(map(build, (self._noisy(force), self._noisy(rate), angle)))

    def _noisy(self, packet: Wt61Packet) -> Wt61Packet:
        # 2.0: standard deviation of the converters, in their own counts
        noise = np.rint(2.0 * self._rng.standard_normal(3)).astype(int).tolist()
        report, name = self.signals.report, packet.kind.name.lower()
        x, y, z = (
            _count(report(f"{name}_{axis}", value + error))
            for axis, value, error in zip("xyz", (packet.x, packet.y, packet.z), noise, strict=True)
        )
        return packet._replace(x=x, y=y, z=z, temperature=_count(report("temperature", packet.temperature)))


def _count(value: int) -> int:
    return max(-32768, min(32767, value))


def emulated(setup: EmulatorSetup) -> Wt61Emulator:
    """Create a simulated robot's IMU."""
    return Wt61Emulator(setup.clock, setup.physics.imu, seed=setup.seed)
