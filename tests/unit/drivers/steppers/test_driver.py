"""The stepper driver against the emulator, on the virtual clock."""

import asyncio
import contextlib
import math

import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.driver import setpoint_of
from monstertruck_drivers.steppers.protocol import Line, MotorState, Splitter, Status
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceStoppedError,
    DeviceTimeoutError,
    InputError,
    WrongDeviceError,
)
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.kit import read_until
from tests.unit.drivers.steppers.rig import bench

STEP = math.tau / 400
RPM = 60 / math.tau


def on_bench(test, config=None, port=None, **emulator):
    async def main(clock):
        async with bench(clock, config, port=port, **emulator) as rig:
            await test(rig)

    run_virtual(main, start=SECOND)


def ended(error, match=None):
    return pytest.raises(error, match=match)


def test_every_shaft_turns_at_its_own_rate_and_reports_it():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.57, -0.785, 0.5, 0.0)
            await rig.settle(3.0)
            for out, rate in zip(rig.outs, rig.rates, strict=True):
                assert out.last.velocity == pytest.approx(rate, rel=2e-3)
                assert out.last.mode is DriveMode.ENABLED
                assert out.last.position / STEP == pytest.approx(round(out.last.position / STEP), abs=1e-6)
            assert rig.rotor(0) == pytest.approx(1.57 * RPM, rel=2e-3)
            before = rig.outs[0].last
            await rig.settle(2.0)
            after = rig.outs[0].last
            seconds = (after.stamp - before.stamp) / SECOND
            assert (after.position - before.position) / seconds == pytest.approx(1.57, abs=2 * STEP)
            assert 19 <= (len(rig.outs[0].kept) - rig.outs[0].kept.index(before)) / 2.0 <= 21

    on_bench(test)


def test_inverted_motors_turn_the_other_way_and_report_forward():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.0, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            assert (rig.rotor(0) > 0, rig.rotor(1) > 0) == (True, False)
            assert rig.outs[1].last.velocity == pytest.approx(1.0, rel=2e-3)

    on_bench(test, StepperConfig(inverted=(False, True, False, True)))


def test_rates_are_limited():
    async def test(rig):
        async with rig.driving():
            rig.run_at(99.0, -99.0, 0.0, 0.0)
            await rig.settle(1.0)
            assert rig.outs[0].last.velocity == pytest.approx(250 * STEP, rel=1e-2)
            assert rig.outs[1].last.velocity == pytest.approx(-250 * STEP, rel=1e-2)

    on_bench(test)


def command(now, action=DriveAction.RUN, rate=1.0):
    return DriveCommand(stamp=now, received=now, seq=0, action=action, speed=0.0, motor_velocity=rate)


def test_the_most_careful_command_and_the_oldest_count_for_all():
    config, now = StepperConfig(motors=2), 10 * SECOND
    run, off = command(now), command(now, DriveAction.DISABLE)
    assert setpoint_of((run, run), now, config).state is MotorState.RUN
    assert setpoint_of((run, None), now, config).state is MotorState.OFF
    assert setpoint_of((run, off), now, config).state is MotorState.OFF
    assert setpoint_of((run, command(now, DriveAction.QUICK_STOP)), now, config).state is MotorState.STOPPED
    assert setpoint_of((run, command(now - SECOND // 2)), now, config).rates == (0, 0)
    assert setpoint_of((run, command(now - 2 * SECOND)), now, config).state is MotorState.STOPPED


def test_a_quick_stop_does_not_wait_for_the_next_cycle():
    async def test(rig):
        async with rig.driving():
            rig.run_at(3.0, 3.0, 3.0, 3.0)
            await rig.settle(2.0)
            rig.action = DriveAction.QUICK_STOP
            asked = rig.clock.now()
            while rig.rotor(0):
                await rig.settle(0.001)
            assert rig.clock.now() - asked < 0.06 * SECOND

    on_bench(test, StepperConfig(rate=5.0, watchdog=0.5))


def test_commands_that_stop_coming_bring_the_motors_to_rest():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.0, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            rig.commanding = False
            await rig.settle(0.4)
            assert rig.rotor(0) == 0
            await rig.settle(1.0)
            assert rig.outs[0].last.mode is DriveMode.QUICK_STOP

    on_bench(test)


def test_a_killed_host_is_noticed_by_the_watchdog():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.0, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            rig.port.device.faults.deaf = True
            await rig.settle(0.25)
            assert rig.rotor(0) != 0
            await rig.settle(0.15)
            assert [rig.rotor(i) for i in range(4)] == [0, 0, 0, 0]
            rig.port.device.faults.deaf = False
            raise asyncio.CancelledError

    with contextlib.suppress(asyncio.CancelledError, DeviceTimeoutError):
        on_bench(test)


def test_motors_that_the_watchdog_stopped_end_the_drive():
    async def test(rig):
        rig.run_at(1.0, 1.0, 1.0, 1.0)

        async def deafen():
            await rig.settle(1.0)
            rig.port.device.faults.deaf = True
            await rig.settle(0.12)
            rig.port.device.faults.deaf = False

        task = asyncio.create_task(deafen())
        with ended(DeviceStoppedError, "watchdog"):
            await rig.session()
        await task
        assert rig.rotor(0) == 0

    on_bench(test, StepperConfig(watchdog=0.11))


def test_a_session_ends_with_motors_at_rest_and_off():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2.0, 2.0, 2.0, 2.0)
            await rig.settle(1.0)
        await rig.settle(0.1)
        assert rig.rotor(0) == 0
        assert (await DEVICES["steppers"].identify(rig.port, rig.clock))["state"] == "off"

    on_bench(test)


@pytest.mark.parametrize("disobeys", ["ignore", "creep 30", "run -40", "reverse"])
def test_motors_that_ignore_the_quick_stop_lose_their_current_at_the_end_of_the_session(disobeys):
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.57, 1.57, 1.57, 1.57)
            await rig.settle(0.5)
            rig.emulator.inject("runaway", *disobeys.split())
            await rig.settle(0.2)
            assert rig.rotor(0) != 0
            began = rig.clock.now()
        assert rig.clock.now() - began <= 0.4 * SECOND
        await rig.settle(0.1)
        assert rig.emulator._state is MotorState.OFF
        assert all(rig.rotor(i) == 0 for i in range(4))

    on_bench(test)


def test_current_off_overtakes_a_quick_stop_that_does_not_help():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.57, 1.57, 1.57, 1.57)
            await rig.settle(0.5)
            rig.emulator.inject("runaway", "ignore")
            rig.action = DriveAction.QUICK_STOP
            await rig.settle(0.5)
            assert rig.rotor(0) > 10
            assert rig.outs[0].kept[-1].velocity > 1
            rig.action = DriveAction.DISABLE
            await rig.settle(0.06)
            assert rig.rotor(0) == 0
            await rig.settle(0.1)
            assert rig.outs[0].kept[-1].mode is DriveMode.DISABLED
            assert rig.outs[0].kept[-1].velocity == 0

    on_bench(test)


