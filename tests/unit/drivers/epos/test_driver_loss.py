"""The drive service through damage on the line, lost cables, silence and restarts."""

import asyncio
import itertools
import math
from collections.abc import Callable
from functools import partial
from unittest.mock import AsyncMock

import pytest

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.driver import RAD_S_PER_RPM, _DriveSession
from monstertruck_drivers.epos.protocol import Control, State
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    PortBusyError,
)
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceState
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.epos.rig import Rig, on_bench

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
            assert max(await driven_through(rig, 1.0)) < 0.15
            assert rig.shaft_rpm == -6_000
            assert rig.newest.velocity == pytest.approx(6_000 * RAD_S_PER_RPM, rel=1e-3)

    on_bench(test)


@pytest.mark.parametrize(("fault", "least", "most"), [("delay 600 1", 0.6, 1.3), ("silent", 0.2, 0.4)])
def test_an_answer_that_is_600_ms_late_or_missing_costs_one_silence(fault: str, least: float, most: float):
    """A long one only while an answer may still come."""

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
            assert least < max(gaps) < most
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


@pytest.mark.parametrize("marked", [True, False])
def test_a_counter_that_restarted_while_unplugged_is_no_motion(marked: bool, monkeypatch: pytest.MonkeyPatch):
    """Also with a controller that knows no object to keep a mark in."""
    if not marked:
        monkeypatch.setattr(_DriveSession, "_check_mark", AsyncMock())

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


def test_a_mark_that_another_master_left_at_the_greatest_value_goes_on_from_zero():
    async def test(rig: Rig) -> None:
        rig.emulator.firmware.write(od.MARK.index, od.MARK.sub, od.MARK.limits[1])
        async with rig.supervised():
            await rig.drive(6_000)
        assert [mark for _, mark in rig.writes(od.MARK)] == [0]
        assert rig.driver.mark == 0

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


def test_a_deadman_line_that_fell_for_a_moment_ends_the_session():
    """The controller stays in its quick stop; setting off again at once would be a motion that nobody ordered."""

    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(6_000)
            rig.emulator.set_quick_stop_input(active=True)
            await rig.settle(0.05)
            rig.emulator.set_quick_stop_input(active=False)
            await rig.settle(0.5)
            assert Reason.DEVICE_STOPPED in [row.reason for row in rig.health]
            assert rig.events.reasons().count(Reason.DEVICE_STOPPED) == 1

    on_bench(test)

    async def test(rig: Rig) -> None:
        rig.port.unplug()
        with pytest.raises(DeviceLostError, match="not plugged in"):
            await rig.session()
        rig.port.plug()
        async with await rig.port.open():
            with pytest.raises(PortBusyError):
                await rig.session()

    on_bench(test)


@pytest.mark.parametrize("wanted", [DriveAction.RUN, DriveAction.QUICK_STOP])
def test_a_restart_inside_an_exchange_is_noticed_and_the_odometer_does_not_jump(wanted: DriveAction):
    """The supply fails for a moment before an answer; the position begins at 0 again."""

    async def test(rig: Rig) -> None:
        async with rig.supervised():
            await rig.drive(3_000)
            await rig.settle(2.0)
            position = rig.newest.position
            rig.emulator.inject("restart", "1")
            if wanted is not DriveAction.RUN:
                rig.gate.say(wanted)
            await rig.settle(2.5)
            assert Reason.DEVICE_RESTARTED in [row.reason for row in rig.health]
            assert Reason.DEVICE_RESTARTED in rig.events.reasons()
            positions = [feedback.position for feedback in rig.out.kept]
            assert min(b - a for a, b in itertools.pairwise(positions)) > -1.0
            assert rig.newest.position > position - 1.0

    on_bench(test)


GAP = 0.05 + 0.15
"""Seconds between two messages around one damaged byte: the usual 50 ms and at most 150 ms more; the gate's limit is
200 ms."""


@pytest.mark.parametrize("damage", ["acknowledge", "length", "flip", "stray"])
def test_one_damaged_byte_costs_at_most_150_ms(damage: str):
    """The host shortens the controller's own time-out for half frames (object 0x2005)."""

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            await rig.settle(1.0)
            for _ in range(10):
                await rig.settle(0.3 + 0.013)
                began = len(rig.out.kept) - 1
                rig.emulator.inject(damage, "1")
                await rig.settle(0.5)
                times = [feedback.stamp for feedback in rig.out.kept[began:]]
                assert max(b - a for a, b in itertools.pairwise(times)) < GAP * SECOND
        assert len(rig.ready_at) == 1

    on_bench(test)


def strike(device: DeviceEnd, way: str, nth: int, change: Callable[[int], bytes]) -> None:
    """Change the nth byte from now on of one direction."""
    passed, count = getattr(device, way), itertools.count()

    def passing(data: bytes) -> None:
        if out := b"".join(change(byte) if next(count) == nth else bytes((byte,)) for byte in data):
            passed(out)

    setattr(device, way, passing)


@pytest.mark.parametrize("way", ["_emit", "_accept"], ids=["to the host", "to the controller"])
@pytest.mark.parametrize(
    "change",
    [lambda _: b"", lambda byte: bytes((byte ^ 0x80,)), lambda byte: bytes((0x55, byte))],
    ids=["lost", "flipped", "stray"],
)
def test_any_byte_may_be_lost_or_flipped_or_strange_for_at_most_150_ms(way: str, change: Callable[[int], bytes]):
    async def test(rig: Rig, nth: int) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            await rig.settle(1.313)
            began = len(rig.out.kept) - 1
            strike(rig.port.device, way, nth, change)
            await rig.settle(1.0)
            times = [feedback.stamp for feedback in rig.out.kept[began:]]
            assert max(b - a for a, b in itertools.pairwise(times)) < GAP * SECOND, nth
        assert len(rig.ready_at) == 1

    for nth in range(30):
        on_bench(partial(test, nth=nth))


def test_a_slow_link_is_named_once_and_again_when_it_is_quick():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(3_000)
            assert Reason.SLOW_LINK not in rig.events.reasons()
            rig.emulator.inject("delay", "30")
            await rig.settle(5.0)
            named = [event for event in rig.events.kept if event[0] is Reason.SLOW_LINK]
            assert len(named) == 1
            assert named[0][1] is Severity.WARNING
            assert 0.035 < named[0][3]["seconds"] < 0.05
            rig.emulator.inject("delay", "0")
            await rig.settle(5.0)
            named = [event for event in rig.events.kept if event[0] is Reason.SLOW_LINK]
            assert [event[1] for event in named] == [Severity.WARNING, Severity.INFO]

    on_bench(test)
