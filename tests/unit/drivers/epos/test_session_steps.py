"""Single steps of a drive session at their limits, against a controller that answers at once."""

import asyncio
import contextlib
import math
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import RAD_S_PER_RPM, EposDriver, Setpoint, _DriveSession
from monstertruck_drivers.epos.exchange import ObjectError
from monstertruck_drivers.epos.objects import ObjectEntry
from monstertruck_drivers.epos.protocol import FAULTED, OFF, POWERED, Control, State
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceStoppedError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode
from tests.unit.drivers.kit import Events, Kept

MS = SECOND // 1000
REACTING = (State.FAULT_REACTION_DISABLED, State.FAULT_REACTION_ENABLED)


class HandClock:
    """Time that a test sets, to the nanosecond."""

    def __init__(self) -> None:
        self.time = SECOND

    def now(self) -> int:
        return self.time

    def deadline(self, _seconds: float) -> contextlib.AbstractAsyncContextManager[None]:
        return contextlib.nullcontext()


class Controller:
    """Objects that are read and written; an exchange takes ``takes`` ns."""

    def __init__(self, clock: HandClock) -> None:
        self.values: dict[ObjectEntry, int] = {}
        self.written: list[tuple[ObjectEntry, int]] = []
        self.asked: list[ObjectEntry] = []
        self.refusals: dict[ObjectEntry, Exception] = {}
        """Errors of writes."""
        self.takes = 0
        self.began = self.ended = 0
        self.strange = b""
        self.acknowledged = False
        self.durations: Sequence[int] = ()
        self._clock = clock

    async def read(self, entry: ObjectEntry, _attempts: int = 1) -> int:
        self.asked.append(entry)
        self._clock.time += self.takes
        return self.values.get(entry, 0)

    async def write(self, entry: ObjectEntry, value: int, _attempts: int = 1) -> None:
        self.written.append((entry, value))
        if entry in self.refusals:
            raise self.refusals[entry]

    async def finish(self) -> None:
        """No exchange is under way."""

    async def settle(self) -> None:
        """The line is quiet."""

    async def read_row(self, entries: Sequence[ObjectEntry], take: Callable[[int], bool]) -> None:
        for entry in entries:
            if not take(await self.read(entry)):
                return

    @property
    def controls(self) -> list[int]:
        return [value for entry, value in self.written if entry is od.CONTROLWORD]


class Steps:
    """A session in some state, and the controller it talks to."""

    def __init__(self, config: EposConfig) -> None:
        self.clock = clock = HandClock()
        self.line = Controller(clock)
        self.commands: Mailbox[DriveCommand] = Mailbox(latest())
        self.out: Kept[DriveFeedback] = Kept()
        self.events = Events()
        port = MemoryPort("/dev/test")
        self.driver = EposDriver(config, port, clock, self.commands, self.out, self.events)  # type: ignore[arg-type]
        self.session = _DriveSession(self.driver, self.line)  # type: ignore[arg-type]
        self.session._prepared = True
        self.session._sent_rpm = 0

    def say(self, action: DriveAction, rpm: float = 0.0, stamp: int | None = None) -> None:
        now = self.clock.now() if stamp is None else stamp
        rate = rpm * RAD_S_PER_RPM
        self.commands.put(DriveCommand(stamp=now, received=now, seq=0, action=action, speed=0.0, motor_velocity=rate))


def steps(test: Callable[[Steps], Coroutine[Any, Any, None]], *, inverted: bool = False) -> None:
    """Run ``test`` with a session that began a second after the clock."""
    asyncio.run(test(Steps(EposConfig(inverted=inverted))))


# The beginning


@pytest.mark.parametrize(
    ("answer", "raised"),
    [
        (ObjectError("controlword", od.WRONG_STATE), None),
        (ObjectError("controlword", od.WRONG_NODE), DeviceMismatchError),
        (ObjectError("controlword", 0x06020000), WrongDeviceError),
        (DeviceTimeoutError("silence"), DeviceTimeoutError),
        (ProtocolError("rubbish"), ProtocolError),
    ],
)
def test_what_the_first_quick_stop_meets_says_what_is_there(answer: Exception, raised: type[Exception] | None):
    async def test(rig: Steps) -> None:
        rig.line.refusals[od.CONTROLWORD] = answer
        with pytest.raises(raised) if raised else contextlib.nullcontext():
            await rig.session._stop_first()
        assert rig.line.controls == [Control.QUICK_STOP]

    steps(test)


