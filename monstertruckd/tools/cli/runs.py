"""A behaviour, an exploration or a mission from its start to its end, as a client of the robot."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.drives import begun
from monstertruck_runtime.errors import NoAnswerError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.presence import while_it_runs
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.standstill import StandstillMonitor, monitor_standstill
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import BehaviourState, ExplorationPhase, ExplorationState, MissionState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, ExploreOrder, MissionOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import BEHAVIOUR, EXPLORE, MISSION, Topic
from monstertruckd.tools.cli.output import progress, with_remedy

EVERY: Final = 5.0
"""Seconds between two lines on an exploration that does the same all the time."""

S = TypeVar("S", BehaviourState, ExplorationState, MissionState)
Report = Callable[[str], object]
"""Gets a line of progress now and then."""


@dataclass(frozen=True, slots=True)
class RunEnd:
    """How a run ended."""

    reason: Reason
    text: str
    figures: dict[str, Any]
    """Figures of its last report: seconds ``elapsed``, and what else its kind has."""

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {"reason": self.reason, "text": self.text, **self.figures}


async def run_behaviour(client: Operator, name: str, *, arm: bool, settings: Mapping[str, Any] | None = None) -> RunEnd:
    """Start a behaviour and wait for its end, see ``_run``; ``settings`` replace the configured ones."""
    with progress(name) as bar:
        return await _run(
            client,
            BEHAVIOUR,
            ServiceName.BEHAVIOURS,
            lambda: client.behave(BehaviourOrder.START, name, settings),
            lambda: client.behave(BehaviourOrder.STOP, name, own=True),
            lambda state: bar(state.elapsed, f"{name}: {state.phase or 'begins'}, {state.travelled:.1f} m"),
            ("behaviour", "elapsed", "travelled", "values"),
            arm=arm,
        )


async def run_exploration(
    client: TruckClient,
    *,
    home: bool | None,
    budget: float | None,
    find: int | None = None,
    arm: bool,
    report: Report | None = None,
) -> RunEnd:
    """Start an exploration and wait for its end, see ``_run``; its arguments are those of ``TruckClient.explore``.

    Cancelled, it waits until the map is saved, and its end says where.
    """
    shown: tuple[Any, ...] | None = None
    due = 0.0

    def show(state: ExplorationState) -> None:
        nonlocal shown, due
        stands = _why_it_stands(stand)
        found = 0 if state.find is None else state.found
        now = () if stands else (state.phase, state.goals, found, state.text)  # these come and go while it stands
        if report is not None and (now != shown or state.elapsed >= due):
            shown, due = now, state.elapsed + EVERY
            report(progress_line(state, stands))

    with monitor_standstill(client) as stand:
        return await _run(
            client,
            EXPLORE,
            ServiceName.EXPLORER,
            lambda: client.explore(ExploreOrder.START, home=home, budget=budget, find=find),
            lambda: client.explore(ExploreOrder.STOP, own=True),
            show,
            ("elapsed", "travelled", "known", "goals", "found"),
            arm=arm,
            to_its_end=True,
        )


async def run_mission(
    client: TruckClient, mission: Mission | None, *, arm: bool, moved: bool = False, report: Report | None = None
) -> RunEnd:
    """Start a mission and wait for its end, see ``_run``.

    Args:
        client: of the robot.
        mission: None = resume the interrupted one.
        arm: arm the robot first.
        moved: see ``TruckClient.mission``.
        report: gets a line for each step, each that failed, and why the robot waits or stands.

    Raises:
        NotFoundError: the robot cannot do one of the steps.
    """
    order = MissionOrder.RESUME if mission is None else MissionOrder.START
    before: MissionState | None = None
    said = ""

    def show(state: MissionState) -> None:
        nonlocal before, said
        if report is None or not state.running:
            return
        lines = [] if before is None else _failed(before, state)
        if before is None or (state.step, state.attempt, state.doing) != (before.step, before.attempt, before.doing):
            again = f", attempt {state.attempt}" if state.attempt > 1 else ""
            lines.append(f"step {state.step} of {state.steps}: {state.doing}{again}")
        stands = _why_it_stands(stand)
        trouble = "stands" if stands else state.text  # what is stale comes and goes while it stands
        if trouble and trouble != said:
            lines.append(f"it stands: {stands}" if stands else f"it waits: {state.text}")
        before, said = state, trouble
        for line in lines:
            report(f"{state.elapsed:6.0f} s  {line}")

    with monitor_standstill(client) as stand:
        return await _run(
            client,
            MISSION,
            ServiceName.MISSIONS,
            lambda: client.mission(order, mission, moved=moved),
            lambda: client.mission(MissionOrder.STOP, own=True),
            show,
            ("name", "elapsed", "step", "failures"),
            arm=arm,
        )


def _failed(before: MissionState, state: MissionState) -> list[str]:
    """A line on the attempt that has failed between two reports, if one has."""
    again = state.step == before.step and state.attempt > before.attempt
    return [f"it failed: {state.failed}"] if again or state.failures > before.failures else []


def _why_it_stands(stand: StandstillMonitor) -> str:
    """Why the gate lets the robot not drive, and the command that helps; nothing where it does."""
    why, held = stand.why(), stand.gate.latest
    return with_remedy(held.worst, why) if why and held is not None else ""


async def _run(
    client: Operator,
    topic: Topic[S],
    needs: ServiceName,
    start: Callable[[], Awaitable[dict[str, Any]]],
    stop: Callable[[], Awaitable[object]],
    show: Callable[[S], None],
    figures: tuple[str, ...],
    *,
    arm: bool,
    to_its_end: bool = False,
) -> RunEnd:
    """Start a run and wait for its end; cancelled or without an answer, it is stopped, but nobody else's.

    With ``to_its_end`` one that is cancelled ends as any other does, once the robot has stopped it.

    Raises:
        RequestRefusedError: the start or the arming was refused, the service failed, or the robot restarted.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    with client.subscribe(topic, fifo(256)) as states:
        number: int | None = None
        try:
            number = int((await begun(client, start, stop, arm=arm))["number"])
            return await while_it_runs(client, _followed(states, number, show, figures), needs)
        except BaseException as error:
            if not isinstance(error, TruckError) or isinstance(error, NoAnswerError):
                with suppress(TruckError):
                    await stop()
                    if to_its_end and number is not None and isinstance(error, asyncio.CancelledError):
                        return await while_it_runs(client, _followed(states, number, show, figures), needs)
            raise


