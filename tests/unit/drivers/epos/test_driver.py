"""The drive service against the emulator on the virtual clock: driving, stopping, damage, loss, faults."""

import asyncio
import contextlib
import itertools
import math
from pathlib import Path

import pytest

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import SAFE_DEADLINE
from monstertruck_drivers.epos.policy import RAD_S_PER_RPM
from monstertruck_drivers.epos.probe import probe
from monstertruck_drivers.epos.protocol import Control, Opcode, State
from monstertruck_drivers.link import SerialPort
from monstertruck_drivers.pty_port import PtyPort
from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    PortBusyError,
    WrongDeviceError,
)
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.epos.rig import Rig, bench, on_bench
from tests.unit.drivers.kit import background


def controls(rig: Rig) -> list[int]:
    return [value for _, value in rig.writes(od.CONTROLWORD)]


def targets(rig: Rig) -> list[int]:
    return [value for _, value in rig.writes(od.TARGET_VELOCITY)]


# Driving


def test_driving_forward_is_negative_rpm_and_positive_feedback():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            assert rig.shaft_rpm == -6_000
            await rig.settle(1.0)
            feedback = rig.newest
            assert feedback.mode is DriveMode.ENABLED
            assert feedback.velocity == pytest.approx(6_000 * RAD_S_PER_RPM, rel=1e-3)
            assert feedback.fault_code is None
            assert feedback.position == pytest.approx(-rig.motor.reading(rig.clock.now()).turns * 2 * math.pi, abs=40)
            currents = [message.current for message in rig.out.kept[-20:] if message.current is not None]
            assert 3 <= len(currents) <= 6
            assert sum(currents) / len(currents) == pytest.approx(0.06, abs=0.01)
            assert [message.seq for message in rig.out.kept] == list(range(len(rig.out.kept)))
            await rig.drive(-3_000)
            assert rig.newest.velocity == pytest.approx(-3_000 * RAD_S_PER_RPM, rel=2e-3)
        assert rig.events.reasons() == [Reason.DEVICE_READY]
        assert rig.events.kept[0][3]["encoder_pulses_per_turn"] == 500
        assert len(rig.ready_at) == 1

    on_bench(test)


def test_the_sign_can_be_that_of_the_controller():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            rig.gate.say(DriveAction.RUN, 1_000)
            await rig.until(lambda: rig.shaft_rpm == 1_000)
            await rig.settle(0.3)
            assert rig.newest.velocity == pytest.approx(1_000 * RAD_S_PER_RPM, rel=1e-3)

    on_bench(test, EposConfig(inverted=False))


@pytest.mark.parametrize("rate", [20.0, 25.0])
def test_feedback_keeps_its_rate_while_the_target_changes_all_the_time(rate: float):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            first = len(rig.out.kept)
            for step in range(200):
                rig.gate.say(DriveAction.RUN, 6_000 + 20 * (step % 50))
                await rig.settle(0.02)
            assert len(rig.out.kept) - first == pytest.approx(4 * rate, abs=2)

    on_bench(test, EposConfig(rate=rate))


def test_stamps_are_when_the_position_was_true():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            first = len(rig.out.kept)
            before = rig.motor.reading(rig.clock.now()).turns, rig.clock.now()
            await rig.settle(1.0)
            for message in rig.out.kept[first + 1 :]:
                true = -(before[0] - 100 * (message.stamp - before[1]) / SECOND)
                assert message.position / (2 * math.pi) == pytest.approx(true, abs=100 * 0.003), "within 3 ms"
                assert 0 <= message.received - message.stamp < 0.007 * SECOND

    on_bench(test)


def test_bring_up_sets_mode_profile_and_target_0_before_enabling():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(2_000)
        writes = [frame.words for _, frame in rig.emulator.frames if frame.opcode == Opcode.WRITE]
        enabled = next(i for i, words in enumerate(writes) if words[0] == 0x6040 and words[2] == Control.ENABLE)
        before = {(words[0], words[2]) for words in writes[:enabled]}
        assert (0x6060, 3) in before
        assert {(0x607F, 18_000), (0x6083, 60_000), (0x6084, 200_000 & 0xFFFF), (0x6085, 240_000 & 0xFFFF)} <= before
        assert {words[2:] for words in writes[:enabled] if words[0] == 0x60FF} == {(0, 0)}
        assert writes[0] == (0x6040, 0x0100, Control.QUICK_STOP, 0), "the very first bytes stop it"

    on_bench(test)


