"""The VESC driver against the emulator, on the virtual clock."""

import asyncio
import math

import pytest
from pydantic import ValidationError

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.vesc.config import VescConfig, VescMotorConfig, VescServoConfig
from monstertruck_drivers.vesc.driver import payload_of, setpoint_of
from monstertruck_drivers.vesc.emulator import VescEmulator
from monstertruck_drivers.vesc.protocol import WatchdogSetting, set_brake
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceTimeoutError,
    InputError,
    WrongDeviceError,
)
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import BatteryLevel, DriveMode
from tests.unit.drivers.kit import background
from tests.unit.drivers.vesc.rig import Rig, bench

TWO = (VescMotorConfig(), VescMotorConfig(can_id=7, inverted=True))
RPM = 2 * math.pi / 60


def on_bench(test, config=None):
    async def main(clock):
        async with bench(clock, config) as rig:
            await test(rig)

    run_virtual(main, start=SECOND)


def test_it_turns_as_commanded_and_reports_it():
    async def test(rig):
        async with rig.driving():
            rig.run_at(3000.0)
            await rig.settle(1.0)
            assert rig.rotor() == pytest.approx(3000.0, rel=1e-3)
            before = rig.outs[0].last
            await rig.settle(1.0)
            after = rig.outs[0].last
            seconds = (after.stamp - before.stamp) / SECOND
            assert after.velocity == pytest.approx(3000 * RPM, rel=2e-3)
            assert (after.position - before.position) / seconds == pytest.approx(3000 * RPM, rel=2e-2)
            assert after.mode is DriveMode.ENABLED
            assert after.supply_voltage == pytest.approx(24.0)
            assert 0 <= after.received - after.stamp < 0.01 * SECOND
            assert 38 <= len([one for one in rig.outs[0].kept if one.stamp > after.stamp - SECOND]) <= 42

    on_bench(test)


def test_motors_behind_can_turn_with_their_own_sign():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            assert [round(rig.rotor(i)) for i in range(2)] == [2000, -2000]
            assert [out.last.velocity for out in rig.outs[:2]] == pytest.approx([2000 * RPM] * 2, rel=2e-3)
            assert rig.outs[1].last.position > 0
            assert not rig.outs[2].kept

    on_bench(test, VescConfig(motors=TWO))


def command(now, action=DriveAction.RUN, rpm=1000.0):
    return DriveCommand(stamp=now, received=now, seq=0, action=action, speed=0.0, motor_velocity=rpm * RPM)


