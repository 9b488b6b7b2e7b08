"""A task or a drive along a path, as a client of the robot: from the request to the outcome.

All clients use `run_task` for a goal, an exploration, a mission or a behaviour: it starts the task, arms the robot if
allowed, follows the reports, and stops the task when it is cancelled or the robot falls silent.
"""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from typing import Any, Final, Generic, TypeVar

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.presence import while_it_runs
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.standstill import StandstillMonitor, monitor_standstill
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import (
    BehaviourState,
    ExplorationState,
    GoalState,
    MissionState,
    Path,
    TrackerState,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import GoalOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import EVENT, GOAL, PATH, TRACKER, Topic

S = TypeVar("S", GoalState, ExplorationState, MissionState, BehaviourState)
E = TypeVar("E")

STAND_LOOK_PERIOD: Final = 0.5
"""Half the period of reports about why the truck stands, s."""
ACCEPT_TIMEOUT: Final = 3.0
"""Time limit for the acceptance of a path (s)."""


class DriveReport:
    """Receiver of progress reports of a drive; this base ignores them."""

    def waiting(self, text: str, share: float) -> None:
        """Report that the planner is starting; ``share`` of the allowed time has passed."""

    def under_way(self, what: str, share: float) -> None:
        """Report the fraction driven so far, 0..1."""

    def stands(self, gate: GateState, why: str) -> None:
        """Report a new reason why the truck stands; ``why`` contains all reasons in words."""


SILENT: Final = DriveReport()


@dataclass(frozen=True, slots=True)
class Arrival:
    """Outcome of a drive."""

    reason: Reason
    text: str
    length: float
    """Length of the first route, or of the path, m."""
    elapsed: float
    """Duration, s."""
    routes: int = 1
    recoveries: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return all values as plain data."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class TaskEnd(Generic[S]):
    """Outcome of a task."""

    reason: Reason
    text: str
    state: S | None
    """Latest report about the task."""


async def run_task(
    client: Operator,
    topic: Topic[S],
    needs: ServiceName,
    start: Callable[[], Awaitable[dict[str, Any]]],
    stop: Callable[[], Awaitable[object]],
    show: Callable[[S], object],
    *,
    arm: bool,
    waits: bool = False,
    report: DriveReport | None = None,
    clock: Clock | None = None,
    to_its_end: bool = False,
) -> TaskEnd[S]:
    """Start a task and wait for its end; stop it if cancelled or unanswered, unless another client started it.

    Args:
        client: client that starts it.
        topic: topic of its reports.
        needs: the service that runs the task.
        start: sends the request; the answer contains its ``number``.
        stop: stops the task, if this client started it.
        show: receives every report.
        arm: whether to arm a disarmed robot.
        waits: whether a disarmed robot accepts a task of this kind and waits until it is armed.
        report: receives the reason why the robot stands, by ``clock``.
        clock: source of time.
        to_its_end: when cancelled, wait until the robot has stopped the task, and return its result.

    Raises:
        RequestRefusedError: the start or the arming was refused, the service failed, or the robot restarted.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    with client.subscribe(topic, fifo(256)) as states, monitor_standstill(client) as stand:
        async with taken_back(stop):
            number = int((await begun(client, start, stop, arm=arm and not waits))["number"])
        async with reported(stand, clock, report):
            return await _watched(
                client, stand, needs, arm=arm and waits, end=lambda: _task_end(states, number, show), undo=stop,
                to_its_end=to_its_end,
            )  # fmt: skip


async def _task_end(states: Mailbox[S], number: int, show: Callable[[S], object]) -> TaskEnd[S]:
    last: S | None = None
    async for state in states:
        if state.number > number:
            return TaskEnd(Reason.CANCELLED, f"{state.source} started another task", last)
        if state.number == number:
            show(state)
            last = state
            if not state.running:
                return TaskEnd(state.outcome, state.text, state)
    raise NoAnswerError("the link to the robot was closed")


async def drive_to(
    driver: TruckClient,
    clock: Clock,
    goal: tuple[float, float, float],
    via: Sequence[tuple[float, ...]] = (),
    *,
    arm: bool,
    report: DriveReport = SILENT,
) -> Arrival:
    """Send a goal and wait for its end. Raises the errors of ``run_task``."""
    length = 0.0

    def show(state: GoalState) -> None:
        nonlocal length
        length = length or state.remaining
        if length and state.running:
            report.under_way("to the goal", max(1.0 - state.remaining / length, 0.0))

    end = await run_task(
        driver, GOAL, ServiceName.GOALS, lambda: _taken_on(driver, clock, goal, via, report),
        lambda: driver.goal_control(GoalOrder.CANCEL, own=True), show, arm=arm, waits=True,
        report=report, clock=clock,
    )  # fmt: skip
    state = end.state or GoalState(stamp=0, received=0, seq=0)
    return Arrival(end.reason, end.text, length, state.elapsed, state.routes, state.recoveries)


async def _taken_on(
    driver: TruckClient,
    clock: Clock,
    goal: tuple[float, float, float],
    via: Sequence[tuple[float, ...]],
    report: DriveReport,
) -> dict[str, Any]:
    """Return the answer to the goal; repeat the request while the planner is starting.

    Raises:
        RequestRefusedError: refused for another reason, or the planner needs more than 240 s.
        NoAnswerError: the robot does not answer.
    """
    began = clock.now()
    while True:
        try:
            return await driver.goal(goal, via=via)
        except RequestRefusedError as refused:
            waited = (clock.now() - began) / SECOND
            planner_start = 240.0  # maximum start time of a planner (s)
            if refused.refusal is not Reason.PLANNER_STARTING or waited > planner_start:
                raise
            report.waiting(str(refused), waited / planner_start)
        await clock.sleep(STAND_LOOK_PERIOD)


@asynccontextmanager
async def taken_back(undo: Callable[[], Awaitable[object]]) -> AsyncIterator[None]:
    """Context that calls ``undo`` if its request is cancelled or unanswered: the robot may still carry it out."""
    try:
        yield
    except (asyncio.CancelledError, NoAnswerError):
        with suppress(TruckError):
            await undo()
        raise


async def follow(
    driver: TruckClient,
    clock: Clock,
    path: Path,
    *,
    arm: bool,
    report: DriveReport = SILENT,
    disarmed_for: float = math.inf,
) -> Arrival:
    """Send a path and wait for its end; if cancelled or unanswered, stop the truck unless it follows another path.

    The path is then withdrawn, so that arming the truck later does not drive it.

    Args:
        driver: client that sends it.
        clock: source of time.
        path: path to drive.
        arm: whether to arm a disarmed robot.
        report: receives the progress.
        disarmed_for: time without arming after which the path is abandoned, s.

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
            # 2.0: seconds that a path waits for a truck that is still coming to rest
            async with clock.deadline(2.0):
                while (await stand.gate.next()).mode.moving:
                    pass
        async with taken_back(driver.stop):
            await send_path(driver, clock, path, present)

        async def stop() -> None:
            if _followed(present, path.name):
                await driver.stop()

        try:
            async with reported(stand, clock, report):
                return await _watched(
                    driver, stand, ServiceName.TRACKER, arm=arm, undo=stop,
                    end=lambda: _first(
                        _path_end(clock, states, present, path.name, report), _disarmed(clock, stand, disarmed_for)
                    ),
                )  # fmt: skip
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

        async with reported(stand, clock, report):
            return await _watched(
                driver, stand, ServiceName.TRACKER, arm=False, undo=stop,
                end=lambda: _first(_path_end(clock, states, present, followed, report), _disarmed(clock, stand)),
            )  # fmt: skip


async def begun(
    driver: Operator,
    start: Callable[[], Awaitable[dict[str, Any]]],
    undo: Callable[[], Awaitable[object]],
    *,
    arm: bool,
) -> dict[str, Any]:
    """Start a task; return the robot's answer.

    The robot is armed only if all other conditions are met, with planners held until the task has started, because it
    would otherwise drive a configured path. If the start fails, it is disarmed again.

    Args:
        driver: client that starts it.
        start: sends the request.
        undo: ends the task.
        arm: whether to arm a disarmed robot.

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
    """Return the path under a unique name."""
    return path.model_copy(update={"name": f"{path.name[:96]}-{clock.now():x}"})


async def send_path(driver: TruckClient, clock: Clock, path: Path, present: Mailbox[Path]) -> None:
    """Send a path and wait until the tracker follows it.

    Args:
        driver: client that sends it.
        clock: source of time.
        path: path to drive, with a unique name.
        present: latest path of the robot.

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
        raise NoAnswerError(f"the path {name!r} was not received within {ACCEPT_TIMEOUT:g} s") from None


async def _disarmed(clock: Clock, stand: StandstillMonitor, timeout: float = 0.0) -> Arrival:
    """End of a path that is abandoned once the robot has been disarmed for ``timeout`` seconds."""
    begin = active = clock.now()
    while (state := stand.gate.latest) is None or state.mode.active or clock.now() - active < timeout * SECOND:
        if state is None or state.mode.active:
            active = clock.now()
        await clock.sleep(STAND_LOOK_PERIOD)
    waited = f" for {timeout:g} s" if timeout else " on the way"
    return Arrival(state.worst, f"disarmed{waited}: {state.why}", 0.0, (clock.now() - begin) / SECOND)


async def _first(*ends: Coroutine[Any, Any, Arrival]) -> Arrival:
    """Return the result that is available first of two."""
    tasks = [asyncio.create_task(end) for end in ends]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        return next(task for task in tasks if task in done).result()
    finally:
        for task in tasks:
            task.cancel()


def _followed(present: Mailbox[Path], name: str) -> bool:
    """Whether the latest path has this name."""
    return present.latest is not None and present.latest.name == name


async def _path_end(
    clock: Clock, states: Mailbox[TrackerState], present: Mailbox[Path], name: str, report: DriveReport
) -> Arrival:
    begin, length = clock.now(), 0.0
    async for state in states:
        if not _followed(present, name):
            return Arrival(Reason.CANCELLED, "the tracker follows another path", length, (clock.now() - begin) / SECOND)
        if state.path != name:
            continue
        length = state.length
        report.under_way("along the path", state.along / state.length if state.length else 1.0)
        if state.outcome is not Reason.DRIVING:
            text = f"{state.along:.2f} of {state.length:.2f} m, {state.cross_track:+.3f} m off the path"
            return Arrival(state.outcome, text, state.length, (clock.now() - begin) / SECOND)
    raise NoAnswerError("the link to the robot was closed")


async def _watched(
    driver: Operator,
    stand: StandstillMonitor,
    needs: ServiceName,
    *,
    arm: bool,
    end: Callable[[], Awaitable[E]],
    undo: Callable[[], Awaitable[object]],
    to_its_end: bool = False,
) -> E:
    """Wait for the end; call ``undo`` if cancelled or refused, unless the robot restarted."""
    ending = asyncio.ensure_future(while_it_runs(driver, end(), needs))
    try:
        if arm and not ((state := stand.gate.latest) is not None and state.mode.active):
            # An already armed truck may have started to drive.
            try:
                async with taken_back(driver.disarm):
                    await driver.arm()
            except RequestRefusedError as error:
                raise RequestRefusedError(error.refusal, f"arm refused: {error}") from None
        return await asyncio.shield(ending)  # one reader of the reports until the end: a second one would miss some
    except TruckError as error:
        if not isinstance(error, RequestRefusedError) or error.refusal is not Reason.SHUTDOWN:
            with suppress(TruckError):  # report the failure rather than the failed undo
                await undo()
        raise
    except BaseException as error:
        try:
            await undo()
        except RequestRefusedError as refused:
            if refused.refusal is not Reason.NOT_FOUND:  # it has just ended by itself
                raise
        if to_its_end and isinstance(error, asyncio.CancelledError):
            return await ending
        raise
    finally:
        ending.cancel()
        await asyncio.gather(ending, return_exceptions=True)


@asynccontextmanager
async def reported(stand: StandstillMonitor, clock: Clock | None, report: DriveReport | None) -> AsyncIterator[None]:
    """Report why the truck stands for as long as the context is open."""
    watching = None
    if clock is not None and report is not None:
        watching = asyncio.create_task(_say_why_it_stands(stand, clock, report))
    try:
        yield
    finally:
        if watching is not None:
            watching.cancel()


async def _say_why_it_stands(stand: StandstillMonitor, clock: Clock, report: DriveReport) -> None:
    said: set[str] = set()  # stale inputs come and go while it stands
    while True:
        await clock.sleep(2 * STAND_LOOK_PERIOD)
        why, state = stand.why(), stand.gate.latest
        if not why or state is None:
            said.clear()
        elif new := set[str](state.reasons or (state.mode,)) - said:
            said |= new
            report.stands(state, why)
