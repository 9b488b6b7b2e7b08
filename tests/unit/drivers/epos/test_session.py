"""One session of the drive's driver at its limits: pauses, periods, what is sent and what is reported."""

from itertools import pairwise

import pytest

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import (
    QUICK_EXCHANGE,
    RAD_S_PER_RPM,
    SLOW_EXCHANGE,
    EposDriver,
    Odometer,
    _DriveSession,
    _slower,
    settled,
)
from monstertruck_drivers.epos.exchange import BRIEF_SILENCES, RECENT
from monstertruck_drivers.epos.protocol import OFF, Control, State, write_request
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveMode
from tests.unit.drivers.epos.rig import Rig, controls, on_bench

MS = SECOND // 1000


def seconds_between(instants: list[int]) -> list[float]:
    return [(later - before) / SECOND for before, later in pairwise(instants)]


def test_a_session_begins_with_a_quick_stop_and_no_target():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.settle(0.5)
        first = [frame for _, frame in rig.emulator.frames][:2]
        assert first == [write_request(od.CONTROLWORD, Control.QUICK_STOP, 1), write_request(od.TARGET_VELOCITY, 0, 1)]

    on_bench(test)


@pytest.mark.parametrize(
    ("rpm", "sent", "slower"),
    [
        (100, None, True),
        (0, 100, True),
        (99, 100, True),
        (100, 100, False),
        (101, 100, False),
        (-100, 100, True),
        (-101, 100, True),
        (100, -101, True),
        (-100, -100, False),
        (-101, -100, False),
        (100, 0, False),
        (0, 0, False),
    ],
)
def test_what_brakes_a_motor(rpm: int, sent: int | None, slower: bool):
    assert _slower(rpm, sent) is slower


@pytest.mark.parametrize("state", State)
def test_which_states_need_nothing_more_for_a_quick_stop(state: State):
    assert settled(state, State.QUICK_STOP) is (state is State.QUICK_STOP or state in OFF)
    assert settled(state, state)
    assert settled(state, State.ENABLED) is (state is State.ENABLED)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_that_no_motor_can_make_is_a_counter_that_was_reset(sign: int):
    odometer = Odometer()
    odometer.update(1000, 0, 1000.0)
    most = 1500 + 1  # half as fast again for a second, and a count
    assert odometer.update(1000 + sign * most, SECOND, 1000.0) == sign * most
    assert odometer.update(1000 + sign * (2 * most + 1), 2 * SECOND, 1000.0) == sign * most
    assert odometer.update(1000 + sign * (2 * most + 11), 3 * SECOND, 1000.0) == sign * (most + 10), "from there on"


@pytest.mark.parametrize(("first", "second", "step"), [(2**31 - 5, -(2**31) + 5, 10), (-(2**31), 2**31 - 1, -1)])
def test_the_position_wraps_at_32_bits(first: int, second: int, step: int):
    odometer = Odometer()
    assert odometer.counts == 0
    assert odometer.update(first, 0, 1e6) == 0
    assert odometer.update(second, SECOND, 1e6) == step


def test_a_controller_that_was_off_goes_on_where_it_was():
    odometer = Odometer()
    odometer.update(0, 0, 1e6)
    odometer.update(100, SECOND, 1e6)
    odometer.restart()
    assert odometer.update(5, 2 * SECOND, 1e6) == 100
    assert odometer.update(15, 3 * SECOND, 1e6) == 110


def test_resets_of_a_fault_keep_their_pause_and_are_limited_within_their_window():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "following")
        with pytest.raises(DeviceFaultError):
            await rig.session()
        resets = [at for at, value in rig.writes(od.CONTROLWORD) if value == Control.FAULT_RESET]
        assert len(resets) == 3
        assert all(0.3 <= pause < 0.5 for pause in seconds_between(resets))
        first_reported = next(at for at, value in rig.writes(od.CONTROLWORD) if value == Control.QUICK_STOP)
        assert resets[0] - first_reported >= 300 * MS, "the first one has its pause as well"
        assert [at for at in rig.driver.resets if at > 0] == rig.driver.resets
        assert len(rig.driver.resets) == 3
        with pytest.raises(DeviceFaultError):
            await rig.session()
        assert controls(rig).count(Control.FAULT_RESET) == 3, "those of the session before count"
        assert rig.events.reasons().count(Reason.DRIVE_FAULT) == 1

    on_bench(test)


