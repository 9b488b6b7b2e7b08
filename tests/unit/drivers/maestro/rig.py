"""Bench for the servo controller: emulator, port, driver, what was commanded and what came out."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_runtime.clock import Clock, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback
from tests.unit.drivers.kit import DriverRig, Kept


class Gate:
    """Sends steering commands at 50 Hz while ``talking``."""

    def __init__(self, clock: Clock, commands: Mailbox[SteeringCommand]) -> None:
        self.front = 0.0
        self.rear = 0.0
        self.right: tuple[float, float] | None = None
        """Servos of the right wheels, where every wheel has its own."""
        self.talking = True
        self.deadman = True
        self._clock = clock
        self._commands = commands

    async def run(self) -> None:
        seq = 0
        while True:
            if self.talking:
                now = self._clock.now()
                command = SteeringCommand(
                    stamp=now,
                    received=now,
                    seq=seq,
                    front=0.0,
                    rear=0.0,
                    front_servo=self.front,
                    rear_servo=self.rear,
                    front_right_servo=None if self.right is None else self.right[0],
                    rear_right_servo=None if self.right is None else self.right[1],
                    deadman=self.deadman,
                )
                self._commands.put(command)
                seq += 1
            await self._clock.sleep(0.02)


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: MaestroConfig, **emulator: Any) -> None:
        super().__init__(clock, port)
        self.outputs: list[tuple[int, bool, int]] = []
        self.emulator = MaestroEmulator(clock, usb=self.port, on_output=self._changed, **emulator)
        self.commands: Mailbox[SteeringCommand] = Mailbox(latest())
        self.gate = Gate(clock, self.commands)
        self.out: Kept[SteeringFeedback] = Kept()
        self.battery: Kept[Battery] = Kept()
        self.drive: Mailbox[DriveFeedback] = Mailbox(latest())
        self.driver = MaestroDriver(
            config, self.port, clock, self.commands, self.out, self.battery, self.events, drive=self.drive
        )

    def _changed(self, channel: int, high: bool) -> None:
        self.outputs.append((channel, high, self.clock.now()))

    def pulse(self, channel: int) -> float | None:
        return self.emulator.pulse_us(channel, self.clock.now())


@contextlib.asynccontextmanager
async def bench(
    clock: Clock,
    config: MaestroConfig | None = None,
    *,
    port: EmulatedPort | None = None,
    gate: bool = True,
    **emulator: Any,
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running, gate talking; the driver is started by the test."""
    rig = Rig(clock, port, config or MaestroConfig(), **emulator)
    rig.gate.talking = gate
    async with rig.plugged_in(rig.emulator.run(rig.port.device), rig.gate.run()):
        yield rig


def on_bench(test, config: MaestroConfig | None = None, **options):
    """Run ``test(rig)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config, **options) as rig:
            await test(rig)

    run_virtual(main)
