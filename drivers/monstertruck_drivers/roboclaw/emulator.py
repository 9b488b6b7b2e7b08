"""Emulated RoboClaw with two encoders, byte for byte.

Like the real unit, it only answers requests and ignores those to another address. It drops an incomplete request after
10 ms and counts from 0 after every power-up. An unwired encoder counts nothing and causes no error.
"""

from functools import partial
from math import floor, tau
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ReceivedBytes, WheelSource
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.roboclaw.config import RoboclawConfig
from monstertruck_drivers.roboclaw.protocol import PACKET_GAP, RoboclawCommand, counted, signed
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock

VERSION: Final = b"USB RoboClaw 2x7a v4.3.6\n\x00"
THINKING: Final = MILLISECOND
"""Time from a request to its answer (ns)."""


class RoboclawEmulator(FaultyDevice):
    """Unit whose encoders are wired according to the settings.

    Faults (``inject``): ``stuck left|right on|off`` (an encoder's disc slips on its shaft), ``mirrored left|right
    on|off`` (its channels are swapped: it counts backwards), ``silent on|off`` (no answers), ``noise COUNT`` (COUNT
    answers contain a wrong byte), ``reset`` (the supply drops: counters restart at 0).

    Args:
        clock: time.
        source: source of the wheel angles.
        settings: address, counts per turn and input assignment.
    """

    def __init__(self, clock: Clock, source: WheelSource, settings: RoboclawConfig | None = None) -> None:
        self.name = "roboclaw"
        self.received = ReceivedBytes()
        """Latest bytes from the host."""
        self.signals = Signals(clock.now, dict.fromkeys(("left", "right"), SignalKind.NUMBER), np.random.default_rng(0))
        self._clock = clock
        self._source = source
        self._settings = settings or RoboclawConfig()
        self._stuck = {"left": False, "right": False}
        self._mirrored = {"left": False, "right": False}
        self.faults = FaultTable(
            self.name,
            {
                "stuck left|right on|off": partial(self._set_wiring, self._stuck),
                "mirrored left|right on|off": partial(self._set_wiring, self._mirrored),
                "silent on|off": False,
                "noise COUNT": 0,
                "reset": self.power_cycle,
            },
        )
        self._angles: tuple[float, float] | None = None
        """Angles of the wheels at the last reading (rad)."""
        self._counted = [0.0, 0.0]
        """Counts of the left and right wheel since power-up."""

    def power_cycle(self) -> None:
        """Switch the supply off and on: the counters restart at 0."""
        self._look()
        self._counted = [0.0, 0.0]

    def _set_wiring(self, faulty: dict[str, bool], side: str, on: bool) -> None:
        self._look()
        if side not in faulty:
            raise LookupError(side)
        faulty[side] = on

    async def run(self, end: DeviceEnd) -> None:
        """Answer until cancelled."""
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        buffer, last = b"", 0
        while True:
            data = await end.read()
            now = self._clock.now()
            self.received.extend(data)
            buffer = data if now - last > PACKET_GAP * SECOND else buffer + data
            last = now
            while len(buffer) >= 2:
                asked, buffer = buffer[:2], buffer[2:]
                await self._clock.sleep_until(self._clock.now() + THINKING)
                self._answer(end, asked)

    def _answer(self, end: DeviceEnd, asked: bytes) -> None:
        address, command = asked
        if address != self._settings.address or self.faults["silent"]:
            return
        if command == RoboclawCommand.VERSION:
            data = VERSION
        elif command == RoboclawCommand.COUNTS:
            self._look()
            left, right = map(self.signals.report, ("left", "right"), map(floor, self._counted))
            data = counted(left, right) if self._settings.left == 1 else counted(right, left)
        else:
            return
        answer = signed(asked, data)
        if self.faults.strikes("noise"):
            answer = answer[:3] + bytes((answer[3] ^ 0x10,)) + answer[4:]
        end.write(answer)

    def _look(self) -> None:
        """Count the rotation of the wheels since the last call."""
        now = self._source.wheels(self._clock.now())
        before, self._angles = self._angles or now, now
        settings = self._settings
        inverted = settings.left_inverted, settings.right_inverted
        for i, side in enumerate(("left", "right")):
            if not self._stuck[side]:
                turned = (now[i] - before[i]) / tau * settings.counts_per_turn
                self._counted[i] += -turned if self._mirrored[side] != inverted[i] else turned


def emulated(setup: EmulatorSetup) -> RoboclawEmulator:
    """Create the encoders for a simulated robot's rear wheels."""
    return RoboclawEmulator(setup.clock, setup.physics.wheels, setup.settings)
