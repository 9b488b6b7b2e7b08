"""One drive to a goal or along a path, as a client of the robot: from the request to how it ended."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from typing import Any, Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.presence import while_it_runs
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.standstill import StandstillMonitor, monitor_standstill
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import GoalPhase, GoalState, Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import EVENT, GOAL, PATH, TRACKER

LOOK: Final = 0.5
"""Half the period of reports why the truck stands, s."""
PLANNER_START: Final = 240.0
"""Seconds that a planner may take to start."""
ACCEPT_TIMEOUT: Final = 3.0
"""Seconds in which a path is accepted or refused."""
STAND_TIMEOUT: Final = 2.0
"""Seconds that a path waits for a truck that is still moving: one that has just reached its goal comes to rest."""


class DriveReport:
    """What is said of a drive while it lasts; this one says nothing."""

    def waiting(self, text: str, share: float) -> None:
        """The planner is starting; ``share`` of the time allowed has passed."""

    def under_way(self, what: str, share: float) -> None:
        """Driven so far, 0..1."""

    def stands(self, gate: GateState, why: str) -> None:
        """The truck stands, for a reason that was not said since it does; ``why`` words all of them."""


SILENT: Final = DriveReport()


@dataclass(frozen=True, slots=True)
class Arrival:
    """How a drive ended."""

    reason: Reason
    text: str
    length: float
    """Metres of the first route, or of the path."""
    elapsed: float
    """Seconds."""
    routes: int = 1
    recoveries: int = 0

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)


async def drive_to(
    driver: TruckClient,
    clock: Clock,
    goal: tuple[float, float, float],
    via: Sequence[tuple[float, ...]] = (),
    *,
    arm: bool,
    report: DriveReport = SILENT,
) -> Arrival:
    """Send a goal and wait for its end; cancelled or without an answer, it cancels the goal, but nobody else's.

    Raises:
        RequestRefusedError: the goal or the arming was refused, the goal service failed, or the robot restarted.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    with driver.subscribe(GOAL, fifo(256)) as states, monitor_standstill(driver) as stand:

        async def cancel() -> None:
            await driver.goal_control(GoalOrder.CANCEL, own=True)

        async with taken_back(cancel):
            number = await _taken_on(driver, clock, goal, via, report)
        end = _goal_end(states, number, report)
        return await _watched(driver, clock, stand, ServiceName.GOALS, arm=arm, end=end, undo=cancel, report=report)


async def _taken_on(
    driver: TruckClient,
    clock: Clock,
    goal: tuple[float, float, float],
    via: Sequence[tuple[float, ...]],
    report: DriveReport,
) -> int:
    """Number of the goal; while the planner is starting it is sent again and again.

    Raises:
        RequestRefusedError: for another reason, or the planner takes longer than ``PLANNER_START``.
        NoAnswerError: the robot does not answer.
    """
    began = clock.now()
    while True:
        try:
            return int((await driver.goal(goal, via=via))["number"])
        except RequestRefusedError as refused:
            waited = (clock.now() - began) / SECOND
            if refused.refusal is not Reason.PLANNER_STARTING or waited > PLANNER_START:
                raise
            report.waiting(str(refused), waited / PLANNER_START)
        await clock.sleep(LOOK)


@asynccontextmanager
async def taken_back(undo: Callable[[], Awaitable[object]]) -> AsyncIterator[None]:
    """``undo`` a request inside that is cancelled or not answered: the robot may carry it out all the same."""
    try:
        yield
    except (asyncio.CancelledError, NoAnswerError):
        with suppress(TruckError):
            await undo()
        raise


async def _goal_end(states: Mailbox[GoalState], number: int, report: DriveReport) -> Arrival:
    length = 0.0
    async for state in states:
        if state.number > number:
            return Arrival(Reason.CANCELLED, f"{state.source} sent another goal", length, 0.0)
        if state.number < number:
            continue
        if state.phase is GoalPhase.IDLE:
            return Arrival(state.outcome, state.text, length, state.elapsed, state.routes, state.recoveries)
        length = length or state.remaining
        if length:
            report.under_way("to the goal", max(1.0 - state.remaining / length, 0.0))
    raise NoAnswerError("the link to the robot was closed")


