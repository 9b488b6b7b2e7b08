"""Lines of ROSArduinoBridge, its driver and its emulator, on the virtual clock."""

import contextlib
import math

import pytest
from pydantic import ValidationError

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.driver import ArduinoBridgeDriver, setpoint_of
from monstertruck_drivers.arduino_bridge.emulator import ArduinoBridgeEmulator
from monstertruck_drivers.arduino_bridge.protocol import BOARD_BAUD, pwm, speeds
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceRestartedError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode
from tests.unit.drivers.kit import DriverRig, Kept, background

QUICK = ArduinoBridgeConfig(auto_stop=0.2)
RPM = 60 / math.tau


class Rig(DriverRig):
    def __init__(self, clock, config):
        super().__init__(clock, None)
        self.port.device.baud = BOARD_BAUD
        self.rotors = [FreeMotor() for _ in range(2)]
        self.emulator = ArduinoBridgeEmulator(clock, tuple(self.rotors), config)
        self.commands = [Mailbox(latest(), lambda _: None) for _ in range(4)]
        self.outs: list[Kept[DriveFeedback]] = [Kept() for _ in range(4)]
        names = ("", "_2", "_3", "_4")
        ends = {f"commands{n}": box for n, box in zip(names, self.commands, strict=True)}
        ends |= {f"out{n}": out for n, out in zip(names, self.outs, strict=True)}
        self.driver = ArduinoBridgeDriver(config, self.port, clock, events=self.events, **ends)
        self.action, self.rates, self.commanding = DriveAction.DISABLE, (0.0, 0.0), True

    def run_at(self, left, right):
        self.action, self.rates = DriveAction.RUN, (left, right)

    async def command(self):
        while True:
            if self.commanding:
                for box, rate in zip(self.commands, self.rates, strict=False):
                    box.put(command(self.clock.now(), self.action, rate))
            await self.clock.sleep(0.02)

    def rates_now(self):
        """Of both rotors, rad/s."""
        return [rotor.reading(self.clock.now()).rpm / RPM for rotor in self.rotors]


def command(now, action=DriveAction.RUN, rate=1.0):
    return DriveCommand(stamp=now, received=now, seq=0, action=action, speed=0.0, motor_velocity=rate)


def on_bench(test, config=QUICK):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)), background(rig.command()):
            await test(rig)

    run_virtual(main, start=SECOND)


async def asked(rig, *commands):
    await rig.settle(2.0)
    async with await rig.port.open() as link:
        link.write(b"".join(commands))
        answer = b""
        with contextlib.suppress(TimeoutError):
            while True:
                answer += await link.read(0.2)
        return answer


def test_the_board_answers_every_command_by_a_line():
    async def test(rig):
        answer = await asked(rig, b"e\r", b"b\r", b"m 5 5\r", b"u 20:12:0:50\r", b"r\r", b"z\r", b"m 5x -\r")
        assert answer == b"0 0\r\n57600\r\nOK\r\nOK\r\nOK\r\nInvalid Command\r\nOK\r\n"

    on_bench(test)


def test_both_wheels_turn_at_their_rates_and_count():
    async def test(rig):
        async with rig.driving():
            await rig.outs[0].total(1)
            rig.run_at(2.0, -1.0)
            await rig.settle(2.0)
            step = QUICK.pid_rate * QUICK.turn
            assert rig.rates_now() == pytest.approx([2.0, -1.0], abs=step / 2)
            first = [out.last for out in rig.outs[:2]]
            await rig.settle(1.0)
            for before, out, rate in zip(first, rig.outs, rig.rates_now(), strict=False):
                seconds = (out.last.stamp - before.stamp) / SECOND
                assert (out.last.position - before.position) / seconds == pytest.approx(rate, abs=0.02)
                assert out.last.velocity == pytest.approx(rate, abs=0.1)
                assert out.last.mode is DriveMode.ENABLED
            assert not rig.outs[2].kept

    on_bench(test)


def test_an_inverted_motor_counts_forward():
    async def test(rig):
        async with rig.driving():
            await rig.outs[0].total(1)
            rig.run_at(2.0, 2.0)
            await rig.settle(2.0)
            assert rig.rates_now()[1] < -1.9
            assert rig.outs[1].last.position > 0

    on_bench(test, ArduinoBridgeConfig(auto_stop=0.2, inverted=(False, True)))