@pytest.mark.parametrize("error", [DeviceTimeoutError("silence"), ProtocolError("rubbish")])
@pytest.mark.parametrize(("strange", "acknowledged"), [(b"", False), (b"AT", True), (b"AT", False)])
def test_strange_bytes_without_an_acknowledge_are_another_device(error: Exception, strange: bytes, acknowledged: bool):
    async def test(rig: Steps) -> None:
        rig.line.refusals[od.CONTROLWORD] = error
        rig.line.strange, rig.line.acknowledged = strange, acknowledged
        other = bool(strange) and not acknowledged
        with pytest.raises(WrongDeviceError if other else type(error)):
            await rig.session._stop_first()

    steps(test)


@pytest.mark.parametrize(("code", "raises"), [(od.WRONG_STATE, False), (0x08000000, True)])
def test_a_controlword_may_come_in_the_wrong_state_and_no_other_error_is_passed_over(code: int, raises: bool):
    async def test(rig: Steps) -> None:
        rig.line.refusals[od.CONTROLWORD] = ObjectError("controlword", code)
        with pytest.raises(ObjectError) if raises else contextlib.nullcontext():
            await rig.session._control(Control.ENABLE)

    steps(test)


@pytest.mark.parametrize(
    ("mark", "state", "action", "raises"),
    [
        (None, State.ENABLED, DriveAction.RUN, False),
        (7, State.SWITCH_ON_DISABLED, DriveAction.DISABLE, False),
        (7, State.SWITCH_ON_DISABLED, DriveAction.RUN, True),
        (7, State.ENABLED, DriveAction.DISABLE, True),
    ],
)
def test_a_controller_without_its_mark_restarted_which_ends_a_session_that_uses_it(
    mark: int | None, state: State, action: DriveAction, raises: bool
):
    async def test(rig: Steps) -> None:
        rig.driver.mark, rig.session._reported = mark, state
        rig.driver.odometer.update(5, rig.clock.now(), 1e6)
        rig.line.values[od.MARK] = 3
        rig.say(action)
        with pytest.raises(DeviceRestartedError) if raises else contextlib.nullcontext():
            await rig.session._check_mark()
        assert rig.line.written == [(od.MARK, 4)]
        assert rig.driver.mark == 4
        assert rig.events.reasons() == [Reason.DEVICE_RESTARTED] * (mark is not None)
        continued = rig.driver.odometer.update(9, rig.clock.now() + SECOND, 1e6)
        assert continued == (4 if mark is None else 0)

    steps(test)


def test_a_mark_that_is_still_there_and_a_controller_that_takes_none_are_no_restart():
    async def test(rig: Steps) -> None:
        rig.driver.mark = rig.line.values[od.MARK] = 3
        await rig.session._check_mark()
        assert rig.line.written == []
        rig.line.values[od.MARK] = 9
        rig.line.refusals[od.MARK] = ObjectError("mark", 0x06020000)
        await rig.session._check_mark()
        assert rig.driver.mark == 3
        assert rig.events.kept == []

    steps(test)


# Faults


@pytest.mark.parametrize(
    ("early", "state", "resets"), [(0, State.FAULT, 1), (1, State.FAULT, 0), *((0, s, 0) for s in REACTING)]
)
def test_a_fault_is_reset_after_its_pause_once_the_controller_has_reacted(early: int, state: State, resets: int):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = state
        await session._attend_fault()
        assert session._fault == 0
        assert rig.line.written == []
        rig.clock.time += 300 * MS - early
        await session._attend_fault()
        assert rig.line.controls == [Control.DISABLE_VOLTAGE, Control.FAULT_RESET] * resets

    steps(test)