def test_a_host_that_comes_back_stops_what_still_turns_first():
    async def test(rig):
        async with await rig.port.open() as link:
            link.write(bytes(Line("R", 1, ("100000",) * 4)))
            await rig.settle(0.1)
            assert rig.rotor(0) > 0
        async with rig.driving():
            await rig.settle(0.2)
            assert rig.rotor(0) == 0
            first = Splitter().feed(bytes(rig.emulator.received))[1]
            assert first.verb == "Q"

    on_bench(test)


def test_unplugged_and_plugged_in_again_positions_go_on():
    async def test(rig):
        rig.run_at(1.0, 1.0, 1.0, 1.0)
        with contextlib.suppress(DeviceLostError):
            async with asyncio.TaskGroup() as group:
                group.create_task(_unplug(rig))
                with ended(DeviceLostError):
                    await rig.session()
        travelled = rig.outs[0].last.position
        assert travelled > 0.5
        await rig.settle(0.5)
        assert rig.rotor(0) == 0, "the watchdog"
        rig.port.plug()
        async with rig.driving():
            await rig.settle(1.0)
            assert rig.outs[0].last.position > travelled

    on_bench(test)


async def _unplug(rig):
    await rig.settle(1.5)
    rig.port.unplug()


def test_a_controller_that_restarts_in_use_ends_the_session():
    async def test(rig):
        rig.run_at(1.0, 1.0, 1.0, 1.0)

        async def restart():
            await rig.settle(2.0)
            rig.emulator.inject("reset")

        task = asyncio.create_task(restart())
        with ended(DeviceRestartedError):
            await rig.session()
        await task
        position = rig.outs[0].last.position
        assert Reason.DEVICE_RESTARTED in rig.events.reasons()
        async with rig.driving():
            await rig.settle(0.5)
            assert rig.outs[0].last.position >= position, "its counter began at 0"

    on_bench(test)


def test_silence_ends_the_session():
    async def test(rig):
        async def mute():
            await rig.settle(1.0)
            rig.emulator.inject("silent", "on")

        task = asyncio.create_task(mute())
        with ended(DeviceTimeoutError):
            await rig.session()
        await task

    on_bench(test)


@pytest.mark.parametrize(("motors", "steps"), [(2, 400), (4, 200)])
def test_other_motors_than_configured_are_refused(motors, steps):
    async def test(rig):
        with ended(DeviceMismatchError, f"{motors} motors with {steps} steps"):
            await rig.session()

    on_bench(test, motors=motors, steps_per_turn=steps)


def test_a_controller_with_more_motors_may_take_the_place_of_another_one():
    async def test(rig):
        now = rig.clock.now()
        rig.driver._last = Status(MotorState.OFF, 0, 0, (7, 7), (0, 0)), now  # powered up at the same time
        async with rig.driving():
            rig.run_at(1.0, 1.0, 0.0, 0.0)
            await rig.settle(1.0)
            assert rig.outs[1].last.velocity == pytest.approx(1.0, rel=2e-3)

    on_bench(test, StepperConfig(motors=2))


