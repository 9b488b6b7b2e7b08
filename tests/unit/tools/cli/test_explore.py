"""``explore``: durations, lines of progress, the end, and what stops it."""

import asyncio
from unittest.mock import AsyncMock

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.drives import TaskEnd, run_task
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.plan import ExplorationPhase, ExplorationState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import EVENT, EXPLORE, GATE
from monstertruckd.tools.cli import goto, main, runs
from monstertruckd.tools.cli.model_options import seconds_of
from monstertruckd.tools.cli.runs import progress_line, run_exploration


def state(number: int, phase: ExplorationPhase, outcome: Reason = Reason.DRIVING, **more) -> ExplorationState:
    return ExplorationState(
        stamp=1, received=1, seq=0, frame="map", number=number, phase=phase, outcome=outcome, **more
    )


class Robot:
    """Answers orders, and says what it was given to say."""

    source = "ann"

    def __init__(self, *states: ExplorationState, refuse: bool = False) -> None:
        self.orders: list[tuple[str, ...]] = []
        self.mailbox: Mailbox[ExplorationState] = Mailbox(fifo(64), lambda _: None)
        self.gate: Mailbox[GateState] = Mailbox(latest())
        self.events: Mailbox[Event] = Mailbox(fifo(64))
        self.states, self.refuse = states, refuse

    def subscribe(self, topic, delivery):
        return {EXPLORE: self.mailbox, GATE: self.gate, EVENT: self.events}.get(topic) or Mailbox(delivery)

    async def arm(self):
        self.orders.append(("arm",))

    async def explore(self, order: ExploreOrder, *, home=None, budget=None, find=None, own=False):
        assert own is (order is ExploreOrder.STOP), "nobody else's is stopped"
        self.orders.append((order, home, budget))
        if self.refuse:
            raise RequestRefusedError(Reason.BUSY)
        for one in self.states:
            self.mailbox.put(one)
        return {"number": 3}


@pytest.mark.parametrize(("text", "seconds"), [("90", 90), ("90s", 90), ("20min", 1200), ("1.5 h", 5400)])
def test_durations(text: str, seconds: float):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "min", "-5", "0", "5 days", "1e3"])
def test_what_is_no_duration_is_refused_with_an_example(text: str):
    with pytest.raises(InputError, match="such as 20min"):
        seconds_of(text)


def test_it_is_followed_to_its_end_and_printed_in_short_lines():
    there = Pose2D(x=12.0, y=-3.0, yaw=0.0)
    robot = Robot(
        state(2, ExplorationPhase.IDLE, Reason.EXPLORED),
        state(3, ExplorationPhase.DRIVING, target=there, goals=1),
        state(3, ExplorationPhase.DRIVING, target=there, goals=1, elapsed=1.0),
        state(3, ExplorationPhase.DRIVING, target=there, goals=1, elapsed=6.0),
        state(3, ExplorationPhase.IDLE, Reason.EXPLORED, text="12 m^2", travelled=5.0, known=12.0, goals=1),
    )
    lines: list[str] = []
    end = asyncio.run(run_exploration(robot, home=True, budget=60.0, arm=True, report=lines.append))
    assert (end.reason, end.text, end.figures["travelled"], end.figures["known"]) == (
        Reason.EXPLORED,
        "12 m^2",
        5.0,
        12.0,
    )
    assert robot.orders == [(ExploreOrder.START, True, 60.0)], "it is armed"
    assert len(lines) == 3
    assert "to (12.0, -3.0)" in lines[0]
    assert all(len(line) < 80 for line in lines)
    busy = state(3, ExplorationPhase.RETURNING, elapsed=9e3, travelled=2e3, known=5e3, frontiers=20, target=there)
    assert len(progress_line(busy)) < 80


