"""Sending the truck somewhere from the command line."""

import asyncio
from contextlib import suppress

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.drives import DriveReport, _say_why_it_stands, drive_to, follow
from monstertruck_runtime.errors import NoAnswerError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.standstill import StandstillMonitor
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import GATE, TRACKER
from monstertruckd.tools.cli import connection
from monstertruckd.tools.cli.goto_session import on_the_terminal
from monstertruckd.tools.cli.main import app


class Unplanned:
    """A robot that drives paths and nothing else."""

    robot = "truck"

    def __init__(self, *_, **__):
        pass

    async def __aenter__(self):
        return self

    async def __aexit__(self, *_):
        pass

    async def call(self, rpc):
        assert rpc == "config"
        return {"planner": None}


def test_a_robot_without_a_planner_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Unplanned)
    done = CliRunner().invoke(app, ["goto", "1", "0", "0"])
    assert done.exit_code == Reason.NOT_FOUND.exit_code
    text = "add a section `planner` to its configuration, like the bundled `goals`"
    assert done.output.splitlines()[1:] == [f"robot 'truck' has no planner: {text}"]


def test_a_robot_that_is_awaited_is_named_before_the_wait_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    said: list[str] = []

    class Absent(Unplanned):
        async def __aenter__(self):
            await asyncio.sleep(0.1)
            said.append(capsys.readouterr().err)
            raise NotFoundError("no robot answers")

    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Absent)
    monkeypatch.setattr(connection, "SOON", 0.02)
    with pytest.raises(NotFoundError):
        connection.with_robot(None, "truck", "tcp/there:1")  # type: ignore[arg-type]
    assert said == ["waiting for robot 'truck' at tcp/there:1 ...\n"]
    monkeypatch.setattr("monstertruck_runtime.client.TruckClient", Unplanned)

    async def main(client: object, clock: object) -> None:
        await asyncio.sleep(0.1)

    connection.with_robot(main, "truck", "tcp/there:1", named=False)
    assert capsys.readouterr().err == "", "one that is there is not awaited"


class SilentRobot:
    """Takes requests and answers none, or refuses the goal."""

    source = "ann"

    def __init__(self, silent: str, error: Exception | None = None):
        self.asked: list[str] = []
        self._silent = silent
        self._error = error

    def subscribe(self, _topic, delivery):
        return Mailbox(delivery)

    async def _ask(self, what):
        self.asked.append(what)
        if what == self._silent:
            if self._error is not None:
                raise self._error
            await asyncio.Event().wait()

    async def goal(self, goal, frame="map", via=()):
        await self._ask("goal")
        return {"number": 1}

    async def goal_control(self, order, *, own=False):
        assert own, "nobody else's is cancelled"
        await self._ask(order.value)

    async def path(self, path, lease=1.0):
        await self._ask("path")

    async def stop(self):
        await self._ask("stop")

    async def arm(self):
        await self._ask("arm")

    async def disarm(self):
        await self._ask("disarm")


PATH = Path(stamp=0, received=0, seq=0, frame="odom", name="p", poses=np.zeros(6), directions=np.ones(2))


def interrupted(robot, drive):
    """What the robot was asked for until the command, interrupted after three seconds, had ended."""

    async def main(clock):
        driving = asyncio.create_task(drive(robot, clock))
        await clock.sleep(3.0)
        driving.cancel()
        with suppress(asyncio.CancelledError, NoAnswerError, RequestRefusedError):
            await driving

    run_virtual(main)
    return robot.asked


async def to_goal(robot, clock):
    with on_the_terminal() as report:
        return await drive_to(robot, clock, (1.0, 0.0, 0.0), arm=True, report=report)


def along_path(robot, clock):
    return follow(robot, clock, PATH, arm=True)


class StartingRobot(SilentRobot):
    """Its planner is starting."""

    def __init__(self, until: float, clock):
        super().__init__("")
        self._until = until
        self._clock = clock

    async def goal(self, goal, frame="map", via=()):
        await self._ask("goal")
        if self._clock.now() < self._until * SECOND:
            raise RequestRefusedError(Reason.PLANNER_STARTING, "the planner compiles")
        raise RequestRefusedError(Reason.DISARMED, "taken on")


@pytest.mark.parametrize(("starts", "reason"), [(60.0, Reason.DISARMED), (300.0, Reason.PLANNER_STARTING)])
def test_a_goal_waits_while_the_planner_is_starting_and_says_for_what(starts, reason, capsys):
    async def main(clock):
        robot = StartingRobot(starts, clock)
        with pytest.raises(RequestRefusedError) as refused:
            await to_goal(robot, clock)
        assert refused.value.refusal is reason
        assert len(robot.asked) > 100
        assert clock.now() >= min(starts, 240.0) * SECOND

    run_virtual(main)
    assert capsys.readouterr().err.splitlines() == ["waiting: the planner compiles"]