def test_the_most_careful_command_and_the_oldest_count_for_both():
    now, run = 10 * SECOND, command(10 * SECOND)
    assert setpoint_of((run, run), now, QUICK).command == speeds(8, 8)  # 7.6 counts of 1/30 s
    assert setpoint_of((run, command(now, rate=99.0)), now, QUICK).command == speeds(8, 76)
    for other, mode, sent in (
        (None, DriveMode.DISABLED, pwm(0, 0)),
        (command(now, DriveAction.DISABLE), DriveMode.DISABLED, pwm(0, 0)),
        (command(now, DriveAction.QUICK_STOP), DriveMode.QUICK_STOP, speeds(0, 0)),
        (command(now - SECOND // 2), DriveMode.QUICK_STOP, speeds(0, 0)),
    ):
        assert setpoint_of((run, other), now, QUICK) == (mode, sent)


def test_a_dead_host_is_noticed_by_the_auto_stop_within_300_ms():
    async def test(rig):
        async def die():
            await rig.outs[0].total(1)
            rig.run_at(1.0, 1.0)
            await rig.settle(1.0)
            assert min(rig.rates_now()) > 0.9
            rig.port.device.faults.deaf = True
            await rig.settle(0.3)
            assert rig.rates_now() == [0.0, 0.0]

        async with background(die()) as dying:
            with pytest.raises(DeviceTimeoutError):
                await rig.session()
            await dying

    on_bench(test)


def test_a_board_as_published_drives_on_for_two_seconds():
    async def test(rig):
        await asked(rig, b"m 8 8\r")
        await rig.settle(1.5)
        assert min(rig.rates_now()) > 0.9
        await rig.settle(0.7)
        assert rig.rates_now() == [0.0, 0.0]

    on_bench(test, ArduinoBridgeConfig())


def test_a_quick_stop_does_not_wait_for_the_next_cycle_and_stale_commands_stop():
    async def test(rig):
        async with rig.driving():
            await rig.outs[0].total(1)
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            rig.action = DriveAction.QUICK_STOP
            sent = rig.clock.now()
            while rig.rates_now()[0] > 1.9:
                await rig.settle(0.001)
            assert rig.clock.now() - sent < 0.035 * SECOND
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            rig.commanding = False
            await rig.settle(0.5)
            assert rig.rates_now() == [0.0, 0.0]

    on_bench(test)


def test_the_end_of_a_session_stops_and_a_board_that_restarts_is_waited_for():
    async def test(rig):
        began = rig.clock.now()
        async with rig.driving():
            await rig.outs[0].total(1)
            assert 1.4 < (rig.clock.now() - began) / SECOND < 2.1
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            assert min(rig.rates_now()) > 1.9
        await rig.settle(0.2)
        assert rig.rates_now() == [0.0, 0.0]

    on_bench(test)


def test_a_restart_in_use_ends_the_session_and_positions_go_on():
    async def test(rig):
        async def restart():
            await rig.outs[0].total(1)
            rig.run_at(3.0, 3.0)
            await rig.settle(3.0)
            rig.emulator._restart()

        async with background(restart()):
            with pytest.raises(DeviceRestartedError, match="counters jumped"):
                await rig.session()
        assert rig.events.reasons()[-1] is Reason.DEVICE_RESTARTED
        position = rig.outs[0].last.position
        rig.run_at(0.0, 0.0)
        async with rig.driving():
            await rig.outs[0].count(2)
            assert rig.outs[0].last.position == pytest.approx(position, abs=0.5)

    on_bench(test)


def test_a_few_damaged_and_late_answers_do_no_harm():
    async def test(rig):
        async with rig.driving():
            await rig.outs[0].total(1)
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            for fault in ("noise 1", "late 0.15 1", "noise 2"):
                rig.emulator.inject(*fault.split())
                await rig.settle(1.0)
                assert rig.outs[0].last.velocity == pytest.approx(2.0, abs=0.15)

    on_bench(test)


@pytest.mark.parametrize(
    ("trouble", "error"),
    [
        (lambda rig: rig.emulator.inject("silent", "on"), DeviceTimeoutError),
        (lambda rig: rig.emulator.inject("reset"), DeviceTimeoutError),
        (lambda rig: rig.emulator.inject("noise", "99"), ProtocolError),
        (lambda rig: rig.port.unplug(), DeviceLostError),
    ],
    ids=["silent", "restart", "noise", "unplugged"],
)
def test_trouble_ends_the_session_and_the_next_one_goes_on(trouble, error):
    async def test(rig):
        async def happen():
            await rig.outs[0].total(1)
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            trouble(rig)

        async with background(happen()):
            with pytest.raises(error):
                await rig.session()
        await rig.settle(0.4)
        assert rig.rates_now() == [0.0, 0.0]
        rig.emulator.inject("silent", "off")
        rig.emulator.inject("noise", "0")
        rig.port.plug()
        async with rig.driving():
            await rig.outs[0].count(2)
            await rig.settle(1.0)
            assert min(rig.rates_now()) > 1.9

    on_bench(test)


def test_one_byte_at_a_time_and_half_a_command_of_a_dead_host():
    async def test(rig):
        await asked(rig, b"m 1")
        rig.port.device.faults.chunk = 1
        async with rig.driving():
            await rig.outs[0].count(20)
        assert (await DEVICES["arduino_bridge"].identify(rig.port, rig.clock, QUICK))["counts"] == [0, 0]

    on_bench(test)


def test_a_motor_that_disobeys_loses_its_voltage_in_the_end():
    async def test(rig):
        async with rig.driving():
            await rig.outs[0].total(1)
            rig.run_at(2.0, 2.0)
            await rig.settle(1.0)
            rig.emulator.inject("runaway", "ignore")
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.5)
            assert min(rig.rates_now()) > 1.9
            rig.action = DriveAction.DISABLE
            await rig.settle(0.5)
            assert rig.rates_now() == [0.0, 0.0]

    on_bench(test)


def test_a_stranger_unknown_faults_and_impossible_settings_are_refused():
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, QUICK)

        async def parrot():
            while True:
                rig.port.device.write(b"$" + await rig.port.device.read() + b"\n")

        async with rig.plugged_in(parrot()):
            with pytest.raises(WrongDeviceError, match="not an answer of ROSArduinoBridge"):
                await rig.session()
        with pytest.raises(InputError, match="known: silent"):
            rig.emulator.inject("late")

    run_virtual(main)
    with pytest.raises(ValidationError, match="more than two exchanges"):
        ArduinoBridgeConfig(auto_stop=0.1)
