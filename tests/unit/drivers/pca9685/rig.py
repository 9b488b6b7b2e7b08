"""Bench for the PCA9685: emulated bus and chip, driver, what was commanded and what came out."""

from typing import Any

from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig, Pca9685Servo
from monstertruck_drivers.pca9685.driver import Pca9685Driver
from monstertruck_drivers.pca9685.emulator import Pca9685Emulator, Pca9685EscEmulator
from monstertruck_drivers.pca9685.esc_driver import Pca9685EscDriver
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import SteeringFeedback
from tests.unit.drivers.kit import DriverRig, Kept, background

NAMES = ("", "_2", "_3", "_4")
CONFIG = Pca9685Config(rear=Pca9685Servo(channel=4))
ESC = Pca9685EscConfig()


class Rig(DriverRig):
    """Commands come 50 times a second while ``talking``."""

    def __init__(self, clock: VirtualClock, config: Pca9685Config | Pca9685EscConfig) -> None:
        super().__init__(clock, None)
        self.rotor = FreeMotor()
        self.steering_commands: Mailbox[SteeringCommand] = Mailbox(latest(), lambda _: None)
        self.drive_commands: Mailbox[DriveCommand] = Mailbox(latest(), lambda _: None)
        self.steering: Kept[SteeringFeedback] = Kept()
        self.drive: Kept[Any] = Kept()
        self.front = self.rear = self.rate = 0.0
        self.action = DriveAction.DISABLE
        self.talking = True
        if isinstance(config, Pca9685EscConfig):
            self.emulator: Pca9685Emulator = Pca9685EscEmulator(clock, self.rotor, None, config)
            self.ends: dict[str, Any] = {f"commands{n}": self.drive_commands for n in NAMES}
            self.ends |= {f"out{n}": Kept() if n else self.drive for n in NAMES}
            self.ends |= {"steering_commands": self.steering_commands, "drive": None, "steering": self.steering}
            self.driver = Pca9685EscDriver(config, self.port, clock, **self.ends, battery=None, events=self.events)
        else:
            self.emulator = Pca9685Emulator(clock, address=config.address, oscillator=config.oscillator)
            self.driver = Pca9685Driver(
                config, self.port, clock, self.steering_commands, self.steering, None, self.events
            )

    async def command(self) -> None:
        while True:
            if self.talking:
                now = self.clock.now()
                head = {"stamp": now, "received": now, "seq": 0}
                self.drive_commands.put(DriveCommand(**head, action=self.action, speed=0.0, motor_velocity=self.rate))
                servos = {"front_servo": self.front, "rear_servo": self.rear}
                self.steering_commands.put(SteeringCommand(**head, front=0.0, rear=0.0, **servos))
            await self.clock.sleep(0.02)

    def pulse(self, channel: int) -> float | None:
        return self.emulator.pulse_us(channel, self.clock.now())

    def turning(self) -> float:
        """Rate of the motor, rad/s."""
        return self.rotor.reading(self.clock.now()).rpm * 0.10471975511965977


def on_bench(test, config: Pca9685Config | Pca9685EscConfig = CONFIG) -> None:
    """Run ``test(rig)`` on the virtual clock with the chip plugged in and commands coming."""

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)), background(rig.command()):
            await test(rig)

    run_virtual(main, start=SECOND)
