"""Bench for VESCs: emulator, port, driver, commands of shafts and steering, and what came out."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.vesc.config import RAD_S_PER_RPM, VescConfig
from monstertruck_drivers.vesc.driver import VescDriver
from monstertruck_drivers.vesc.emulator import VescEmulator
from monstertruck_drivers.vesc.protocol import VESC_BAUD
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback
from tests.unit.drivers.kit import DriverRig, Kept, background


class Servos:
    """Steering servos that are only looked at."""

    def __init__(self) -> None:
        self.pulses: Any = None

    def attach(self, pulses: Any) -> None:
        self.pulses = pulses

    def advance(self, time_ns: int) -> None: ...

    def analog_volts(self, channel: int, time_ns: int) -> float:
        return 0.0


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: VescConfig) -> None:
        super().__init__(clock, port)
        self.port.device.baud = VESC_BAUD
        self.config = config
        self.rotors = [FreeMotor() for _ in config.motors]
        self.servos = Servos()
        self.emulator = VescEmulator(clock, tuple(self.rotors), self.servos, config)
        self.commands: list[Mailbox[DriveCommand]] = [Mailbox(latest(), lambda _: None) for _ in range(4)]
        self.steering_commands: Mailbox[SteeringCommand] = Mailbox(latest(), lambda _: None)
        self.outs: list[Kept[DriveFeedback]] = [Kept() for _ in range(4)]
        self.steering: Kept[SteeringFeedback] = Kept()
        self.battery: Kept[Battery] = Kept()
        names = ("", "_2", "_3", "_4")
        ends: dict[str, Any] = {f"commands{n}": box for n, box in zip(names, self.commands, strict=True)}
        ends |= {f"out{n}": out for n, out in zip(names, self.outs, strict=True)}
        ends |= {"steering": self.steering, "battery": self.battery, "steering_commands": self.steering_commands}
        ends |= {"drive": Mailbox(latest(), lambda _: None)}
        self.driver = VescDriver(config, self.port, clock, events=self.events, **ends)
        self.action, self.rpm, self.front = DriveAction.DISABLE, 0.0, 0.0
        self.commanding = True

    def run_at(self, rpm: float) -> None:
        """Run all motors at a speed, forward positive."""
        self.action, self.rpm = DriveAction.RUN, rpm

    async def command(self) -> None:
        """The gate's ticks."""
        while True:
            if self.commanding:
                now = self.clock.now()
                common = {"stamp": now, "received": now, "seq": 0}
                velocity = self.rpm * RAD_S_PER_RPM
                for box in self.commands:
                    box.put(DriveCommand(**common, action=self.action, speed=0.0, motor_velocity=velocity))
                self.steering_commands.put(
                    SteeringCommand(**common, front=0.0, rear=0.0, front_servo=self.front, rear_servo=0.0)
                )
            await self.clock.sleep(0.02)

    def rotor(self, i: int = 0) -> float:
        """Speed of a rotor, rpm."""
        return self.rotors[i].reading(self.clock.now()).rpm


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: VescConfig | None = None, *, port: EmulatedPort | None = None
) -> AsyncIterator[Rig]:
    """Emulator plugged in and commands coming; the driver is started by the test."""
    rig = Rig(clock, port, config or VescConfig())
    async with rig.plugged_in(rig.emulator.run(rig.port.device)), background(rig.command()):
        yield rig