def test_the_target_is_not_written_again_while_it_stays():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(2_000)
            count = len(targets(rig))
            await rig.settle(1.0)
            assert len(targets(rig)) == count

    on_bench(test)


# Stopping


@pytest.mark.parametrize("phase", [0, 7, 13, 19, 23, 29, 37, 43])
def test_a_quick_stop_waits_for_one_exchange_at_most(phase: int):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
            await rig.settle(phase / 1000)
            said = rig.clock.now()
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.until(lambda: rig.shaft_rpm == 0)
            sent = next(instant for instant, value in rig.writes(od.CONTROLWORD)[::-1] if value == Control.QUICK_STOP)
            assert (sent - said) / SECOND < 0.020, "frame complete at the controller"
            assert (rig.clock.now() - said) / SECOND < 0.21
            await rig.settle(0.2)
            assert rig.newest.mode is DriveMode.QUICK_STOP
            assert targets(rig)[-1] == 0
            await rig.drive(3_000)
            assert controls(rig)[-1] == Control.ENABLE, "straight from quick stop"

    on_bench(test)


@pytest.mark.parametrize("rpm", [0.0, 2_000.0, -5_000.0])
def test_a_slower_target_jumps_the_queue_too(rpm: float):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(5_000)
            for _ in range(10):
                await rig.settle(0.011)
                said = rig.clock.now()
                rig.gate.say(DriveAction.RUN, rpm)
                await rig.until(lambda: targets(rig)[-1] == -rpm)
                assert (rig.clock.now() - said) / SECOND < 0.025
                rig.gate.say(DriveAction.RUN, 5_000)
                await rig.until(lambda: targets(rig)[-1] == -5_000)

    on_bench(test)


def test_disable_brakes_first_and_switches_off_at_rest():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(10_000)
            rig.gate.say(DriveAction.DISABLE)
            await rig.until(lambda: rig.emulator.state is State.QUICK_STOP, 0.05)
            await rig.until(lambda: rig.emulator.state is State.SWITCH_ON_DISABLED, 0.4)
            assert abs(rig.shaft_rpm) < 60
            await rig.settle(0.15)
            assert rig.newest.mode is DriveMode.DISABLED
            await rig.drive(1_000)

    on_bench(test)


def test_switching_off_a_motor_at_rest_is_no_loss():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.say(DriveAction.RUN, 0)
            await rig.until(lambda: rig.shaft_rpm == 0)
            await rig.settle(0.5)
            assert rig.newest.mode is DriveMode.ENABLED
            rig.gate.say(DriveAction.DISABLE)
            await rig.until(lambda: rig.newest.mode is DriveMode.DISABLED)
            await rig.drive(6_000)
        assert len(rig.ready_at) == 1

    on_bench(test)


def test_silence_of_the_commands_is_target_0_then_quick_stop_then_fresh_commands_again():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.talking = False
            last = rig.clock.now()
            await rig.until(lambda: targets(rig)[-1] == 0)
            assert 0.22 < (rig.clock.now() - last) / SECOND < 0.30
            await rig.until(lambda: rig.shaft_rpm == 0, 0.2)
            assert rig.emulator.state is State.ENABLED
            await rig.until(lambda: rig.emulator.state is State.QUICK_STOP)
            assert 0.95 < (rig.clock.now() - last) / SECOND < 1.07
            await rig.settle(2.0)
            assert rig.newest.mode is DriveMode.QUICK_STOP
            assert rig.newest.received > rig.clock.now() - SECOND // 10, "feedback goes on"
            rig.gate.talking = True
            await rig.drive(1_000)

    on_bench(test)