def test_what_it_waits_for_is_said():
    robot = Robot(
        state(3, ExplorationPhase.LOOKING, text="the planner is starting"),
        state(3, ExplorationPhase.LOOKING, elapsed=1.0, known=3.0),
        state(3, ExplorationPhase.IDLE, Reason.EXPLORED, text="12 m^2"),
    )
    lines: list[str] = []
    asyncio.run(run_exploration(robot, home=None, budget=None, arm=False, report=lines.append))
    assert lines[0] == "    0 s  waiting: the planner is starting"
    assert "waits" not in lines[1]
    assert "looking" in lines[1]


def test_refused_it_stops_nothing_and_without_the_robot_it_tries_to():
    robot = Robot(refuse=True)
    with pytest.raises(RequestRefusedError):
        asyncio.run(run_exploration(robot, home=None, budget=None, arm=False))
    assert robot.orders == [(ExploreOrder.START, None, None)]
    gone = Robot(state(3, ExplorationPhase.DRIVING))

    async def lost() -> None:
        task = asyncio.create_task(run_exploration(gone, home=None, budget=None, arm=False))
        await asyncio.sleep(0.01)
        gone.mailbox.close()
        await task

    with pytest.raises(NoAnswerError):
        asyncio.run(lost())
    assert gone.orders[-1][0] is ExploreOrder.STOP


def test_stopped_by_its_user_it_says_where_the_map_is():
    robot = Robot(state(3, ExplorationPhase.DRIVING, known=3.0))
    lines: list[str] = []

    async def interrupted():
        task = asyncio.create_task(run_exploration(robot, home=None, budget=None, arm=False, report=lines.append))
        await asyncio.sleep(0.01)
        robot.states = (
            state(3, ExplorationPhase.SAVING, known=3.0),
            state(3, ExplorationPhase.IDLE, Reason.CANCELLED, text="stopped by ann; map in runs/explored"),
        )
        task.cancel()
        return await task

    end = asyncio.run(interrupted())
    assert [order for order, *_ in robot.orders] == [ExploreOrder.START, ExploreOrder.STOP]
    assert (end.reason, end.text) == (Reason.CANCELLED, "stopped by ann; map in runs/explored")
    assert "saving" in lines[-2], "while it waits"


def test_one_that_is_stopped_while_it_arms_the_robot_is_waited_for_too():
    robot = Robot(state(3, ExplorationPhase.LOOKING))
    robot.gate.put(GateState(stamp=1, received=1, seq=0, mode=GateMode.DISARMED, nonce="n", speed_limit=0.0))
    shown: list[ExplorationPhase] = []

    async def stop() -> None:
        await robot.explore(ExploreOrder.STOP, own=True)

    async def interrupted() -> TaskEnd[ExplorationState]:
        robot.arm, robot.disarm = asyncio.Event().wait, AsyncMock()
        task = asyncio.create_task(
            run_task(
                robot, EXPLORE, ServiceName.EXPLORER, lambda: robot.explore(ExploreOrder.START), stop,
                lambda report: shown.append(report.phase), arm=True, waits=True, to_its_end=True,
            )
        )  # fmt: skip
        await asyncio.sleep(0.01)
        robot.states = tuple(
            state(3, phase, outcome, text="stopped by ann")
            for phase, outcome in (
                (ExplorationPhase.SAVING, Reason.DRIVING),
                (ExplorationPhase.IDLE, Reason.CANCELLED),
            )
        )
        task.cancel()
        async with asyncio.timeout(5):
            return await task

    end = asyncio.run(interrupted())
    assert (end.reason, end.text) == (Reason.CANCELLED, "stopped by ann")
    assert shown == [ExplorationPhase.LOOKING, ExplorationPhase.SAVING, ExplorationPhase.IDLE]