async def _followed(states: Mailbox[S], number: int, show: Callable[[S], None], figures: tuple[str, ...]) -> RunEnd:
    last: dict[str, Any] = {}
    async for state in states:
        if state.number > number:
            return RunEnd(Reason.CANCELLED, f"{state.source} started another one", last)
        if state.number == number:
            show(state)
            last = {name: getattr(state, name) for name in figures}
            if not state.running:
                return RunEnd(state.outcome, state.text, last)
    raise NoAnswerError("the link to the robot was closed")


def progress_line(state: ExplorationState, stands: str = "") -> str:
    """How far an exploration has come, in less than 80 characters, why the truck ``stands``, or what it waits for."""
    where = "" if state.target is None else f" to ({state.target.x:.1f}, {state.target.y:.1f})"
    if stands:
        return f"{state.elapsed:5.0f} s  it stands: {stands}"
    if state.text and state.running:
        return f"{state.elapsed:5.0f} s  it waits: {state.text}"
    if state.phase is ExplorationPhase.LOOKING and not state.known:
        return f"{state.elapsed:5.0f} s  waits for the first look at the map"
    found = "" if state.find is None else f", {state.found}/{state.find} tags"
    known = f"{state.known:6.1f} m^2{'' if found else ' known'}, {state.frontiers:2d} frontiers{found}"
    return f"{state.elapsed:5.0f} s {state.travelled:6.1f} m  {known}  {state.phase}{where}"