def test_without_any_command_nothing_is_enabled():
    async def test(rig: Rig) -> None:
        rig.gate.talking = False
        async with rig.driving():
            await rig.settle(2.0)
            assert rig.newest.mode is DriveMode.DISABLED
            assert set(controls(rig)) == {Control.QUICK_STOP}

    on_bench(test)


@pytest.mark.parametrize("rpm", [0, 3_000, 18_000])
def test_cancelling_leaves_the_motor_stopped_and_disabled(rpm: int):
    async def test(rig: Rig) -> None:
        for extra in (0.0, 0.003, 0.006, 0.011, 0.017):
            async with rig.driving() as task:
                await rig.drive(rpm)
                await rig.settle(extra)
                start = rig.clock.now()
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task
            assert (rig.clock.now() - start) / SECOND <= SAFE_DEADLINE
            assert rig.emulator.state is State.SWITCH_ON_DISABLED
            assert abs(rig.shaft_rpm) < 60

    on_bench(test)


def test_a_motor_that_brakes_too_slowly_is_left_braking_not_rolling():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
        assert rig.emulator.state is State.QUICK_STOP
        assert rig.driver._quiet_until == 0, "no exchange was cut"
        await rig.settle(0.7)
        assert rig.shaft_rpm == 0

    on_bench(test, EposConfig(quick_stop_deceleration_rpm_s=20_000))


def test_cancelling_a_silent_line_takes_no_longer_than_the_deadline():
    async def test(rig: Rig) -> None:
        async with rig.driving() as task:
            await rig.drive(1_000)
            rig.emulator.inject("silent", "on")
            await rig.settle(0.3)
            start = rig.clock.now()
            task.cancel()
            await asyncio.wait([task])
            assert (rig.clock.now() - start) / SECOND <= SAFE_DEADLINE + 0.001

    on_bench(test)


@pytest.mark.parametrize("phase", range(0, 50, 7))
def test_running_again_right_after_a_quick_stop_starts_from_0(phase: int):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            await rig.settle(phase / 1000)
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(0.021)
            rig.gate.say(DriveAction.RUN, 6_000)
            await rig.settle(0.5)
            assert rig.shaft_rpm == -6_000
        stopped = next(at for at, word in rig.writes(od.CONTROLWORD)[1:] if word == Control.QUICK_STOP)
        enabled = next(at for at, word in rig.writes(od.CONTROLWORD) if word == Control.ENABLE and at > stopped)
        assert {value for at, value in rig.writes(od.TARGET_VELOCITY) if stopped < at < enabled} == {0}

    on_bench(test)


def test_a_target_whose_write_was_not_confirmed_is_written_again():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            await rig.until(lambda: targets(rig)[-1] == -6_000)
            rig.emulator.inject("delay", "600", "1")
            rig.gate.say(DriveAction.RUN, 2_000)
            await rig.until(lambda: targets(rig)[-1] == -2_000)
            rig.gate.say(DriveAction.RUN, 6_000)
            await rig.settle(2.0)
            assert rig.shaft_rpm == -6_000

    on_bench(test)


def test_a_quick_stop_that_latches_is_left_the_long_way():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("latch", "on")
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(0.5)
            await rig.drive(6_000)
        assert controls(rig).count(Control.SHUTDOWN) >= 2

    on_bench(test)


# The hardware line, and other obstinacy


def test_the_deadman_line_is_obeyed_and_driving_goes_on_when_it_is_released():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.set_quick_stop_input(True)
            await rig.until(lambda: rig.shaft_rpm == 0, 0.1)
            await rig.settle(0.2)
            assert rig.newest.mode is DriveMode.QUICK_STOP
            assert targets(rig)[-1] == 0
            await rig.settle(3.0)
            assert rig.shaft_rpm == 0
            assert rig.newest.mode is not DriveMode.ENABLED
            assert [event for event in rig.events.reasons() if event is not Reason.DEVICE_READY] == [
                Reason.DEVICE_TIMEOUT
            ], "told once"
            rig.emulator.set_quick_stop_input(False)
            await rig.drive(6_000)

    on_bench(test)


def test_controlwords_refused_by_state_are_no_failure():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("strict", "on")
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.set_quick_stop_input(True)
            await rig.settle(1.0)
            rig.emulator.set_quick_stop_input(False)
            await rig.drive(6_000)

    on_bench(test)