def test_another_device_is_refused():
    async def test(rig):
        async def chatter():
            while True:
                rig.port.device.write(b"$C123.4P1.0R2.0T21.0*3F\r\n")
                await rig.settle(0.05)

        rig.emulator.inject("silent", "on")
        task = asyncio.create_task(chatter())
        with ended(WrongDeviceError, "not STEP4"):
            await rig.session()
        task.cancel()

    on_bench(test)


@pytest.mark.parametrize("fault", ["chunk", "noise", "late", "stall", "drops", "flips", "garbage"])
def test_a_bad_line_costs_exchanges_not_the_drive(fault):
    async def test(rig):
        faults = rig.port.device.faults
        async with rig.driving():
            rig.run_at(1.0, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            match fault:
                case "chunk":
                    faults.chunk = 1
                case "noise":
                    rig.emulator.inject("noise", "2")
                case "late":
                    rig.emulator.inject("late", "0.06", "1")
                case "stall":
                    faults.stalled = True
                    await rig.settle(0.06)
                    faults.stalled = False
                case "drops":
                    faults.seed(3)
                    faults.drop_rate = 1e-3
                case "flips":
                    faults.seed(5)
                    faults.flip_rate = 1e-3
                case "garbage":
                    faults.garbage = b"\xff:\x00*hello\n:"
            await rig.settle(3.0)
            newest = rig.outs[0].last
            assert newest.velocity == pytest.approx(1.0, rel=2e-3)
            assert rig.clock.now() - newest.received < 0.25 * SECOND

    on_bench(test, port=MemoryPort("/dev/test"))


def test_a_noisy_line_is_reported():
    async def test(rig):
        async with rig.driving():
            await rig.settle(1.0)
            for _ in range(6):
                rig.emulator.inject("noise", "1")
                await rig.settle(0.2)
            assert Reason.DEVICE_PROTOCOL in rig.events.reasons()

    on_bench(test)


def test_lost_steps_are_not_noticed_and_that_is_said_elsewhere():
    async def test(rig):
        async with rig.driving():
            rig.run_at(1.0, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            rig.emulator.inject("overload", "2", "on")
            await rig.settle(1.0)
            assert (rig.rotor(0) > 0, rig.rotor(1)) == (True, 0)
            assert rig.outs[1].last.velocity == pytest.approx(1.0, rel=2e-3)

    on_bench(test)


def test_beyond_its_torque_a_rotor_stands():
    async def test(rig):
        async with rig.driving():
            rig.run_at(320 * STEP, 1.0, 1.0, 1.0)
            await rig.settle(1.0)
            assert rig.rotor(0) == 0
            assert rig.outs[0].last.velocity == pytest.approx(320 * STEP, rel=1e-2)
            rig.run_at(200 * STEP, 1.0, 1.0, 1.0)
            await rig.settle(0.5)
            assert rig.rotor(0) == 0, "it hums on"
            rig.run_at(100 * STEP, 1.0, 1.0, 1.0)
            await rig.settle(0.5)
            assert rig.rotor(0) > 0

    on_bench(test, StepperConfig(max_rate=400.0))


def test_the_timer_has_whole_ticks():
    async def test(rig):
        async with rig.driving():
            rig.run_at(2.221, 0.0, 0.0, 0.0)  # 141.39 steps/s, 707.3 ticks each
            await rig.settle(1.0)
            assert rig.outs[0].last.velocity == pytest.approx(1e5 / 707 * STEP, abs=2e-5)

    on_bench(test)


def test_requests_it_cannot_carry_out():
    async def test(rig):
        async with await rig.port.open() as link:
            for text, code in ((Line("X", 1), "1"), (Line("R", 2, ("5",)), "2"), (Line("C", 3, ("9", "1", "1")), "2")):
                link.write(bytes(text))
                assert Splitter().feed(await read_until(link, b"\n")) == [Line("e", text.seq, (code,))]
            link.write(bytes(Line("R", 4, ("100000",) * 4)))
            await read_until(link, b"\n")
            await rig.settle(0.1)
            link.write(bytes(Line("C", 5, ("4000", "8000", "300"))))
            assert Splitter().feed(await read_until(link, b"\n")) == [Line("e", 5, ("3",))]

    on_bench(test)


def test_unknown_faults_are_listed():
    async def test(rig):
        for wrong in (("melt",), ("overload", "9", "on"), ("late",), ("noise", "x")):
            with pytest.raises(InputError, match="known: overload"):
                rig.emulator.inject(*wrong)

    on_bench(test)


def test_probe_tells_who_answers():
    async def test(rig):
        report = await DEVICES["steppers"].identify(rig.port, rig.clock)
        assert (report["motors"], report["steps_per_turn"], report["positions"]) == (4, 400, [0, 0, 0, 0])

    on_bench(test)


@pytest.mark.parametrize(
    "bad", [{"inverted": (True,)}, {"watchdog": 0.1, "rate": 10.0}, {"quick_deceleration": 100}, {"motors": 5}]
)
def test_settings_that_contradict_each_other(bad):
    with pytest.raises(ValueError, match=r"expected|less than"):
        StepperConfig(**bad)