async def follow(driver: TruckClient, clock: Clock, path: Path, *, arm: bool, report: DriveReport = SILENT) -> Arrival:
    """Send a path and wait for its end; cancelled or without an answer, it stops the truck, but not on another path.

    Then the path is withdrawn: whoever arms the truck later does not have it driven.

    Raises:
        RequestRefusedError: the path or the arming was refused, the tracker failed, or the robot restarted.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    path = named(path, clock)
    with (
        driver.subscribe(TRACKER, fifo(256)) as states,
        monitor_standstill(driver) as stand,
        driver.subscribe(PATH, latest()) as present,
    ):
        with suppress(TimeoutError):
            async with clock.deadline(STAND_TIMEOUT):
                while (await stand.gate.next()).mode.moving:
                    pass
        async with taken_back(driver.stop):
            await send_path(driver, clock, path, present)

        async def stop() -> None:
            if _followed(present, path.name):
                await driver.stop()

        end = _path_end(clock, states, present, path.name, report)
        try:
            return await _watched(driver, clock, stand, ServiceName.TRACKER, arm=arm, end=end, undo=stop, report=report)
        finally:
            if _followed(present, path.name):
                with suppress(TruckError):
                    await driver.path(path.model_copy(update={"halts": True}))


async def drive_configured(
    driver: TruckClient, clock: Clock, name: str, *, arm: bool, report: DriveReport = SILENT
) -> Arrival:
    """Start the path of the robot's configuration and wait for its end; cancelled or without an answer, stop the robot.

    Raises:
        RequestRefusedError: the start or the arming was refused, the tracker failed, or the robot restarted.
        NotFoundError: the configuration has no path of this name.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    with (
        driver.subscribe(TRACKER, fifo(256)) as states,
        monitor_standstill(driver) as stand,
        driver.subscribe(PATH, latest()) as present,
    ):

        async def start() -> dict[str, Any]:
            return {"path": await driver.start_path(name)}

        async with taken_back(driver.stop):
            followed = str((await begun(driver, start, driver.stop, arm=arm))["path"])
            await _until_followed(clock, present, followed)

        async def stop() -> None:
            if _followed(present, followed):
                await driver.stop()

        end = _first(_path_end(clock, states, present, followed, report), _disarmed(clock, stand))
        return await _watched(driver, clock, stand, ServiceName.TRACKER, arm=False, end=end, undo=stop, report=report)


async def begun(
    driver: Operator,
    start: Callable[[], Awaitable[dict[str, Any]]],
    undo: Callable[[], Awaitable[object]],
    *,
    arm: bool,
) -> dict[str, Any]:
    """Start a task; returns the robot's answer.

    The robot is armed only when nothing else is in the way, and held until the task has begun: a path that it has would
    be driven meanwhile. It is disarmed again if nothing comes of it.

    Args:
        driver: who starts it.
        start: asks the robot for it.
        undo: ends it.
        arm: arm a robot that is disarmed.

    Raises:
        RequestRefusedError: the start or the arming was refused.
        NoAnswerError: the robot does not answer.
    """
    try:
        return await start()
    except RequestRefusedError as refused:
        if not arm or refused.refusal is not Reason.DISARMED:
            raise
    try:
        await driver.arm(hold=True)
        answer = await start()
        try:
            await driver.arm()
        except RequestRefusedError:
            await undo()
            raise
    except BaseException:
        with suppress(TruckError):
            await driver.disarm()
        raise
    return answer


def named(path: Path, clock: Clock) -> Path:
    """The path under a name that no other one has."""
    return path.model_copy(update={"name": f"{path.name[:96]}-{clock.now():x}"})


async def send_path(driver: TruckClient, clock: Clock, path: Path, present: Mailbox[Path]) -> None:
    """Send a path and wait until it is followed.

    Args:
        driver: who sends it.
        clock: time.
        path: what is to be driven, with a name of its own.
        present: the newest path of the robot.

    Raises:
        RequestRefusedError: the path was refused.
        NoAnswerError: the robot does not answer.
    """
    with driver.subscribe(EVENT, fifo(256)) as events:
        await driver.path(path)
        await _accepted(driver, clock, events, present, path.name)