@pytest.mark.parametrize(("age", "gives_up"), [(10 * SECOND - 1, True), (10 * SECOND, False)])
def test_resets_count_within_their_window(age: int, gives_up: bool):
    async def test(rig: Steps) -> None:
        rig.clock.time = 20 * SECOND
        now = rig.clock.now()
        rig.driver.resets = [now - age, now - 2, now - 1]
        if gives_up:
            with pytest.raises(DeviceFaultError, match="after 3 resets"):
                await rig.session._reset_fault(now, 0x8611)
            assert rig.line.written == []
        else:
            await rig.session._reset_fault(now, 0x8611)
            assert rig.driver.resets == [now - 2, now - 1, now]

    steps(test)


@pytest.mark.parametrize("kept", [0, 1, od.HISTORY_SIZE, od.HISTORY_SIZE + 1])
def test_the_history_of_faults_has_as_many_entries_as_the_controller_says_and_can_keep(kept: int):
    async def test(rig: Steps) -> None:
        rig.line.values = {od.ERROR_COUNT: kept, **{e: 0xAB_8000 + i for i, e in enumerate(od.ERROR_HISTORY)}}
        assert await rig.session._history() == [0x8000 + i for i in range(min(kept, od.HISTORY_SIZE))]

    steps(test)


def test_a_fault_that_is_gone_makes_older_commands_void_and_is_reported_when_it_comes_again():
    async def test(rig: Steps) -> None:
        session = rig.session
        rig.line.values = {od.STATUSWORD: State.FAULT.value, od.ERROR_COUNT: 1, od.ERROR_HISTORY[0]: 0x8611}
        rig.say(DriveAction.RUN, 100)
        await session._look()
        assert rig.driver.reported_fault == 0x8611
        rig.clock.time += 1
        rig.line.values[od.STATUSWORD] = State.SWITCH_ON_DISABLED.value
        await session._look()
        assert (session._fault, rig.driver.reported_fault) == (None, None)
        assert session._setpoint().goal is State.SWITCH_ON_DISABLED
        rig.say(DriveAction.RUN, 100)
        assert session._setpoint().goal is State.ENABLED
        rig.line.values[od.STATUSWORD] = State.FAULT.value
        await session._look()
        assert rig.events.reasons() == [Reason.DRIVE_FAULT, Reason.DEVICE_READY, Reason.DRIVE_FAULT]

    steps(test)


# Commands


@pytest.mark.parametrize(("early", "goal"), [(0, State.ENABLED), (1, State.SWITCH_ON_DISABLED)])
def test_a_command_counts_from_the_instant_the_session_began(early: int, goal: State):
    async def test(rig: Steps) -> None:
        rig.say(DriveAction.RUN, 100, rig.clock.now() - early)
        assert rig.session._setpoint().goal is goal

    steps(test)


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("rpm", [60, -60, 61, -61])
def test_only_a_motor_that_turns_under_power_is_braked_before_it_is_switched_off(state: State, rpm: int):
    async def test(rig: Steps) -> None:
        rig.session._state, rig.session._rpm = state, rpm
        moves = state in POWERED and abs(rpm) > 60
        assert rig.session._setpoint().goal is (State.QUICK_STOP if moves else State.SWITCH_ON_DISABLED)

    steps(test)


@pytest.mark.parametrize("state", State)
def test_a_quick_stop_is_sent_once_each_time_it_is_wanted(state: State):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state, session._sent_rpm = state, 0
        for count in (1, 2):
            rig.say(DriveAction.QUICK_STOP)
            assert session._is_urgent()
            await session._act()
            assert not session._is_urgent()
            await session._act()
            assert rig.line.controls == [Control.QUICK_STOP] * count
            assert session._state is (State.QUICK_STOP if state in POWERED else state)
            rig.say(DriveAction.RUN)
            await session._act()

    steps(test)


@pytest.mark.parametrize(("rpm", "urgent"), [(899, True), (900, False), (901, False), (-900, True)])
def test_a_slower_target_is_urgent_and_no_other(rpm: int, urgent: bool):
    async def test(rig: Steps) -> None:
        rig.session._state, rig.session._sent_rpm = State.ENABLED, 900
        rig.say(DriveAction.RUN, rpm)
        assert rig.session._is_urgent() is urgent

    steps(test)