def test_resets_longer_ago_than_their_window_do_not_count():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "following")
        now = rig.clock.now()
        rig.driver.resets = [now - 10 * SECOND, now - 9 * SECOND, now - 8 * SECOND]
        with pytest.raises(DeviceFaultError):
            await rig.session()
        assert 1 <= controls(rig).count(Control.FAULT_RESET) <= 3

    on_bench(test, EposConfig(fault_reset_window=10.0))


def test_no_reset_at_all_if_so_configured():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("fault", "following")
        with pytest.raises(DeviceFaultError, match="persists after 0 resets"):
            await rig.session()
        assert Control.FAULT_RESET not in controls(rig)

    on_bench(test, EposConfig(fault_resets=0))


def test_a_controller_that_does_not_follow_is_reported_once_after_two_seconds():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(0)
            began = rig.clock.now()
            rig.emulator.set_quick_stop_input(True)
            await rig.settle(0.5)
            rig.gate.say(DriveAction.RUN, 3_000)
            await rig.until(lambda: Reason.DEVICE_TIMEOUT in rig.events.reasons(), 4.0)
            assert 1.9 < (rig.clock.now() - began) / SECOND < 2.6
            await rig.settle(4.0)
            reported = [event for event in rig.events.kept if event[0] is Reason.DEVICE_TIMEOUT]
            assert len(reported) == 1
            assert reported[0][1] is Severity.WARNING
            assert reported[0][2].startswith("controller stays in ")
            assert reported[0][2].endswith(", expected ENABLED")

    on_bench(test)


def test_feedback_has_the_robots_sign_and_its_current_at_its_own_period():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.out.kept.clear()
            await rig.settle(2.0)
            kept = rig.out.kept
            assert all(sample.velocity == pytest.approx(6_000 * RAD_S_PER_RPM, rel=0.02) for sample in kept)
            turned = kept[-1].position - kept[0].position
            spent = (kept[-1].stamp - kept[0].stamp) / SECOND
            assert turned / spent == pytest.approx(6_000 * RAD_S_PER_RPM, rel=0.02)
            assert [later.seq - before.seq for before, later in pairwise(kept)] == [1] * (len(kept) - 1)
            with_current = [sample.received for sample in kept if sample.current is not None]
            assert all(0.15 <= pause <= 0.3 for pause in seconds_between(with_current))
            assert all(0 <= sample.received - sample.stamp < 40 * MS for sample in kept)
            assert {sample.mode for sample in kept} == {DriveMode.ENABLED}
            assert {sample.fault_code for sample in kept} == {None}

    on_bench(test)


def test_the_end_of_a_session_brakes_and_switches_off_within_its_time():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(12_000)
            ended = rig.clock.now()
            before = len(controls(rig))
        *stops, last = controls(rig)[before:]
        assert stops
        assert set(stops) == {Control.QUICK_STOP}
        assert last == Control.DISABLE_VOLTAGE
        assert rig.clock.now() - ended <= 300 * MS
        assert abs(rig.shaft_rpm) <= 60

    on_bench(test)


def test_running_again_after_a_quick_stop_needs_no_way_through_power_off():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.until(lambda: abs(rig.shaft_rpm) < 1)
            await rig.settle(1.0)
            before = len(controls(rig))
            await rig.drive(6_000)
            assert controls(rig)[before:] == [Control.ENABLE]

    on_bench(test)