def test_the_most_careful_command_and_the_oldest_count_for_all():
    config, now = VescConfig(motors=TWO), 10 * SECOND
    run = command(now)
    assert setpoint_of((run, run), now, config).rpm == pytest.approx((1000.0, 1000.0))
    assert setpoint_of((run, command(now, rpm=9e4)), now, config).rpm[1] == 6000
    for other, mode in (
        (None, DriveMode.DISABLED),
        (command(now, DriveAction.DISABLE), DriveMode.DISABLED),
        (command(now, DriveAction.QUICK_STOP), DriveMode.QUICK_STOP),
        (command(now - SECOND // 2), DriveMode.QUICK_STOP),
    ):
        assert setpoint_of((run, other), now, config).mode is mode


@pytest.mark.parametrize("rpm", [0.0, 449.0, -449.0])
def test_what_the_speed_controller_cannot_turn_brakes(rpm):
    config, now = VescConfig(min_motor_rpm=450.0), 10 * SECOND
    assert payload_of(setpoint_of((command(now, rpm=rpm),), now, config), 0, config) == set_brake(20.0)


def test_the_watchdog_is_set_at_the_start_and_not_again():
    async def test(rig):
        assert rig.emulator.controllers[1].watchdog == WatchdogSetting(1000, 0.0)
        async with rig.driving():
            await rig.settle(1.0)
        assert [c.watchdog for c in rig.emulator.controllers] == [WatchdogSetting(100, 20.0)] * 2
        rig.emulator.received.clear()
        async with rig.driving():
            await rig.settle(1.0)
        assert bytes((149,)) + bytes.fromhex("7d21b4f8") not in bytes(rig.emulator.received)

    on_bench(test, VescConfig(motors=TWO))


def test_a_dead_host_is_noticed_by_the_watchdog_and_the_motors_stand_within_300_ms():
    async def test(rig):
        async def die():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            assert all(rig.rotor(i) for i in range(2))
            rig.port.device.faults.deaf = True

        async with background(die()):
            began = rig.clock.now()
            with pytest.raises(DeviceTimeoutError):
                await rig.session()
            await rig.clock.sleep_until(began + round(1.3 * SECOND))
        assert [rig.rotor(i) for i in range(2)] == [0.0, 0.0]

    on_bench(test, VescConfig(motors=TWO))


def test_a_watchdog_as_delivered_lets_a_motor_run_on():
    """Why the driver sets it: without a brake current the motor coasts, and only after a second."""

    async def test(rig):
        rig.emulator.controllers[0].feed()
        rig.emulator.controllers[0].run(4000.0)
        await rig.settle(0.9)
        assert rig.rotor() == pytest.approx(2000.0)
        await rig.settle(0.2)
        assert rig.emulator.controllers[0].values().timed_out

    on_bench(test)


def test_a_firmware_without_temporary_settings_must_have_the_watchdog_set_by_the_user():
    async def test(rig):
        rig.emulator.inject("no_store", "on")
        with pytest.raises(DeviceMismatchError, match="stays at 1000 ms and 0 A; set Timeout 100 ms"):
            await rig.session()
        rig.emulator.controllers[0].watchdog = WatchdogSetting(100, 20.0)
        async with rig.driving():
            await rig.outs[0].count(1)

    on_bench(test)


def test_commands_that_stop_coming_brake():
    async def test(rig):
        async with rig.driving():
            rig.run_at(3000.0)
            await rig.settle(1.0)
            rig.commanding = False
            await rig.settle(0.25 + 0.06 + 3000 / 15_000)
            assert rig.rotor() == 0.0
            assert rig.outs[0].last.mode is DriveMode.QUICK_STOP

    on_bench(test)


def test_a_quick_stop_does_not_wait_for_the_next_cycle():
    async def test(rig):
        async with rig.driving():
            rig.run_at(3000.0)
            await rig.settle(1.0)
            rig.action = DriveAction.QUICK_STOP
            asked = rig.clock.now()
            while rig.rotor() >= 2999.0:
                await rig.settle(0.001)
            assert rig.clock.now() - asked < 0.035 * SECOND  # a command comes every 20 ms

    on_bench(test, VescConfig(rate=10.0, watchdog=0.3))


def test_a_host_that_comes_back_brakes_what_still_turns_and_the_end_of_a_session_stops():
    async def test(rig):
        rig.emulator.controllers[0].run(4000.0)
        rig.emulator.controllers[0].feed()
        await rig.settle(0.5)
        assert rig.rotor() == pytest.approx(2000.0)
        async with rig.driving():
            await rig.settle(0.25)
            assert rig.rotor() == 0.0
            rig.run_at(2000.0)
            await rig.settle(0.5)
            assert rig.rotor() > 0
        assert rig.rotor() == 0.0

    on_bench(test)


@pytest.mark.parametrize("words", ["ignore", "creep 800"])
def test_a_controller_that_disobeys_is_braked_again_and_again_and_loses_its_current_in_the_end(words):
    async def test(rig):
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            rig.emulator.inject("runaway", *words.split())
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.5)
            assert rig.rotor() > 0
            rig.emulator.received.clear()
            await rig.settle(0.5)
            assert bytes(rig.emulator.received).count(set_brake(20.0)) >= 18
            rig.action = DriveAction.DISABLE
            await rig.settle(0.5)
            assert rig.rotor() == 0.0, "no current"

    on_bench(test)


def test_the_servo_output_steers_the_front_axle():
    servo = VescServoConfig(centre=0.53, per_radian=1.2135, direction=-1)

    async def test(rig):
        async with rig.driving():
            rig.front = 0.2
            await rig.settle(0.5)
            assert rig.emulator.position == pytest.approx(0.53 - 0.2 * 1.2135, abs=1e-3)
            assert rig.servos.pulses.pulse_us(0, 0) == pytest.approx(1000 + 1000 * rig.emulator.position)
            assert rig.servos.pulses.pulse_us(1, 0) is None
            assert rig.steering.last.front == pytest.approx(0.2, abs=1e-3)
            assert rig.steering.last.rear == 0.0
            rig.front = 2.0
            await rig.settle(0.5)
            assert rig.emulator.position == 0.15
            assert rig.steering.last.front == pytest.approx(servo.reach[1], abs=1e-3)
            rig.commanding = False
            await rig.settle(1.0)
            assert rig.emulator.position == 0.15, "the servo holds"
            assert rig.emulator.controllers[0].values().erpm == 0

    on_bench(test, VescConfig(servo=servo))


def test_nothing_is_steered_before_the_first_command_and_without_a_servo():
    async def test(rig):
        rig.commanding = rig.config.servo is None
        async with rig.driving():
            await rig.outs[0].total(1)
            await rig.settle(0.5)
            assert rig.emulator.position is None
            assert not rig.steering.kept

    on_bench(test)
    on_bench(test, VescConfig(servo=VescServoConfig()))


def test_the_battery_is_its_supply():
    async def test(rig):
        async with rig.driving():
            await rig.settle(2.0)
            assert rig.battery.last.voltage == pytest.approx(24.0, abs=0.1)
            assert rig.battery.last.level is BatteryLevel.NORMAL
            assert 18 <= len(rig.battery.kept) <= 22

    on_bench(test, VescConfig(battery=PackConfig()))


def test_a_fault_is_reported_once_and_its_end_as_well():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(0.5)
            rig.emulator.inject("fault", "4")
            await rig.settle(0.3)
            assert rig.outs[0].last.mode is DriveMode.FAULT
            assert rig.outs[0].last.fault_code == 4
            rig.emulator.inject("fault", "0")
            await rig.settle(0.3)
            assert rig.outs[0].last.mode is DriveMode.ENABLED
        texts = [text for reason, _, text, _ in rig.events.kept if reason is Reason.DRIVE_FAULT]
        assert texts == ["motor 1: fault 4 (over current)"]

    on_bench(test)


def test_a_restart_is_noticed_and_the_position_does_not_jump():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(1.0)
        position = rig.outs[0].last.position
        rig.emulator.inject("reset")
        await rig.settle(1.0)
        assert rig.emulator.controllers[0].watchdog.milliseconds == 1000
        rig.run_at(0.0)
        async with rig.driving():
            await rig.outs[0].count(2)
            assert rig.outs[0].last.position == pytest.approx(position, abs=5.0)
            assert rig.emulator.controllers[0].watchdog.milliseconds == 100

    on_bench(test)


def test_a_restart_in_the_middle_ends_the_session():
    async def test(rig):
        async def restart():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            rig.emulator.inject("reset")
            rig.emulator._awake_at = 0

        async with background(restart()):
            with pytest.raises(DeviceRestartedError, match="motor 1 restarted"):
                await rig.session()
        assert rig.rotor() == 0.0

    on_bench(test)


@pytest.mark.parametrize(
    ("trouble", "error"),
    [
        (lambda rig: rig.emulator.inject("silent", "on"), DeviceTimeoutError),
        (lambda rig: rig.emulator.inject("reset"), DeviceTimeoutError),
        (lambda rig: rig.port.unplug(), DeviceLostError),
        (lambda rig: rig.emulator.inject("noise", "99"), DeviceTimeoutError),
    ],
    ids=["silent", "restart", "unplugged", "noise"],
)
def test_trouble_ends_the_session_and_the_next_one_goes_on(trouble, error):
    async def test(rig):
        async def happen():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            trouble(rig)

        async with background(happen()):
            with pytest.raises(error):
                await rig.session()
        await rig.settle(0.3)
        assert rig.rotor() == 0.0
        rig.emulator.inject("silent", "off")
        rig.emulator.inject("noise", "0")
        rig.port.plug()
        await rig.settle(0.5)
        async with rig.driving():
            await rig.settle(1.0)
            assert rig.rotor() == pytest.approx(2000.0)

    on_bench(test)


def test_a_few_damaged_and_late_answers_do_no_harm():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            for fault in ("noise 2", "late 0.04 2", "late 0.07 1"):
                rig.emulator.inject(*fault.split())
                await rig.settle(0.5)
                assert rig.outs[0].last.velocity == pytest.approx(2000 * RPM, rel=2e-3)
                assert rig.clock.now() - rig.outs[0].last.stamp < 0.05 * SECOND

    on_bench(test)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_a_line_that_loses_bytes_costs_exchanges_and_never_the_watchdog(share):
    async def test(rig):
        rig.port.device.faults.lose_rate = share

        async def drive():
            while True:
                try:
                    await rig.session()
                except (DeviceTimeoutError, WrongDeviceError, DeviceMismatchError):
                    await rig.settle(0.05)

        async with background(drive()):
            rig.run_at(2000.0)
            await rig.settle(5.0)
            rig.port.device.faults.lose_rate = 0.0
            await rig.settle(2.0)
            assert rig.rotor() == pytest.approx(2000.0)
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.3)
            assert rig.rotor() == 0.0

    on_bench(test)