# Damage on the line


async def driven_through(rig: Rig, seconds: float = 3.0) -> list[float]:
    """Gaps between feedback messages while a fault acts."""
    first = len(rig.out.kept)
    await rig.settle(seconds)
    stamps = [message.stamp / SECOND for message in rig.out.kept[first - 1 :]]
    return [b - a for a, b in itertools.pairwise(stamps)]


@pytest.mark.parametrize("fault", ["busy 3", "refuse 1", "flip 1", "stray 3", "delay 50 3", "delay 5 50"])
def test_small_disturbances_cost_less_than_a_tenth_of_a_second(fault: str):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.inject(*fault.split())
            assert max(await driven_through(rig, 1.0)) < 0.25
            assert rig.shaft_rpm == -6_000
            assert rig.newest.velocity == pytest.approx(6_000 * RAD_S_PER_RPM, rel=1e-3)

    on_bench(test)


@pytest.mark.parametrize("fault", ["delay 600 1", "silent"])
def test_an_answer_that_is_600_ms_late_or_missing_costs_one_silence(fault: str):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            position = rig.newest.position
            if fault == "silent":
                rig.emulator.inject("silent", "on")
                await rig.settle(0.2)
                rig.emulator.inject("silent", "off")
            else:
                rig.emulator.inject(*fault.split())
            start = rig.clock.now()
            gaps = await driven_through(rig, 2.5)
            assert 0.6 < max(gaps) < 1.3
            turned = 100 * 2 * math.pi * (rig.clock.now() - start) / SECOND
            assert rig.newest.position - position == pytest.approx(turned, rel=0.1), "no motion is lost"
        assert len(rig.ready_at) == 1, "one session"

    on_bench(test)


def test_a_stop_wanted_during_the_silence_goes_out_first():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.inject("delay", "600", "1")
            await rig.settle(0.1)
            rig.gate.say(DriveAction.QUICK_STOP)
            first = len(rig.emulator.frames)
            await rig.until(lambda: rig.emulator.state is State.QUICK_STOP)
            await rig.settle(0.1)
            assert list(rig.emulator.frames)[first][1].words == (0x6040, 0x0100, Control.QUICK_STOP, 0)

    on_bench(test)


@pytest.mark.parametrize("chunk", [1, 3])
def test_reads_of_one_byte_change_nothing(chunk: int):
    async def test(rig: Rig) -> None:
        rig.port.device.faults.chunk = chunk
        async with rig.driving():
            await rig.drive(6_000)
            assert max(await driven_through(rig, 1.0)) < 0.06

    on_bench(test)


def test_garbage_and_flipped_bits_never_give_wrong_feedback_nor_kill_the_service():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.port.device.faults.seed(4)
            rig.port.device.faults.flip_rate = 0.004
            rig.port.device.faults.garbage = bytes(range(256))
            first = len(rig.out.kept)
            await rig.settle(20.0)
            rig.port.device.faults.flip_rate = 0.0
            await rig.settle(2.0)
            steps = [b.position - a.position for a, b in itertools.pairwise(rig.out.kept[first:])]
            assert all(abs(step) < 18_000 * RAD_S_PER_RPM * 4 for step in steps)
            assert all(abs(message.velocity) < 6_500 * RAD_S_PER_RPM for message in rig.out.kept[first:])
            assert len(steps) > 100, "most of the time it works"
            await rig.drive(6_000)

    on_bench(test)


# Loss