def test_a_latched_quick_stop_is_left_through_power_off_once_it_has_not_helped_for_a_while():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("latch", "on")
        async with rig.driving():
            await rig.drive(6_000)
            rig.gate.say(DriveAction.QUICK_STOP)
            await rig.settle(1.0)
            asked = rig.clock.now()
            await rig.drive(6_000)
            off = [at for at, word in rig.writes(od.CONTROLWORD) if word == Control.DISABLE_VOLTAGE and at > asked]
            assert len(off) == 1
            assert 0.3 < (off[0] - asked) / SECOND < 0.6

    on_bench(test)


def test_so_many_failures_in_a_row_end_a_session_and_fewer_do_not():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.drive(3_000)
            for _ in range(2 * (BRIEF_SILENCES + 2)):
                rig.emulator.inject("delay", "600", "1")
                await rig.settle(2.5)
            assert rig.newest.mode is DriveMode.ENABLED
            assert rig.events.reasons().count(Reason.DEVICE_READY) == 1, "one session"

    on_bench(test)


@pytest.mark.parametrize("error", [DeviceTimeoutError("silence"), ProtocolError("rubbish")])
@pytest.mark.parametrize(("between", "ends"), [(99, True), (2, False)])
def test_four_failures_in_a_row_end_a_session(
    monkeypatch: pytest.MonkeyPatch, error: Exception, between: int, ends: bool
):
    cycle, cycles = _DriveSession._cycle, 0

    async def failing(session: _DriveSession) -> None:
        nonlocal cycles
        cycles += 1
        if cycles % (between + 1) == 0:
            await cycle(session)
        else:
            raise error

    monkeypatch.setattr(_DriveSession, "_cycle", failing)

    async def test(rig: Rig) -> None:
        if ends:
            with pytest.raises(type(error)):
                await rig.session()
            assert cycles == BRIEF_SILENCES + 2
        else:
            async with rig.driving():
                await rig.settle(1.0)
            assert cycles > 20

    on_bench(test)


class Line:
    """An exchanger that only knows how long its exchanges took."""

    def __init__(self, *milliseconds: float) -> None:
        self.durations = [round(each * MS) for each in milliseconds]


def judged(session: _DriveSession, *milliseconds: float) -> bool:
    session._line = Line(*milliseconds)  # type: ignore[assignment]
    session._judge_link()
    return session._slow


def test_a_link_is_slow_by_its_median_with_hysteresis():
    async def test(rig: Rig) -> None:
        session = _DriveSession(rig.driver, Line())  # type: ignore[arg-type]
        slow, quick = SLOW_EXCHANGE * 1000, QUICK_EXCHANGE * 1000
        assert not judged(session, *[100.0] * (RECENT - 1)), "too few"
        assert not judged(session, *[slow] * RECENT)
        upper = RECENT - RECENT // 2
        assert not judged(session, *[10.0] * (upper + 1), *[100.0] * (RECENT - upper - 1))
        assert judged(session, *[10.0] * (RECENT - upper), *[100.0] * upper)
        assert judged(session, *[quick + 0.1] * RECENT)
        assert judged(session, *[100.0] * RECENT)
        assert not judged(session, *[quick - 0.1] * RECENT)
        assert not judged(session, *[slow] * RECENT)
        reported = [(event[0], event[1]) for event in rig.events.kept]
        assert reported == [(Reason.SLOW_LINK, Severity.WARNING), (Reason.SLOW_LINK, Severity.INFO)]
        assert rig.events.kept[0][2].startswith("answers take 100 ms")
        assert rig.events.kept[0][3] == {"seconds": pytest.approx(0.1)}

    on_bench(test)


def test_a_driver_has_the_name_of_its_role():
    async def test(rig: Rig) -> None:
        assert rig.driver.name == "drive"
        other = EposDriver(EposConfig(), rig.port, rig.clock, rig.commands, rig.out, rig.events, "drive_2")
        assert other.name == "drive_2"

    on_bench(test)