def test_what_a_goal_waits_for_is_said_with_the_command_that_helps(capsys):
    with on_the_terminal() as report:
        for reason in (Reason.DISARMED, Reason.ESTOPPED):
            report.stands(gate_state(GateMode.DISARMED).model_copy(update={"reasons": (reason,)}), reason.text)
    assert capsys.readouterr().err.splitlines() == [
        "waiting: the robot is disarmed; `monstertruckd arm` lets it drive",
        "waiting: emergency stop is latched; `monstertruckd reset` clears the emergency stop",
    ]


def test_a_goal_whose_request_is_interrupted_is_cancelled():
    assert interrupted(SilentRobot("goal"), to_goal) == ["goal", "cancel"]


def test_a_goal_whose_request_is_not_answered_is_cancelled():
    assert interrupted(SilentRobot("goal", NoAnswerError("no answer")), to_goal) == ["goal", "cancel"]


def test_a_goal_that_is_refused_leaves_the_present_one_alone():
    refused = RequestRefusedError(Reason.GOAL_UNREACHABLE, "no way")
    assert interrupted(SilentRobot("goal", refused), to_goal) == ["goal"]


def test_a_drive_that_is_interrupted_in_the_instant_of_its_end_is_interrupted():
    async def main(clock):
        ended = RequestRefusedError(Reason.NOT_FOUND, "cancel: no goal is being pursued")
        driving = asyncio.create_task(to_goal(SilentRobot("cancel", ended), clock))
        await clock.sleep(3.0)
        driving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await driving

    run_virtual(main)


def test_arming_that_is_interrupted_is_taken_back_with_the_goal():
    assert interrupted(SilentRobot("arm"), to_goal) == ["goal", "arm", "disarm", "cancel"]


def test_a_path_that_is_interrupted_before_it_is_accepted_stops_the_truck():
    assert interrupted(SilentRobot("none"), along_path) == ["path", "stop"]


class FollowingRobot(SilentRobot):
    """Follows the newest path."""

    def __init__(self):
        super().__init__("none")
        self.boxes = {topics.PATH: Mailbox(latest()), TRACKER: Mailbox(fifo(64))}

    def subscribe(self, topic, delivery):
        return self.boxes.get(topic) or super().subscribe(topic, delivery)

    async def path(self, path, lease=1.0):
        await super().path(path, lease)
        self.follow(path.name)

    def follow(self, name):
        header = {"stamp": 0, "received": 0, "seq": 0, "cross_track": 0.0, "heading_error": 0.0}
        self.boxes[topics.PATH].put(PATH.model_copy(update={"name": name}))
        self.boxes[TRACKER].put(TrackerState(**header, path=name, along=0.1, length=1.0, outcome=Reason.DRIVING))


def test_a_path_in_whose_place_another_one_is_followed_has_ended_and_that_is_not_stopped():
    async def main(clock):
        robot = FollowingRobot()
        following = asyncio.create_task(follow(robot, clock, PATH, arm=False))
        await clock.sleep(4.0)
        assert not following.done()
        robot.follow("another")
        await clock.sleep(0.1)
        return following.result(), robot.asked

    arrival, asked = run_virtual(main)
    assert (arrival.reason, arrival.text) == (Reason.CANCELLED, "the tracker follows another path")
    assert asked == ["path"]


class MovingRobot(SilentRobot):
    """Comes to rest after a second."""

    def __init__(self, clock):
        super().__init__("none")
        self._clock = clock
        self.gate = Mailbox(latest())

    def subscribe(self, topic, delivery):
        return self.gate if topic is GATE else super().subscribe(topic, delivery)

    async def come_to_rest(self):
        for _ in range(10):
            self.gate.put(gate_state(GateMode.DRIVING))
            await self._clock.sleep(0.1)
        assert self.asked == []
        self.gate.put(gate_state(GateMode.ARMED))


def gate_state(mode, nonce="n"):
    return GateState(stamp=0, received=0, seq=0, mode=mode, nonce=nonce, speed_limit=0.2)


def disarmed(text):
    return Event(stamp=0, received=0, seq=0, reason=Reason.DISARMED, severity=Severity.INFO, source="gate", text=text)


