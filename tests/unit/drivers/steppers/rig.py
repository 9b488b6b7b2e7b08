"""Bench for the stepper controller: emulator, port, driver, commands of four shafts and what came out."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.driver import StepperDriver
from monstertruck_drivers.steppers.emulator import StepperEmulator
from monstertruck_drivers.steppers.protocol import STEPPERS_BAUD
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveFeedback
from tests.unit.drivers.kit import DriverRig, Kept, background


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: StepperConfig, **emulator: Any) -> None:
        super().__init__(clock, port)
        self.port.device.baud = STEPPERS_BAUD
        self.rotors = [FreeMotor() for _ in range(4)]
        self.emulator = StepperEmulator(clock, self.rotors, **emulator)
        self.commands: list[Mailbox[DriveCommand]] = [Mailbox(latest(), lambda _: None) for _ in range(4)]
        self.outs: list[Kept[DriveFeedback]] = [Kept() for _ in range(4)]
        names = ("", "_2", "_3", "_4")
        ends: dict[str, Any] = {f"commands{n}": box for n, box in zip(names, self.commands, strict=True)}
        ends |= {f"out{n}": out for n, out in zip(names, self.outs, strict=True)}
        self.driver = StepperDriver(config, self.port, clock, events=self.events, **ends)
        self.action, self.rates = DriveAction.DISABLE, (0.0, 0.0, 0.0, 0.0)
        self.commanding = True

    def run_at(self, *rates: float) -> None:
        self.action, self.rates = DriveAction.RUN, rates  # type: ignore[assignment]

    async def command(self) -> None:
        """The gate's ticks."""
        while True:
            if self.commanding:
                now = self.clock.now()
                for box, rate in zip(self.commands, self.rates, strict=True):
                    box.put(
                        DriveCommand(stamp=now, received=now, seq=0, action=self.action, speed=0.0, motor_velocity=rate)
                    )
            await self.clock.sleep(0.02)

    def rotor(self, i: int) -> float:
        """Speed of a rotor, rpm."""
        return self.rotors[i].reading(self.clock.now()).rpm


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: StepperConfig | None = None, *, port: EmulatedPort | None = None, **emulator: Any
) -> AsyncIterator[Rig]:
    """Emulator plugged in and commands coming; the driver is started by the test."""
    rig = Rig(clock, port, config or StepperConfig(), **emulator)
    async with rig.plugged_in(rig.emulator.run(rig.port.device)), background(rig.command()):
        yield rig
