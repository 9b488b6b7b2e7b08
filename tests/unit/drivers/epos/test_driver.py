"""The drive service against the emulator on the virtual clock: driving, stopping, the hardware line."""

import asyncio
import contextlib
import math
from collections.abc import Callable
from itertools import pairwise

import pytest

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import RAD_S_PER_RPM, SAFE_ATTEMPTS, SAFE_TIME
from monstertruck_drivers.epos.exchange import QUIET
from monstertruck_drivers.epos.protocol import Control, Opcode, State
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.epos.rig import Rig, controls, on_bench, targets

BRAKING = 0.075
"""Seconds of a quick stop from full speed."""

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
@pytest.mark.parametrize("rpm", [lambda step: 12_000 + step * 7919 % 400, lambda step: 16_000 - 20 * step])
def test_a_cycle_longer_than_its_period_is_followed_by_the_next_at_once(rate: float, rpm: Callable[[int], int]):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(16_000)
            first = len(rig.out.kept)
            for step in range(200):
                rig.gate.say(DriveAction.RUN, rpm(step))
                await rig.settle(0.02)
            stamps = [feedback.stamp for feedback in rig.out.kept[first:]]
            assert len(stamps) >= 4 * 19
            assert max(later - earlier for earlier, later in pairwise(stamps)) < 0.075 * SECOND

    on_bench(test, EposConfig(rate=rate))


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
            stops = [at for at, value in rig.writes(od.CONTROLWORD) if value == Control.QUICK_STOP and at >= said]
            sent = stops[0]
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


def test_disable_switches_off_at_once_whatever_turns():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(10_000)
            rig.gate.say(DriveAction.DISABLE)
            await rig.until(lambda: rig.emulator.state is State.SWITCH_ON_DISABLED, 0.05)
            assert abs(rig.shaft_rpm) > 9_000
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
            assert (rig.clock.now() - start) / SECOND <= SAFE_TIME + BRAKING
            assert rig.emulator.state is State.SWITCH_ON_DISABLED
            assert abs(rig.shaft_rpm) < 60

    on_bench(test)


def test_a_motor_that_brakes_slowly_is_given_the_time_of_its_ramp_and_switched_off_at_rest():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
            began = rig.clock.now()
        assert (rig.clock.now() - began) / SECOND == pytest.approx(18_000 / 20_000, abs=0.05)
        assert rig.driver._quiet_until == 0, "no exchange was cut"
        assert rig.emulator.state is State.SWITCH_ON_DISABLED
        assert abs(rig.shaft_rpm) <= 60

    on_bench(test, EposConfig(quick_stop_deceleration_rpm_s=20_000))


@pytest.mark.parametrize("disobeys", ["ignore", "creep 5000", "run -9000", "reverse"])
def test_a_motor_that_ignores_the_quick_stop_loses_its_power_stage_at_the_end_of_the_session(disobeys: str):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
            rig.emulator.inject("runaway", *disobeys.split())
            ended = rig.clock.now()
        assert rig.clock.now() - ended <= 0.3 * SECOND
        assert rig.emulator.state is State.SWITCH_ON_DISABLED
        await rig.settle(1.0)
        assert rig.shaft_rpm == 0

    on_bench(test)


def test_a_quick_stop_is_sent_again_after_every_velocity_until_standstill_is_measured():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
            rig.emulator.inject("runaway", "ignore")
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(0.5)
            sent = controls(rig).count(Control.QUICK_STOP)
            rig.emulator.inject("runaway", "off")
            await rig.until(lambda: rig.shaft_rpm == 0, 0.2)
            await rig.settle(0.1)
            before = controls(rig).count(Control.QUICK_STOP)
            await rig.settle(0.5)
            assert sent >= 10, "20 velocities a second"
            assert controls(rig).count(Control.QUICK_STOP) == before, "it rests"
            assert rig.newest.velocity == pytest.approx(0.0, abs=1.0)

    on_bench(test)


def test_power_off_overtakes_a_quick_stop_that_does_not_help():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(18_000)
            rig.emulator.inject("runaway", "ignore")
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(0.3)
            assert abs(rig.shaft_rpm) > 17_000
            rig.gate.say(DriveAction.DISABLE)
            await rig.until(lambda: rig.emulator.state is State.SWITCH_ON_DISABLED, 0.04)
            await rig.until(lambda: rig.newest.mode is DriveMode.DISABLED, 0.1)
            await rig.until(lambda: rig.shaft_rpm == 0, 1.0)

    on_bench(test)


@pytest.mark.parametrize("wait", [0.02, 0.12, 0.28, 0.33])
@pytest.mark.parametrize("fault", ["delay 270 1", "length 2", "acknowledge 1", "stray 5", "refuse 2", "silent on"])
def test_cancelling_while_the_line_is_kept_quiet_leaves_the_motor_disabled(fault: str, wait: float):
    """After a late or damaged answer nothing may be sent for up to 0.55 s; the last bytes are sent all the same."""

    async def test(rig: Rig) -> None:
        async with rig.driving() as task:
            await rig.drive(6_000)
            rig.emulator.inject(*fault.split())
            await rig.settle(wait)
            rig.emulator.inject("silent", "off")
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(0.05)
            task.cancel()
            await asyncio.wait([task])
        rig.gate.talking = False
        await rig.settle(1.0)
        assert rig.emulator.state is State.SWITCH_ON_DISABLED
        assert rig.shaft_rpm == 0

    on_bench(test)


def test_cancelling_a_silent_line_takes_no_longer_than_the_deadlines():
    async def test(rig: Rig) -> None:
        async with rig.driving() as task:
            await rig.drive(1_000)
            rig.emulator.inject("silent", "on")
            await rig.settle(0.3)
            start = rig.clock.now()
            task.cancel()
            await asyncio.wait([task])
            assert (rig.clock.now() - start) / SECOND <= SAFE_ATTEMPTS * (QUIET + SAFE_TIME + BRAKING) + 0.001

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


def test_the_deadman_line_is_obeyed_and_the_next_session_drives_when_it_is_released():
    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.emulator.set_quick_stop_input(True)
            await rig.until(lambda: rig.shaft_rpm == 0, 0.1)
            await rig.settle(0.2)
            assert targets(rig)[-1] == 0
            await rig.settle(3.5)
            assert rig.shaft_rpm == 0
            assert rig.newest.mode is not DriveMode.ENABLED
            assert [event for event in rig.events.reasons() if event is not Reason.DEVICE_READY] == [
                Reason.DEVICE_STOPPED,
                Reason.DEVICE_TIMEOUT,
            ], "reported once"
            rig.emulator.set_quick_stop_input(False)
            await rig.drive(6_000)

    on_bench(test)


def test_controlwords_refused_by_state_are_no_failure():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("strict", "on")
        async with rig.driving():
            await rig.drive(0)
            rig.emulator.set_quick_stop_input(True)
            await rig.settle(0.5)
            rig.gate.say(DriveAction.RUN, 6_000)
            await rig.settle(1.0)
            rig.emulator.set_quick_stop_input(False)
            await rig.drive(6_000)

    on_bench(test)