@pytest.mark.parametrize("gone", [0.05, 0.3, 1.0, 7.0])
def test_unplugged_while_moving_it_is_stopped_first_thing_after_the_replug(gone: float):
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(18_000)
            position = rig.newest.position
            start = rig.clock.now()
            rig.port.unplug()
            await rig.settle(gone)
            assert rig.shaft_rpm == -18_000, "the controller keeps its last speed"
            assert rig.health[-1].state in (ServiceState.BACKOFF, ServiceState.STARTING)
            rig.gate.say(DriveAction.QUICK_STOP)  # as the gate does without feedback
            frames = len(rig.emulator.frames)
            rig.port.plug()
            took = await rig.until(lambda: rig.shaft_rpm == 0)
            assert took < 1.2
            assert list(rig.emulator.frames)[frames][1].words == (0x6040, 0x0100, Control.QUICK_STOP, 0)
            rolled = 300 * 2 * math.pi * (rig.clock.now() - start) / SECOND
            await rig.settle(1.0)
            assert rig.health[-1].state is ServiceState.READY
            assert rig.newest.position - position == pytest.approx(rolled, rel=0.25), "motion meanwhile is known"
            await rig.drive(1_000)

    on_bench(test)


def test_a_replug_stops_the_motor_even_if_commands_to_run_went_on():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.port.unplug()
            await rig.settle(0.8)
            rig.port.plug()
            await rig.until(lambda: rig.shaft_rpm == 0, 1.2)
            await rig.drive(6_000)

    on_bench(test)


@pytest.mark.parametrize("seconds", [1.0, 5.0, 20.0])
def test_after_a_stall_it_stops_within_the_limit(seconds: float):
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(18_000)
            rig.port.device.faults.stalled = True
            rig.port.device.faults.deaf = True
            await rig.settle(seconds)
            rig.gate.say(DriveAction.QUICK_STOP)
            assert rig.shaft_rpm == -18_000
            rig.port.device.faults.stalled = rig.port.device.faults.deaf = False
            assert await rig.until(lambda: rig.shaft_rpm == 0) < 1.2
            await rig.settle(1.0)
            await rig.drive(1_000)

    on_bench(test)


def test_silence_ends_the_session():
    async def test(rig: Rig) -> None:
        session = asyncio.create_task(rig.session())
        await rig.drive(1_000)
        rig.emulator.inject("silent", "on")
        start = rig.clock.now()
        with pytest.raises(DeviceTimeoutError):
            await session
        assert 1.0 < (rig.clock.now() - start) / SECOND < 2.5

    on_bench(test)


@pytest.mark.parametrize("action", [DriveAction.RUN, DriveAction.QUICK_STOP, DriveAction.DISABLE])
def test_a_power_cycle_is_noticed_and_brings_it_back_prepared(action: DriveAction):
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            if action is not DriveAction.RUN:
                rig.gate.say(action)
                await rig.settle(1.0)
            position = rig.newest.position
            rig.emulator.power_cycle()
            await rig.settle(2.5)
            await rig.drive(6_000)
            values = rig.emulator.firmware
            assert values.read(0x6060, 0) == 3
            assert values.read(0x6083, 0) == 60_000
            lost = 100 * 2 * math.pi * 0.7
            assert rig.newest.position >= position - lost, "the counter began at 0, the odometer did not"
            jumps = [b.position - a.position for a, b in itertools.pairwise(rig.out.kept)]
            assert min(jumps) > -lost

    on_bench(test)


def test_a_power_cycle_while_idle_is_no_secret_either():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
            rig.emulator.power_cycle()
            await rig.settle(1.5)
            await rig.drive(6_000)
        assert len(rig.ready_at) == 1

    on_bench(test)


def test_a_counter_that_restarted_while_unplugged_is_no_motion():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            await rig.settle(3.0)
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(1.0)
            position = rig.newest.position
            assert position > 1_000
            rig.port.unplug()
            rig.emulator.power_cycle()
            await rig.settle(60.0)
            rig.port.plug()
            await rig.settle(1.5)
            assert rig.newest.received > rig.clock.now() - SECOND // 10
            assert rig.newest.position == position

    on_bench(test)


def test_after_a_loss_in_the_middle_of_an_exchange_nothing_is_sent_before_the_controller_listens():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.emulator.inject("delay", "200", "1")
            await rig.settle(0.05)
            lost = rig.clock.now()
            rig.port.unplug()
            await rig.settle(0.01)
            rig.port.plug()
            heard = len(rig.emulator.received)
            await rig.until(lambda: rig.shaft_rpm == 0)
            assert rig.emulator.received[heard][0] - lost > 0.5 * SECOND
            assert (rig.clock.now() - lost) / SECOND < 0.85, "the late byte of the old answer prolongs the silence"

    on_bench(test)


