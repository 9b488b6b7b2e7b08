"""A radio-control speed controller on a Maestro that steers as well: driver against emulator, on the virtual clock."""

import math
from typing import Any

import pytest
from pydantic import ValidationError

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.esc import UnmeasuredMotor
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.esc_config import EscConfig, MaestroEscConfig
from monstertruck_drivers.maestro.esc_driver import MaestroEscDriver
from monstertruck_drivers.maestro.esc_emulator import MaestroEscEmulator
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import ConfigError, DeviceLostError, DeviceTimeoutError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.kit import DriverRig, Kept, background

CONFIG = MaestroEscConfig()
CHANNEL, FRONT = CONFIG.esc.channel, CONFIG.unit.front.channel
NAMES = ("", "_2", "_3", "_4")


class Rig(DriverRig):
    def __init__(self, clock, config=CONFIG):
        super().__init__(clock, None)
        self.rotor = FreeMotor()
        self.emulator = MaestroEscEmulator(clock, self.rotor, None, config)
        self.drive_commands: Mailbox[DriveCommand] = Mailbox(latest(), lambda _: None)
        self.steering_commands: Mailbox[SteeringCommand] = Mailbox(latest(), lambda _: None)
        self.out, self.steering, self.battery = Kept(), Kept(), Kept()
        self.ends: dict[str, Any] = {f"commands{n}": self.drive_commands for n in NAMES}
        self.ends |= {f"out{n}": self.out if not n else Kept() for n in NAMES}
        self.ends |= {"steering_commands": self.steering_commands, "drive": Mailbox(latest(), lambda _: None)}
        self.ends |= {"steering": self.steering, "battery": self.battery, "events": self.events}
        self.driver = MaestroEscDriver(config, self.port, clock, **self.ends)
        self.action, self.rate, self.front, self.commanding = DriveAction.DISABLE, 0.0, 0.0, True

    def run_at(self, rate):
        self.action, self.rate = DriveAction.RUN, rate

    async def command(self):
        while True:
            if self.commanding:
                now = self.clock.now()
                head = {"stamp": now, "received": now, "seq": 0}
                self.drive_commands.put(DriveCommand(**head, action=self.action, speed=0.0, motor_velocity=self.rate))
                self.steering_commands.put(
                    SteeringCommand(**head, front=0.0, rear=0.0, front_servo=self.front, rear_servo=0.0)
                )
            await self.clock.sleep(0.02)

    def turning(self):
        """Rate of the motor, rad/s."""
        return self.rotor.reading(self.clock.now()).rpm * math.tau / 60


def on_bench(test, config=CONFIG):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)), background(rig.command()):
            await test(rig)

    run_virtual(main, start=SECOND)


def test_pulses_of_rates():
    esc = EscConfig(neutral_us=1500, reach_us=400, direction=-1, max_rate=200.0)
    assert [esc.quarters(rate) / 4 for rate in (0.0, 100.0, -200.0, 999.0)] == [1500, 1300, 1900, 1100]
    assert [esc.rate(pulse) for pulse in (1500, 1300, 1900)] == [0.0, 100.0, -200.0]


def test_it_drives_and_steers_once_the_speed_controller_has_had_its_neutral_pulses():
    async def test(rig):
        rig.run_at(100.0)
        rig.front = 0.2
        async with rig.driving():
            await rig.settle(1.5)
            assert rig.turning() == 0.0
            assert not rig.out.kept, "a motor that does not turn yet is not blocked"
            assert rig.emulator.pulse_us(CHANNEL, rig.clock.now()) == 1500.0
            await rig.settle(2.5)
            assert rig.turning() == pytest.approx(100.0, rel=1e-2)
            assert rig.out.last.velocity == pytest.approx(100.0)
            assert rig.out.last.mode is DriveMode.ENABLED
            assert rig.out.last.position > 50.0
            assert rig.steering.last.front == pytest.approx(0.2, abs=0.01)
            assert rig.battery.kept
            rig.run_at(-50.0)
            await rig.settle(1.0)
            assert rig.turning() == pytest.approx(-50.0, rel=1e-2)
        await rig.settle(0.3)
        assert rig.turning() == 0.0, "the end of a session is neutral"

    on_bench(test)


