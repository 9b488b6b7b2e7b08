"""A behaviour, an exploration or a mission from its start to its end, as a client of the robot."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.drives import TaskEnd, run_task
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.standstill import StandstillMonitor, monitor_standstill
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import ExplorationPhase, ExplorationState, MissionState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, ExploreOrder, MissionOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import BEHAVIOUR, EXPLORE, MISSION
from monstertruckd.tools.cli.output import progress, with_remedy

Report = Callable[[str], object]
"""Gets a line of progress now and then."""


@dataclass(frozen=True, slots=True)
class RunEnd:
    """How a run ended."""

    reason: Reason
    text: str
    figures: dict[str, Any]
    """Figures of its last report: seconds ``elapsed``, and what else its kind has."""

    @classmethod
    def of(cls, end: TaskEnd[Any], *figures: str) -> "RunEnd":
        """Add figures of a task's last report."""
        state = end.state
        return cls(end.reason, end.text, {} if state is None else {name: getattr(state, name) for name in figures})

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return {"reason": self.reason, "text": self.text, **self.figures}


async def run_behaviour(client: Operator, name: str, *, arm: bool, settings: Mapping[str, Any] | None = None) -> RunEnd:
    """Start a behaviour and wait for its end, see ``run_task``; ``settings`` replace the configured ones."""
    with progress(name) as bar:
        end = await run_task(
            client,
            BEHAVIOUR,
            ServiceName.BEHAVIOURS,
            lambda: client.behave(BehaviourOrder.START, name, settings),
            lambda: client.behave(BehaviourOrder.STOP, name, own=True),
            lambda state: bar(state.elapsed, f"{name}: {state.phase or 'begins'}, {state.travelled:.1f} m"),
            arm=arm,
        )
    return RunEnd.of(end, "behaviour", "elapsed", "travelled", "values")


async def run_exploration(
    client: TruckClient,
    *,
    home: bool | None = None,
    budget: float | None = None,
    find: int | None = None,
    arm: bool,
    report: Report | None = None,
) -> RunEnd:
    """Start an exploration and wait for its end, see ``run_task``; its arguments are as in ``TruckClient.explore``.

    Cancelled, it waits until the map is saved, and reports where.
    """
    shown: tuple[Any, ...] | None = None
    due = 0.0

    def show(state: ExplorationState) -> None:
        nonlocal shown, due
        stands = _why_it_stands(stand)
        found = 0 if state.find is None else state.found
        now = () if stands else (state.phase, state.goals, found, state.text)  # these come and go while it stands
        if report is not None and (now != shown or state.elapsed >= due):
            # 5.0: seconds between two lines on an exploration that does the same all the time
            shown, due = now, state.elapsed + 5.0
            report(progress_line(state, stands))

    with monitor_standstill(client) as stand:
        end = await run_task(
            client,
            EXPLORE,
            ServiceName.EXPLORER,
            lambda: client.explore(ExploreOrder.START, home=home, budget=budget, find=find),
            lambda: client.explore(ExploreOrder.STOP, own=True),
            show,
            arm=arm,
            to_its_end=True,
        )
    return RunEnd.of(end, "elapsed", "travelled", "known", "goals", "found")


async def run_mission(
    client: TruckClient, mission: Mission | None, *, arm: bool, moved: bool = False, report: Report | None = None
) -> RunEnd:
    """Start a mission and wait for its end, see ``run_task``.

    Args:
        client: client of the robot.
        mission: None: resume the interrupted one.
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
        if before is None or (state.node, state.attempt, state.doing) != (before.node, before.attempt, before.doing):
            again = f", attempt {state.attempt}" if state.attempt > 1 else ""
            lines.append(f"step {state.node} of {state.steps}: {state.doing}{again}")
        stands = _why_it_stands(stand)
        trouble = "stands" if stands else state.text  # stale inputs come and go while it stands
        if trouble and trouble != said:
            lines.append(f"standing: {stands}" if stands else f"waiting: {state.text}")
        before, said = state, trouble
        for line in lines:
            report(f"{state.elapsed:6.0f} s  {line}")

    with monitor_standstill(client) as stand:
        end = await run_task(
            client,
            MISSION,
            ServiceName.MISSIONS,
            lambda: client.mission(order, mission, moved=moved),
            lambda: client.mission(MissionOrder.STOP, own=True),
            show,
            arm=arm,
        )
    return RunEnd.of(end, "name", "elapsed", "step", "failures")


def _failed(before: MissionState, state: MissionState) -> list[str]:
    """A line on the attempt that has failed between two reports, if one has."""
    again = state.node == before.node and state.attempt > before.attempt
    return [f"failed: {state.failed}"] if again or state.failures > before.failures else []


def _why_it_stands(stand: StandstillMonitor) -> str:
    """Why the gate lets the robot not drive, and the command that helps; nothing where it does."""
    why, held = stand.why(), stand.gate.latest
    return with_remedy(held.worst, why) if why and held is not None else ""


def progress_line(state: ExplorationState, stands: str = "") -> str:
    """Progress of an exploration in less than 80 characters, or why the truck ``stands`` or waits."""
    where = "" if state.target is None else f" to ({state.target.x:.1f}, {state.target.y:.1f})"
    if stands:
        return f"{state.elapsed:5.0f} s  standing: {stands}"
    if state.text and state.running:
        return f"{state.elapsed:5.0f} s  waiting: {state.text}"
    if state.phase is ExplorationPhase.LOOKING and not state.known:
        return f"{state.elapsed:5.0f} s  waiting for the first analysis of the map"
    found = "" if state.find is None else f", {state.found}/{state.find} tags"
    known = f"{state.known:6.1f} m^2{'' if found else ' known'}, {state.frontiers:2d} frontiers{found}"
    return f"{state.elapsed:5.0f} s {state.travelled:6.1f} m  {known}  {state.phase}{where}"