def test_a_quick_restart_is_noticed_by_the_state():
    async def test(rig: Rig) -> None:
        session = asyncio.create_task(rig.session())
        await rig.drive(6_000)
        rig.emulator.firmware.shut_down()
        rig.emulator.firmware.boot()
        with pytest.raises(DeviceLostError, match="restarted"):
            await session

    on_bench(test)


def test_nothing_plugged_in():
    async def test(rig: Rig) -> None:
        rig.port.unplug()
        with pytest.raises(DeviceLostError, match="not plugged in"):
            await rig.session()
        rig.port.plug()
        async with await rig.port.open():
            with pytest.raises(PortBusyError):
                await rig.session()

    on_bench(test)


# Faults


def test_a_passing_fault_is_told_reset_and_driving_goes_on_from_0():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.emulator.inject("fault", "over_voltage", "passing")
            await rig.until(lambda: rig.newest.mode is DriveMode.FAULT, 0.25)
            assert rig.newest.fault_code == 0x3210
            await rig.until(lambda: rig.newest.mode is not DriveMode.FAULT)
            await rig.drive(6_000)
        reason, severity, text, values = rig.events.kept[1]
        assert (reason, severity) == (Reason.DRIVE_FAULT, Severity.ERROR)
        assert "0x3210 (over-voltage)" in text
        assert values == {"code": 0x3210}
        assert "gone" in rig.events.kept[2][2]
        reset = controls(rig).index(Control.FAULT_RESET)
        assert controls(rig)[reset - 1] == Control.DISABLE_VOLTAGE, "an edge"
        assert controls(rig).count(Control.FAULT_RESET) == 1
        cleared = rig.writes(od.CONTROLWORD)[reset][0]
        assert next(value for instant, value in rig.writes(od.TARGET_VELOCITY) if instant > cleared) == 0

    on_bench(test)


def test_after_a_fault_only_fresh_commands_count():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.talking = False
            rig.gate.say(DriveAction.RUN, 6_000)
            rig.emulator.inject("fault", "over_current", "passing")
            await rig.settle(2.0)
            assert rig.newest.mode is DriveMode.DISABLED
            assert rig.shaft_rpm == 0

    on_bench(test, EposConfig(command_timeout=50.0, quick_stop_after=60.0))


def test_a_permanent_fault_ends_after_three_resets_and_waits_for_its_cause():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.emulator.inject("fault", "encoder")
            await rig.settle(8.0)
            assert controls(rig).count(Control.FAULT_RESET) == 3
            assert rig.health[-1].state is not ServiceState.READY
            assert any(row.reason is Reason.DEVICE_FAULT for row in rig.health)
            assert rig.events.reasons().count(Reason.DRIVE_FAULT) == 1, "told once"
            assert rig.newest.mode is DriveMode.FAULT
            assert rig.newest.fault_code == od.POSITION_SENSOR
            rig.emulator.inject("clear")
            await rig.until(lambda: rig.newest.mode is DriveMode.ENABLED, 12.0)

    on_bench(test)


def test_a_permanent_fault_raises():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "following")
        with pytest.raises(DeviceFaultError, match=r"0x8611 \(following error\) stays after 3 resets"):
            await rig.session()
        assert rig.ready_at == []

    on_bench(test)


def test_a_fault_that_comes_back_on_enabling_uses_up_the_resets():
    async def test(rig: Rig) -> None:
        async def failing() -> None:
            while True:
                await rig.until(lambda: rig.emulator.state is State.ENABLED, 60)
                rig.emulator.inject("fault", "over_current", "passing")

        async with background(failing()):
            session = asyncio.create_task(rig.session())
            rig.gate.say(DriveAction.RUN, 6_000)
            with pytest.raises(DeviceFaultError):
                await session
        assert controls(rig).count(Control.FAULT_RESET) == 3

    on_bench(test)


# Other devices, other set-ups


