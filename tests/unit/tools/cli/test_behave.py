"""``behave``: a run as a client sees it, and what is refused."""

import asyncio
from contextlib import contextmanager

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import BEHAVIOUR, GATE
from monstertruckd.tools.cli import behave, runs
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.runs import run_behaviour


def state(number=1, *, running=True, outcome=Reason.DRIVING, text=""):
    return BehaviourState(
        stamp=0, received=0, seq=0, number=number, behaviour="wall", kind="wall_pd", source="ann", running=running,
        phase="follow", outcome=outcome, text=text, elapsed=2.0, travelled=0.3, values={"distance": 0.3},
    )  # fmt: skip


class Robot:
    """Answers with the reports given, one a second."""

    def __init__(self, clock, *reports, refuses=None, armed=True):
        self.clock, self.reports, self.refuses, self.armed = clock, reports, refuses, armed
        self.orders = []
        self.tasks = []

    @contextmanager
    def subscribe(self, topic, delivery):
        box = Mailbox(delivery)
        if topic is BEHAVIOUR:
            self.box = box
        elif topic is GATE:
            self.tasks.append(asyncio.create_task(self._runs(box)))
        yield box

    async def _runs(self, gate):
        """It is started anew after three seconds."""
        for number in range(40):
            await self.clock.sleep(0.1)
            run = f"run {number // 30}"
            gate.put(GateState(stamp=0, received=0, seq=0, mode=GateMode.DRIVING, nonce=run, speed_limit=0.2))

    async def arm(self, *, hold=False):
        self.orders.append("hold" if hold else "arm")
        self.armed = True

    async def disarm(self):
        self.orders.append("disarm")

    async def behave(self, order, behaviour="", settings=None, *, own=False):
        assert own is (order is BehaviourOrder.STOP), "nobody else's is stopped"
        self.orders.append(order)
        if order is BehaviourOrder.START:
            if self.refuses is not None:
                raise self.refuses
            if not self.armed:
                raise RequestRefusedError(Reason.DISARMED, "the robot does not drive: the truck is disarmed")
            self.tasks.append(asyncio.create_task(self._report()))
        return {"number": 1}

    async def _report(self):
        for report in self.reports:
            await self.clock.sleep(1.0)
            self.box.put(report)


def run(*reports, arm=False, refuses=None, seconds=60.0, armed=True):
    async def main(clock: VirtualClock):
        robot = Robot(clock, *reports, refuses=refuses, armed=armed)
        try:
            async with clock.deadline(seconds):
                return robot, await run_behaviour(robot, "wall", arm=arm)
        except (TimeoutError, RequestRefusedError, NoAnswerError) as error:
            return robot, error

    return run_virtual(main)


def test_it_ends_with_the_behaviours_own_end():
    done = state(running=False, outcome=Reason.BEHAVIOUR_DONE, text="1 lap")
    robot, end = run(state(), state(), done, arm=True, armed=False)
    assert (end.reason, end.text, end.figures["travelled"]) == (Reason.BEHAVIOUR_DONE, "1 lap", 0.3)
    assert robot.orders == [BehaviourOrder.START, "hold", BehaviourOrder.START, "arm"]
    assert end.as_json()["values"] == {"distance": 0.3}


def test_reports_of_the_one_before_are_passed_over_and_a_later_one_ends_it():
    before = state(0, running=False, outcome=Reason.CANCELLED)
    _, end = run(before, state(), state(2))
    assert end.reason is Reason.CANCELLED
    assert "ann" in end.text


def test_giving_up_stops_the_robot():
    robot, end = run(state(), seconds=2.0)
    assert isinstance(end, TimeoutError)
    assert robot.orders[-1] is BehaviourOrder.STOP


def test_a_robot_that_was_started_anew_is_not_asked_to_stop_what_it_can_go_on_with():
    robot, end = run(*[state()] * 20)
    assert isinstance(end, RequestRefusedError)
    assert "restarted" in str(end)
    assert robot.orders == [BehaviourOrder.START]


def test_a_robot_that_would_drive_something_else_is_not_armed():
    robot, end = run(arm=True, armed=False, refuses=RequestRefusedError(Reason.BUSY, "the path 'bend' is followed"))
    assert end.refusal is Reason.BUSY
    assert robot.orders == [BehaviourOrder.START]
    robot, end = run(armed=False)
    assert end.refusal is Reason.DISARMED
    assert robot.orders == [BehaviourOrder.START], "without --arm"


@pytest.mark.parametrize(
    ("error", "stops"), [(RequestRefusedError(Reason.BUSY), False), (NoAnswerError("no answer"), True)]
)
def test_a_start_that_is_not_answered_is_stopped_and_a_refused_one_is_not(error, stops):
    robot, end = run(refuses=error)
    assert end is error
    assert (robot.orders[-1] is BehaviourOrder.STOP) == stops


def test_the_bar_says_what_the_robot_does_and_how_far_it_went(monkeypatch):
    shown = []

    @contextmanager
    def progress(what):
        shown.append(what)
        yield lambda _, now: shown.append(now)

    monkeypatch.setattr(runs, "progress", progress)
    run(state(), state(running=False, outcome=Reason.BEHAVIOUR_DONE))
    assert shown == ["wall", "wall: follow, 0.3 m", "wall: follow, 0.3 m"]


@pytest.mark.parametrize(
    ("options", "command"),
    [
        ([], "`monstertruckd arm` lets it drive"),
        (["-r", "sonar"], "`monstertruckd arm --robot sonar` lets it drive"),
        (
            ["--endpoint", "tcp/10.0.0.1:7448", "--robot", "sonar"],
            "`monstertruckd arm --endpoint tcp/10.0.0.1:7448 --robot sonar` lets it drive",
        ),
    ],
)
def test_the_command_that_a_refusal_names_reaches_the_same_robot(monkeypatch, options, command):
    def refused(*_, **__):
        raise RequestRefusedError(Reason.DISARMED)

    monkeypatch.setattr(behave, "with_robot", refused)
    said = CliRunner().invoke(app, ["behave", "start", "wall", *options])
    assert said.exit_code == Reason.DISARMED.exit_code
    assert said.stderr.endswith(f"; {command}\n")


def test_the_commands_have_help():
    shown = CliRunner().invoke(app, ["behave", "--help"]).stdout
    for name in ("list", "start", "stop"):
        assert name in shown