def test_each_reason_for_which_it_stands_is_said_once_until_it_drives():
    off, stale, latched = (Reason.DISARMED,), (Reason.DISARMED, Reason.DRIVE_STALE), (Reason.ESTOPPED,)
    said = []

    class Report(DriveReport):
        def stands(self, gate, why):
            said.append((gate.reasons, why))

    async def main(clock):
        gate, events = Mailbox(latest()), Mailbox(fifo(64))
        watching = asyncio.create_task(
            _say_why_it_stands(StandstillMonitor(gate, Mailbox(latest()), events), clock, Report())
        )
        for reasons in (off, stale, off, stale, latched, (), off):
            mode = GateMode.DISARMED if reasons else GateMode.DRIVING
            gate.put(gate_state(mode).model_copy(update={"reasons": reasons}))
            if reasons == off:
                events.put(disarmed("disarmed by ann"))
            await clock.sleep(1.1)
        watching.cancel()

    run_virtual(main)
    assert [reasons for reasons, _ in said] == [off, stale, latched, off]
    assert said[0][1] == "the robot is disarmed (disarmed by ann)"


class LostRobot(SilentRobot):
    """Says ten times a second that it drives, ``said`` times; then it is another run, or silent, and knows no goal."""

    def __init__(self, clock, said, restarts):
        super().__init__("cancel", NotFoundError("no such call"))
        self._clock, self._said, self._restarts = clock, said, restarts
        self._gates = []

    def subscribe(self, topic, delivery):
        box = super().subscribe(topic, delivery)
        if topic is GATE:
            self._gates.append(box)
        return box

    async def live(self):
        for _ in range(self._said):
            await self._clock.sleep(0.1)
            self._say("first")
        if self._restarts:
            await self._clock.sleep(40.0)
            self._say("second")

    def _say(self, nonce):
        for box in self._gates:
            box.put(gate_state(GateMode.DRIVING, nonce))


@pytest.mark.parametrize(
    ("said", "restarts", "error", "after"),
    [(200, True, RequestRefusedError, 60.0), (200, False, NoAnswerError, 80.0), (0, False, NoAnswerError, 60.0)],
)
def test_nobody_waits_for_a_robot_that_was_restarted_or_stays_silent(said, restarts, error, after):
    async def main(clock):
        robot = LostRobot(clock, said, restarts)
        living, began = asyncio.create_task(robot.live()), clock.now()
        with pytest.raises(error) as lost:
            await to_goal(robot, clock)
        assert clock.now() - began == pytest.approx(after * SECOND)
        assert getattr(lost.value, "refusal", Reason.SHUTDOWN) is Reason.SHUTDOWN
        # The new run knows nothing of the goal; a robot that is silent may still hear that it is cancelled.
        assert robot.asked == ["goal", "arm"] + ([] if restarts else ["cancel"])
        await living

    run_virtual(main)


def test_nobody_waits_for_a_goal_service_that_failed():
    class Robot(LostRobot):
        def subscribe(self, topic, delivery):
            box = super().subscribe(topic, delivery)
            if topic is topics.HEALTH:
                rows = [ServiceHealth(name="goals", state=ServiceState.FAILED, since=0, detail="ended by itself")]
                box.put(HealthTable(stamp=0, received=0, seq=0, services=tuple(rows)))
            return box

    async def main(clock):
        robot = Robot(clock, 10, restarts=False)
        living, began = asyncio.create_task(robot.live()), clock.now()
        with pytest.raises(RequestRefusedError, match=r"^goals: ended by itself$") as lost:
            await to_goal(robot, clock)
        assert lost.value.refusal is Reason.SERVICE_FAILED
        assert clock.now() - began == pytest.approx(0.1 * SECOND), "with the first report of the gate"
        await living

    run_virtual(main)


def test_a_path_waits_for_a_truck_that_comes_to_rest():
    async def main(clock):
        robot = MovingRobot(clock)
        following = asyncio.create_task(along_path(robot, clock))
        await robot.come_to_rest()
        await clock.sleep(0.01)
        assert robot.asked == ["path"]
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)

    run_virtual(main)


def test_a_path_is_written_in_the_form_of_another_program(tmp_path):
    (tmp_path / "log.csv").write_text("0,0,0,.1\n1,0,0,.2\n2,0,0,.1\n")
    line = ["convert-path", str(tmp_path / "log.csv"), str(tmp_path / "out.csv"), "-f", "tum"]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 3
    assert "log.csv:1: expected columns" in done.stderr
    done = CliRunner().invoke(app, [*line, "--columns", "x,y,yaw,speed"])
    assert (done.exit_code, done.stdout) == (0, f"{tmp_path / 'out.csv'}: 3 poses\n")
    head, first, *_ = (tmp_path / "out.csv").read_text().splitlines()
    assert head == "# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2"
    assert first.split(";")[5] == "0.1000000"