def test_another_device_on_the_port():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig:
            rig.emulator.inject("silent", "on")

            async def compass(end: DeviceEnd) -> None:
                while True:
                    end.write(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                    await clock.sleep(0.1)

            async with background(compass(rig.port.device)):
                with pytest.raises(WrongDeviceError, match=r"no EPOS, sends"):
                    await rig.session()
                with pytest.raises(WrongDeviceError, match=r"no EPOS, sends"):
                    await probe(rig.port, clock)
            assert rig.ready_at == []

    run_virtual(main)


def test_a_device_that_never_answers():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("silent", "on")
        with pytest.raises(DeviceTimeoutError):
            await rig.session()
        with pytest.raises(DeviceTimeoutError):
            await probe(rig.port, rig.clock)

    on_bench(test)


def test_a_slow_controller_is_not_taken_for_another_device():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("delay", "600")
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EposConfig(encoder_pulses_per_turn=512), "is 500, expected 512"),
        (EposConfig(motor_type=1), "motor type"),
        (EposConfig(node=5), "wrong node id.*configured 5"),
    ],
)
def test_other_parameters_than_configured(config: EposConfig, message: str):
    async def test(rig: Rig) -> None:
        with pytest.raises(DeviceMismatchError, match=message):
            await rig.session()
        assert rig.ready_at == []
        assert Control.ENABLE not in controls(rig)

    on_bench(test, config)


@pytest.mark.parametrize("missing", [(od.CONTROLWORD, "no EPOS 24/1"), (od.SOFTWARE_VERSION, "without 0x2003/1")])
def test_an_object_server_that_is_no_epos(missing: tuple[od.Entry, str], monkeypatch: pytest.MonkeyPatch):
    entry, message = missing
    monkeypatch.delitem(od.OBJECTS, (entry.index, entry.sub))

    async def test(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match=message):
            await rig.session()

    on_bench(test)


def test_a_motor_already_running_in_an_unknown_session_is_stopped_before_anything_is_read():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.port.unplug()
        other = type(rig.driver)(EposConfig(), rig.port, rig.clock, rig.commands, rig.out, rig.events)
        rig.gate.say(DriveAction.DISABLE)
        await rig.settle(1.0)
        assert rig.shaft_rpm == -6_000
        rig.port.plug()
        async with background(other.run(rig.ready)):
            assert await rig.until(lambda: rig.shaft_rpm == 0) < 0.1
            await rig.settle(0.5)
            assert rig.emulator.state is State.SWITCH_ON_DISABLED

    on_bench(test)


# Probe, and a real tty


def test_probe_reports_and_changes_nothing():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "over_voltage", "passing")
        await rig.settle(0.1)
        report = await probe(rig.port, rig.clock)
        assert report["identity"]["software"] == 0x2024
        assert report["identity"]["serial_number"] == "6301602400001234"
        assert report["state"] == "FAULT"
        assert report["faults"] == [{"code": 0x3210, "text": "0x3210 (over-voltage)"}]
        assert len(report["samples"]) == 5
        assert {frame.opcode for _, frame in rig.emulator.frames} == {
            Opcode.READ,
            Opcode.INITIATE_SEGMENTED_READ,
            Opcode.SEGMENTED_READ,
        }

    on_bench(test)


def test_probe_copes_without_a_serial_number(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(od.OBJECTS, (od.SERIAL_NUMBER.index, 0))

    async def test(rig: Rig) -> None:
        assert (await probe(rig.port, rig.clock))["identity"]["serial_number"] is None

    on_bench(test)


@pytest.mark.wall
async def test_over_a_pty_on_the_wall_clock(tmp_path: Path):
    clock, path = WallClock(), tmp_path / "drive"
    async with bench(clock, port=PtyPort(path)) as rig:
        rig.driver._port = SerialPort(path, 38_400)
        async with rig.supervised():
            rig.gate.say(DriveAction.RUN, 18_000)
            await rig.until(lambda: rig.shaft_rpm == -18_000, 3.0)
            rig.port.unplug()
            await rig.settle(0.2)
            rig.port.plug()
            assert await rig.until(lambda: abs(rig.shaft_rpm) < 10) < 1.2
            await rig.drive(6_000)
        assert rig.emulator.state is State.SWITCH_ON_DISABLED