def test_one_byte_at_a_time():
    async def test(rig):
        rig.port.device.faults.chunk = 1
        async with rig.driving():
            rig.run_at(2000.0)
            await rig.settle(1.0)
            assert rig.rotor() == pytest.approx(2000.0)

    on_bench(test)


def test_a_stranger_a_missing_can_id_and_an_old_firmware_are_refused():
    async def test(rig):
        del rig.emulator._by_id[7]
        with pytest.raises(DeviceMismatchError, match="no VESC answers at CAN id 7"):
            await rig.session()

    on_bench(test, VescConfig(motors=TWO))

    async def old(rig):
        rig.emulator.inject("firmware", "3", "62")
        with pytest.raises(DeviceMismatchError, match=r"firmware 3\.62: expected 5 or newer"):
            await rig.session()

    on_bench(old)

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, None, VescConfig())

        async def parrot():
            while True:
                await rig.port.device.read()
                rig.port.device.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")

        async with rig.plugged_in(parrot()):
            with pytest.raises(WrongDeviceError, match="not a VESC, it sends"):
                await rig.session()

    run_virtual(main)


def test_half_a_packet_of_a_dead_host_does_no_harm():
    async def test(rig):
        async with await rig.port.open() as link:
            link.write(b"\x02\x05\x08\x00")
            await asyncio.sleep(0.01)
        found = await DEVICES["vesc"].identify(rig.port, rig.clock, rig.config)
        assert found["motors"][0]["firmware"] == "6.05"
        assert [motor["can_id"] for motor in found["motors"]] == [100, 7]

    on_bench(test, VescConfig(motors=TWO))


def test_unknown_faults_and_impossible_settings_are_refused():
    emulator = VescEmulator(WallClock())
    for words in ("fault x", "runaway", "late", "fault 3 9"):
        with pytest.raises(InputError, match="known: silent"):
            emulator.inject(*words.split())
    for settings in (
        {"motors": (VescMotorConfig(), VescMotorConfig())},
        {"motors": ()},
        {"watchdog": 0.05},
        {"min_motor_rpm": 6000.0},
        {"servo": VescServoConfig.model_construct(centre=0.9)},
    ):
        with pytest.raises(ValidationError):
            VescConfig(**settings)
    with pytest.raises(ValidationError, match="expected min"):
        VescServoConfig(centre=0.9)