def test_a_faster_target_waits_for_its_turn_and_a_slower_one_does_not():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state, session._sent_rpm = State.ENABLED, 1000
        for rpm, also_faster, sent in (
            (2000, False, 1000),
            (2000, True, 2000),
            (1500, False, 1500),
            (1500, True, 1500),
        ):
            rig.say(DriveAction.RUN, rpm)
            await session._act(also_faster=also_faster)
            assert session._sent_rpm == sent
        assert rig.line.written == [(od.TARGET_VELOCITY, 2000), (od.TARGET_VELOCITY, 1500)]

    steps(test)


def test_a_target_is_that_of_a_controller_that_is_enabled():
    async def test(rig: Steps) -> None:
        rig.say(DriveAction.RUN, 700)
        for state in State:
            rig.session._state = state
            assert rig.session._target(rig.session._setpoint()) == (700 if state is State.ENABLED else 0)

    steps(test)


# The schedule


@pytest.mark.parametrize(("due", "early", "read"), [("_status_due", 0, True), ("_status_due", 1, False)])
def test_a_settled_controller_is_looked_at_when_it_is_due(due: str, early: int, read: bool):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = session._reported = State.SWITCH_ON_DISABLED
        rig.line.values[od.STATUSWORD] = State.FAULT_REACTION_DISABLED.value
        setattr(session, due, rig.clock.now() + early)
        session._current_due = rig.clock.now() + SECOND
        await session._cycle()
        assert (session._state in FAULTED) is read
        assert session._status_due == rig.clock.now() + (SECOND // 10 if read else early)

    steps(test)


@pytest.mark.parametrize(("early", "current"), [(0, 0.25), (1, None)])
def test_the_current_is_read_when_it_is_due_and_published_once(early: int, current: float | None):
    async def test(rig: Steps) -> None:
        session, now = rig.session, rig.clock.now()
        session._state = session._reported = State.SWITCH_ON_DISABLED
        session._status_due, session._current_due = now + 1, now + early
        rig.line.values[od.CURRENT] = 250
        await session._cycle()
        assert session._current == current
        assert session._current_due == now + (SECOND // 5 if current else early)
        await session._cycle()
        await session._cycle()
        assert [sample.current for sample in rig.out.kept] == [None, current, None]

    steps(test)


def test_a_controller_that_is_not_settled_is_looked_at_in_every_cycle():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = session._reported = State.SWITCH_ON_DISABLED
        rig.line.values[od.STATUSWORD] = State.SWITCH_ON_DISABLED.value
        session._status_due = session._current_due = rig.clock.now() + SECOND
        rig.say(DriveAction.RUN, 100)
        await session._cycle()
        assert rig.line.controls == [Control.SHUTDOWN]

    steps(test)


def test_feedback_is_of_the_middle_of_its_exchange():
    async def test(rig: Steps) -> None:
        rig.line.began, rig.line.ended = SECOND - 40 * MS, SECOND - 20 * MS
        rig.line.values |= {od.VELOCITY_AVERAGED: -60, od.POSITION: 7, od.STATUSWORD: State.ENABLED.value}
        await rig.session._cycle()
        (sample,) = rig.out.kept
        assert (sample.stamp, sample.received) == (SECOND - 30 * MS, SECOND)
        assert sample.velocity == pytest.approx(60 * RAD_S_PER_RPM)

    steps(test, inverted=True)


def test_the_current_has_the_robots_sign():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = session._reported = State.SWITCH_ON_DISABLED
        session._status_due = SECOND + 1
        rig.line.values[od.CURRENT] = 500
        await session._cycle()
        assert session._current == -0.5

    steps(test, inverted=True)


def test_after_a_failed_exchange_the_controller_is_asked_for_its_mark_once_and_prepared_anew():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = session._reported = State.ENABLED
        session._doubtful = True
        session._status_due = session._current_due = rig.clock.now() + SECOND
        rig.driver.mark = rig.line.values[od.MARK] = 3
        rig.say(DriveAction.RUN, 900)
        await session._cycle()
        assert rig.line.asked.count(od.MARK) == 1
        assert not session._prepared
        assert rig.line.written == [], "not faster before it is known"
        await session._cycle()
        assert rig.line.asked.count(od.MARK) == 1
        assert rig.line.written == [(od.TARGET_VELOCITY, 900)]

    steps(test)


def test_a_target_whose_write_fails_is_sent_again():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state, session._sent_rpm = State.ENABLED, 900
        rig.say(DriveAction.RUN, 100)
        rig.line.refusals[od.TARGET_VELOCITY] = DeviceTimeoutError("silence")
        with pytest.raises(DeviceTimeoutError):
            await session._act()
        rig.line.refusals.clear()
        await session._act()
        await session._act()
        assert rig.line.written == [(od.TARGET_VELOCITY, 100)] * 2

    steps(test)


# Power states


def test_mode_limits_and_ramps_are_written_once_with_no_target():
    config = EposConfig()

    async def test(rig: Steps) -> None:
        session = rig.session
        session._prepared, session._sent_rpm = False, 900
        rig.line.values[od.MODE_DISPLAY] = od.PROFILE_VELOCITY
        await session._prepare()
        await session._prepare()
        assert session._sent_rpm == 0
        assert rig.line.written == [
            (od.MODE, 3),
            (od.TARGET_VELOCITY, 0),
            (od.MAX_VELOCITY, config.max_motor_rpm),
            (od.ACCELERATION, config.acceleration_rpm_s),
            (od.DECELERATION, config.deceleration_rpm_s),
            (od.QUICK_STOP_DECELERATION, config.quick_stop_deceleration_rpm_s),
        ]

    steps(test)


def test_a_controller_that_does_not_take_the_mode_is_not_driven():
    async def test(rig: Steps) -> None:
        rig.session._prepared = False
        rig.line.values[od.MODE_DISPLAY] = 1
        with pytest.raises(ProtocolError, match="mode 1 instead of 3"):
            await rig.session._prepare()
        assert rig.line.written == [(od.MODE, 3)]

    steps(test)


@pytest.mark.parametrize("state", State)
def test_a_controller_is_prepared_on_its_way_from_off_to_running(state: State):
    async def test(rig: Steps) -> None:
        rig.session._state, rig.session._prepared = state, False
        rig.line.values[od.MODE_DISPLAY] = od.PROFILE_VELOCITY
        await rig.session._step(State.ENABLED)
        assert rig.session._prepared is (state is State.SWITCH_ON_DISABLED)

    steps(test)


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("off", sorted(OFF, key=lambda state: state.name))
def test_power_that_goes_off_by_itself_is_a_restart(asked: bool, off: State):
    async def test(rig: Steps) -> None:
        session = rig.session
        rig.driver.mark = 0
        session._reported = State.ENABLED
        session._control_sent = Control.DISABLE_VOLTAGE if asked else Control.ENABLE
        rig.line.values[od.STATUSWORD] = off.value
        if asked:
            await session._look()
        else:
            with pytest.raises(DeviceRestartedError):
                await session._look()
        assert not session._prepared

    steps(test)


@pytest.mark.parametrize(
    ("control", "before", "rpm", "raises"),
    [
        (Control.ENABLE, State.ENABLED, 500, True),
        (Control.ENABLE, State.ENABLED, 0, False),
        (Control.QUICK_STOP, State.ENABLED, 500, False),
        (Control.ENABLE, State.QUICK_STOP, 500, False),
    ],
    ids=["while it was to turn", "at rest", "by this program", "still"],
)
def test_a_quick_stop_by_another_ends_the_session(
    control: Control, before: State, rpm: int, raises: bool, monkeypatch: pytest.MonkeyPatch
):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._reported, session._control_sent = before, control
        monkeypatch.setattr(session, "_setpoint", lambda: Setpoint(State.ENABLED, rpm))
        rig.line.values[od.STATUSWORD] = State.QUICK_STOP.value
        with pytest.raises(DeviceStoppedError) if raises else contextlib.nullcontext():
            await session._look()
        assert rig.events.reasons() == [Reason.DEVICE_STOPPED] * raises

    steps(test)


def test_a_controller_that_stays_off_is_not_asked_for_its_mark_again():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._reported = State.SWITCH_ON_DISABLED
        rig.line.values[od.STATUSWORD] = State.SWITCH_ON_DISABLED.value
        await session._look()
        assert session._prepared
        assert rig.line.written == []

    steps(test)


@pytest.mark.parametrize(("late", "reported"), [(0, False), (1, True)])
def test_a_goal_may_take_its_time_and_no_longer(late: int, reported: bool):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = State.MEASURE_INIT
        await session._step(State.ENABLED)
        rig.clock.time += 2 * SECOND + late
        await session._step(State.ENABLED)
        await session._step(State.ENABLED)
        assert rig.events.reasons() == [Reason.DEVICE_TIMEOUT] * reported
        await session._step(State.QUICK_STOP)
        rig.clock.time += 2 * SECOND + 1
        await session._step(State.QUICK_STOP)
        assert rig.events.reasons() == [Reason.DEVICE_TIMEOUT] * (reported + 1), "each goal has its own time"

    steps(test)


def test_the_time_of_a_goal_begins_when_a_fault_is_gone():
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state = State.FAULT
        for _ in range(2):
            await session._step(State.ENABLED)
            rig.clock.time += 2 * SECOND + 1
        session._state = State.SWITCHED_ON
        rig.clock.time -= 1
        await session._step(State.ENABLED)
        assert rig.events.reasons() == []

    steps(test)


@pytest.mark.parametrize(
    ("late", "rpm", "control"),
    [
        (0, 0, Control.ENABLE),
        (1, 60, Control.DISABLE_VOLTAGE),
        (1, -60, Control.DISABLE_VOLTAGE),
        (1, 61, Control.ENABLE),
        (1, -61, Control.ENABLE),
    ],
)
def test_a_quick_stop_is_left_through_power_off_once_late_and_at_rest(late: int, rpm: int, control: Control):
    async def test(rig: Steps) -> None:
        session = rig.session
        session._state, session._rpm = State.QUICK_STOP, rpm
        await session._step(State.ENABLED)
        rig.clock.time += 300 * MS + late
        await session._step(State.ENABLED)
        assert rig.line.controls == [Control.ENABLE, control]

    steps(test)


# The end


@pytest.mark.parametrize(("rpm", "rests"), [(60, True), (-60, True), (61, False), (-61, False)])
def test_power_goes_off_at_rest_or_at_the_end_of_the_time(rpm: int, rests: bool):
    async def test(rig: Steps) -> None:
        began = rig.clock.now()
        rig.line.values[od.VELOCITY] = rpm
        rig.line.takes = 10 * MS
        await rig.session.make_safe()
        *stops, last = rig.line.controls
        assert set(stops) == {Control.QUICK_STOP}
        assert last is Control.DISABLE_VOLTAGE
        spent = (rig.clock.now() - began) / SECOND
        if rests:
            assert (len(stops), spent) == (1, pytest.approx(0.01))
        else:
            assert spent == pytest.approx(0.225 + 0.075 - 0.04, abs=0.011)

    steps(test)


@pytest.mark.parametrize(("counts", "moved"), [(900_001, True), (900_002, False), (-900_001, True), (-900_002, False)])
def test_a_position_moves_no_faster_than_half_as_fast_again_as_the_motor_can(counts: int, moved: bool):
    async def test(rig: Steps) -> None:
        rig.session._counts_per_turn = 2000
        rig.session._publish(0, rig.clock.now())
        rig.session._publish(counts, rig.clock.now() + SECOND)
        turns = rig.out.kept[-1].position / (2 * math.pi)
        assert turns == pytest.approx(counts / 2000 if moved else 0.0)

    steps(test)


def test_feedback_names_the_power_state():
    async def test(rig: Steps) -> None:
        for state in State:
            rig.session._state = state
            rig.session._publish(0, rig.clock.now())
        modes = dict(zip(State, (sample.mode for sample in rig.out.kept), strict=True))
        assert {state for state, mode in modes.items() if mode is DriveMode.FAULT} == FAULTED
        assert {state for state, mode in modes.items() if mode is DriveMode.DISABLED} == OFF
        assert modes[State.ENABLED] is DriveMode.ENABLED
        assert modes[State.QUICK_STOP] is DriveMode.QUICK_STOP
        assert modes[State.READY] is DriveMode.STARTING

    steps(test)
