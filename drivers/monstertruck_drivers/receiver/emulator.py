"""Emulated receivers, byte for byte, with their transmitter and operator.

Real receivers stream without a request. Without its transmitter, a CRSF receiver sends no channels and reports a link
quality of 0; an SBUS receiver repeats its latest channels and reports lost packets for a while, and then the loss of
its transmitter.
"""

from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.receiver import crsf, sbus
from monstertruck_drivers.receiver.config import CrsfConfig, ReceiverConfig, SbusConfig
from monstertruck_drivers.receiver.protocol import CENTRE, CRSF_BAUD, LOW, RADIO_CHANNELS, SBUS_BAUD, SBUS_PERIOD, raw
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

FAILSAFE_AFTER: Final = SECOND
"""Time after which an SBUS receiver reports the loss of its transmitter (ns)."""


class ReceiverEmulator(FaultyDevice):
    """A receiver and its transmitter, initially with centred sticks and all switches off.

    Faults (``inject``): ``move CHANNEL POSITION`` (by the operator), ``transmitter on|off``, ``quality SHARE``,
    ``silent on|off``, ``damage N`` (the next N frames have a wrong byte).

    Args:
        clock: time.
        settings: selects the protocol.
        seed: seed for the packet loss.
    """

    def __init__(self, clock: Clock, settings: ReceiverConfig | None = None, *, seed: int = 0) -> None:
        self.name = "receiver"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self._clock = clock
        self._crsf = isinstance(settings or CrsfConfig(), CrsfConfig)
        self._rng = np.random.default_rng(seed)
        names = [f"channel_{i}" for i in range(1, RADIO_CHANNELS + 1)]
        self.signals = Signals(clock.now, dict.fromkeys([*names, "quality"], SignalKind.NUMBER), self._rng)
        self._positions = [CENTRE] * 4 + [LOW] * (RADIO_CHANNELS - 4)
        self.faults = FaultTable(
            self.name,
            {
                "move CHANNEL POSITION": lambda channel, position: self.move(int(channel), float(position)),
                "transmitter on|off": self._set_transmitter,
                "quality SHARE": 1.0,
                "silent on|off": False,
                "damage N": 0,
            },
        )
        self._transmitter = True
        self._lost_at = 0
        self._packets = 0
        self._sent = tuple(self._positions)

    def move(self, channel: int, position: float) -> None:
        """Move a stick or switch to a position from -1 to 1."""
        self._positions[channel - 1] = raw(position)

    def power_cycle(self) -> None:
        """Switch the supply off and on: the receiver finds its transmitter again if the transmitter is on."""

    def _set_transmitter(self, on: bool) -> None:
        self._transmitter, self._lost_at = on, self._clock.now()

    async def run(self, end: DeviceEnd) -> None:
        """Stream frames until cancelled."""
        end.baud = CRSF_BAUD if self._crsf else SBUS_BAUD
        crsf_period = SECOND // 100  # between two packets of a transmitter at 100 Hz, ns
        period = crsf_period if self._crsf else round(SBUS_PERIOD * SECOND)
        due = self._clock.now()
        while True:
            due += period
            await self._clock.sleep_until(due)
            for data in self._frames():
                if self.faults["silent"]:
                    continue
                end.write(self._damaged(data))

    def _damaged(self, data: bytes) -> bytes:
        if not self.faults.strikes("damage"):
            return data
        return data[:4] + bytes((data[4] ^ 0x08,)) + data[5:-1] + bytes((data[-1] ^ 0x03,))

    def _frames(self) -> list[bytes]:
        self._packets += 1
        arrives = self._transmitter and float(self._rng.random()) < self.faults["quality"]
        if arrives:
            shown = (self.signals.report(f"channel_{i}", value) for i, value in enumerate(self._positions, 1))
            self._sent = tuple(max(0, min(2047, value)) for value in shown)
        if not self._crsf:
            gone = not self._transmitter and self._clock.now() - self._lost_at >= FAILSAFE_AFTER
            return [sbus.frame(self._sent, lost=not arrives, failsafe=gone)]
        frames = [crsf.channels_frame(self._sent)] if arrives else []
        if self._packets % 20 == 0:  # packets for each frame of link statistics
            quality = self.faults["quality"] if self._transmitter else 0.0
            quality = max(0.0, min(1.0, self.signals.report("quality", quality)))
            signal = -60.0  # dBm
            frames.append(crsf.link_frame(quality, signal if self._transmitter else 0.0))
        return frames


def emulated(setup: EmulatorSetup) -> ReceiverEmulator:
    """Create a simulated robot's CRSF receiver."""
    return ReceiverEmulator(setup.clock, setup.settings, seed=setup.seed)


def emulated_sbus(setup: EmulatorSetup) -> ReceiverEmulator:
    """Create a simulated robot's SBUS receiver."""
    return ReceiverEmulator(setup.clock, setup.settings or SbusConfig(), seed=setup.seed)