def test_a_stop_is_one_tick_away_and_the_reported_rate_falls_no_faster_than_the_motor_does():
    async def test(rig):
        rig.run_at(200.0)
        async with rig.driving():
            await rig.settle(4.0)
            rig.action = DriveAction.QUICK_STOP
            asked = rig.clock.now()
            while rig.turning() > 199.0:
                await rig.settle(0.001)
            assert rig.clock.now() - asked < 0.06 * SECOND
            while rig.turning() > 0.0:
                assert rig.out.last.velocity >= 0.0
                await rig.settle(0.001)
            await rig.settle(0.2)
            assert rig.out.last.velocity == 0.0
            assert rig.out.last.mode is DriveMode.QUICK_STOP
            falling = [one for one in rig.out.kept if one.received > asked and one.velocity > 0.0]
            assert len(falling) >= 5, "as configured, 500 rad/s^2"

    on_bench(test)


def test_a_dead_host_is_noticed_by_the_units_serial_timeout():
    async def test(rig):
        async def die():
            rig.run_at(40.0)
            await rig.settle(4.0)
            assert rig.turning() > 39.0
            rig.port.device.faults.deaf = True
            await rig.settle(0.3)
            assert rig.turning() == 0.0

        async with background(die()) as dying:
            with pytest.raises(DeviceTimeoutError):
                await rig.session()
            await dying

    on_bench(test)


def test_commands_that_stop_coming_make_the_pulse_neutral():
    async def test(rig):
        rig.run_at(100.0)
        async with rig.driving():
            await rig.settle(4.0)
            rig.commanding = False
            await rig.settle(0.6)
            assert rig.turning() == 0.0

    on_bench(test)


def test_a_stale_command_to_run_is_a_stop_and_no_blocked_motor():
    async def main(clock: VirtualClock) -> None:
        commands, out = Mailbox[DriveCommand](latest(), lambda _: None), Kept()
        motor = UnmeasuredMotor(CONFIG.esc, clock, commands, out, command_timeout=0.2)
        head = {"stamp": clock.now(), "received": clock.now(), "seq": 0}
        commands.put(DriveCommand(**head, action=DriveAction.RUN, speed=0.0, motor_velocity=100.0))
        for mode, rate in ((DriveMode.ENABLED, 100.0), (DriveMode.QUICK_STOP, 0.0)):
            motor.publish(clock.now(), clock.now())
            assert (out.last.mode, CONFIG.esc.rate(motor.pulse_us())) == (mode, pytest.approx(rate))
            await clock.sleep(0.3)

    run_virtual(main, start=SECOND)


def test_unplugged_it_starts_again_with_neutral_pulses():
    async def test(rig):
        async def pull():
            rig.run_at(100.0)
            await rig.settle(4.0)
            rig.port.unplug()

        async with background(pull()):
            with pytest.raises(DeviceLostError):
                await rig.session()
        await rig.settle(1.0)
        assert rig.turning() == pytest.approx(0.0, abs=1.0), "without its supply there are no pulses"
        rig.port.plug()
        async with rig.driving():
            await rig.settle(1.0)
            assert rig.emulator.pulse_us(CHANNEL, rig.clock.now()) == 1500.0
            await rig.settle(3.0)
            assert rig.turning() == pytest.approx(100.0, rel=1e-2)

    on_bench(test)


def test_the_probe_finds_the_unit():
    async def test(rig):
        assert (await DEVICES["maestro_esc"].identify(rig.port, rig.clock, CONFIG))["device"] == DEVICES[
            "maestro_esc"
        ].doc

    on_bench(test)


def test_channels_have_one_use_and_another_device_may_not_steer():
    with pytest.raises(ValidationError, match="another function of the unit uses this channel"):
        MaestroEscConfig(esc=EscConfig(channel=FRONT))
    with pytest.raises(ValidationError, match="compact protocol without CRC"):
        MaestroEscConfig(unit=MaestroConfig(use_crc=True))

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)
        with pytest.raises(ConfigError, match="another device steers"):
            MaestroEscDriver(CONFIG, rig.port, clock, **{**rig.ends, "steering": None})

    run_virtual(main)