async def _accepted(
    driver: TruckClient, clock: Clock, events: Mailbox[Event], present: Mailbox[Path], name: str
) -> None:
    try:
        async with clock.deadline(ACCEPT_TIMEOUT):
            while not _followed(present, name):
                for event in events.drain():
                    if event.source == driver.source and event.severity is Severity.WARNING:
                        raise RequestRefusedError(event.reason, event.text)
                await clock.sleep(0.05)
    except TimeoutError:
        raise NoAnswerError(f"the robot did not accept the path within {ACCEPT_TIMEOUT:g} s") from None


async def _until_followed(clock: Clock, present: Mailbox[Path], name: str) -> None:
    try:
        async with clock.deadline(ACCEPT_TIMEOUT):
            while not _followed(present, name):
                await present.next()
    except TimeoutError:
        raise NoAnswerError(f"the path {name!r} did not come within {ACCEPT_TIMEOUT:g} s") from None


async def _disarmed(clock: Clock, stand: StandstillMonitor) -> Arrival:
    """The end of a path that is over once the robot is disarmed."""
    begin = clock.now()
    while (state := stand.gate.latest) is None or state.mode.active:
        await clock.sleep(LOOK)
    return Arrival(state.worst, f"disarmed on the way: {state.why}", 0.0, (clock.now() - begin) / SECOND)


async def _first(*ends: Coroutine[Any, Any, Arrival]) -> Arrival:
    """The end that comes first."""
    tasks = [asyncio.create_task(end) for end in ends]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return next(task for task in tasks if task in done).result()
    finally:
        for task in tasks:
            task.cancel()


def _followed(present: Mailbox[Path], name: str) -> bool:
    """Whether the path of this name is the newest one."""
    return present.latest is not None and present.latest.name == name


async def _path_end(
    clock: Clock, states: Mailbox[TrackerState], present: Mailbox[Path], name: str, report: DriveReport
) -> Arrival:
    begin, length = clock.now(), 0.0
    async for state in states:
        if not _followed(present, name):
            return Arrival(Reason.CANCELLED, "another path is followed now", length, (clock.now() - begin) / SECOND)
        if state.path != name:
            continue
        length = state.length
        report.under_way("along the path", state.along / state.length if state.length else 1.0)
        if state.outcome is not Reason.DRIVING:
            text = f"{state.along:.2f} of {state.length:.2f} m, {state.cross_track:+.3f} m off the path"
            return Arrival(state.outcome, text, state.length, (clock.now() - begin) / SECOND)
    raise NoAnswerError("the link to the robot was closed")


async def _watched(
    driver: TruckClient,
    clock: Clock,
    stand: StandstillMonitor,
    needs: ServiceName,
    *,
    arm: bool,
    end: Awaitable[Arrival],
    undo: Callable[[], Awaitable[object]],
    report: DriveReport,
) -> Arrival:
    """Wait for the end and report why the truck stands meanwhile; ``undo`` if cancelled or refused."""
    watching = asyncio.create_task(_say_why_it_stands(stand, clock, report))
    ending = asyncio.ensure_future(while_it_runs(driver, end, needs))
    try:
        if arm and not ((state := stand.gate.latest) is not None and state.mode.active):
            # A truck that is armed already may have set off.
            try:
                async with taken_back(driver.disarm):
                    await driver.arm()
            except RequestRefusedError as error:
                raise RequestRefusedError(error.refusal, f"arm refused: {error}") from None
        return await ending
    except TruckError:
        with suppress(TruckError):  # that it failed says more than that it cannot be taken back either
            await undo()
        raise
    except BaseException:
        try:
            await undo()
        except RequestRefusedError as refused:
            if refused.refusal is not Reason.NOT_FOUND:  # it has just ended by itself
                raise
        raise
    finally:
        watching.cancel()
        ending.cancel()


async def _say_why_it_stands(stand: StandstillMonitor, clock: Clock, report: DriveReport) -> None:
    said: set[str] = set()  # what is stale comes and goes while it stands
    while True:
        await clock.sleep(2 * LOOK)
        why, state = stand.why(), stand.gate.latest
        if not why or state is None:
            said.clear()
        elif new := set[str](state.reasons or (state.mode,)) - said:
            said |= new
            report.stands(state, why)