def test_the_tags_that_are_found_are_counted_at_once():
    robot = Robot(
        *(state(3, ExplorationPhase.DRIVING, elapsed=t, known=9.0, find=6, found=n) for t, n in ((1, 2), (2, 3))),
        state(3, ExplorationPhase.DRIVING, elapsed=3.0, known=9.0, find=6, found=3),
        state(3, ExplorationPhase.IDLE, Reason.POINTS_FOUND, find=6, found=6),
    )
    lines: list[str] = []
    end = asyncio.run(run_exploration(robot, home=None, budget=None, find=6, arm=False, report=lines.append))
    assert [line.partition("frontiers, ")[2][:8] for line in lines] == ["2/6 tags", "3/6 tags", "6/6 tags"]
    assert end.figures["found"] == 6
    there = Pose2D(x=12.0, y=-3.0, yaw=0.0)
    busy = state(3, ExplorationPhase.RETURNING, elapsed=9e3, travelled=2e3, known=5e3, frontiers=20, target=there)
    assert len(progress_line(busy.model_copy(update={"find": 6, "found": 3}))) < 80


def test_another_exploration_ends_it():
    robot = Robot(state(4, ExplorationPhase.LOOKING, source="bob"))
    end = asyncio.run(run_exploration(robot, home=None, budget=None, arm=False))
    assert (end.reason, end.text) == (Reason.CANCELLED, "bob started another task")


def test_a_truck_that_stands_disarmed_is_not_said_to_drive():
    phases = ExplorationPhase.DRIVING, ExplorationPhase.LOOKING, ExplorationPhase.DRIVING
    robot = Robot(*(state(3, phase, elapsed=float(t), goals=t) for t, phase in enumerate(phases)))
    robot.gate.put(
        GateState(
            stamp=1, received=1, seq=0, mode=GateMode.DISARMED, nonce="n", speed_limit=0.0, reasons=(Reason.DISARMED,)
        )
    )
    robot.states += (state(3, ExplorationPhase.IDLE, Reason.EXPLORED),)
    robot.events.put(
        Event(
            stamp=1, received=1, seq=0, reason=Reason.DISARMED, severity=Severity.INFO, source="gate",
            text="disarmed by bob",
        )
    )  # fmt: skip
    lines: list[str] = []

    def report(line: str) -> None:
        lines.append(line)
        held = robot.gate.latest
        robot.gate.put(held.model_copy(update={"reasons": (Reason.DISARMED, Reason.DRIVE_STALE)}))

    asyncio.run(run_exploration(robot, home=None, budget=None, arm=False, report=report))
    assert lines[0] == "    0 s  standing: the robot is disarmed (disarmed by bob); `monstertruckd arm` lets it drive"
    assert len(lines) == 1, "once"


def test_before_the_first_look_at_the_map_it_tells_no_zeros():
    starts = progress_line(state(3, ExplorationPhase.LOOKING))
    assert starts.endswith("waiting for the first analysis of the map")
    assert progress_line(state(3, ExplorationPhase.LOOKING, known=12.0)).endswith("looking")


@pytest.mark.parametrize(
    ("options", "asked"),
    [([], {}), (["--home"], {"home": True}), (["--stay", "--budget", "20min"], {"home": False, "budget": 1200.0})],
)
def test_the_command_passes_the_options_that_are_given(monkeypatch: pytest.MonkeyPatch, options, asked):
    ran = AsyncMock(side_effect=RequestRefusedError(Reason.BUSY, "another one runs"))
    monkeypatch.setattr(goto, "require_section", AsyncMock())
    monkeypatch.setattr(runs, "run_task", ran)
    monkeypatch.setattr(goto, "with_robot", lambda main, *_: asyncio.run(main(robot, None)))
    robot = Robot()
    robot.explore = AsyncMock()
    done = CliRunner().invoke(main.app, ["explore", *options])
    assert isinstance(done.exception, RequestRefusedError | SystemExit), done.exception
    asyncio.run(start(ran))
    assert {key: value for key, value in robot.explore.call_args.kwargs.items() if value is not None} == asked


async def start(ran: AsyncMock) -> None:
    """Give the order that ``run_task`` was to give."""
    await ran.call_args.args[3]()
