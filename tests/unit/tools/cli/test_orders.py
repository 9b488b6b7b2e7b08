"""An order is answered by the robot, and the answer is the exit code."""

import asyncio
import json
import socket
from collections.abc import Callable
from typing import Any

import pytest
import typer

from monstertruck_runtime.errors import NoAnswerError, NotFoundError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Delivery, Mailbox, latest
from monstertruck_schemas.health import CalibrationHealth, CalibrationState
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import CALIBRATION, GATE, TRACKER, Topic
from monstertruckd.tools.cli import orders
from monstertruckd.tools.cli.orders import OrderOutcome, give

HERE = f"truck on {socket.gethostname()}"
HEADER = {"stamp": 1, "received": 1, "seq": 0}


def state(mode: GateMode, *reasons: Reason) -> GateState:
    return GateState(**HEADER, mode=mode, nonce="n", speed_limit=0.2, reasons=reasons)


class Robot:
    """A robot that answers an order by ``answer``."""

    def __init__(self, answer: GateState | TruckError, newest: GateState | None = None) -> None:
        self.answer = answer
        self.newest = newest
        self.orders: list[Order] = []
        self.calibration: CalibrationHealth | None = None
        self.tracker: Mailbox[TrackerState] = Mailbox(latest())

    def subscribe(self, topic: Topic[Any], _: Delivery) -> Mailbox[TrackerState]:
        assert topic is TRACKER
        return self.tracker

    async def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> GateState:
        self.orders.append(order)
        if isinstance(self.answer, TruckError):
            raise self.answer
        return self.answer

    async def get_retained(self, topic: Topic[Any]) -> Any:
        assert topic in (GATE, CALIBRATION)
        return self.newest if topic is GATE else self.calibration


class SlowRobot(Robot):
    """Answers an order to arm late or never."""

    def __init__(self, error: TruckError | None = None) -> None:
        super().__init__(state(GateMode.DISARMED))
        self.error = error

    async def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> GateState:
        self.orders.append(order)
        if order is not Order.ARM:
            return self.answer
        if self.error is not None:
            raise self.error
        return await asyncio.Event().wait()


def test_an_order_to_arm_that_is_interrupted_is_taken_back(capsys: pytest.CaptureFixture[str]):
    robot = SlowRobot()

    async def main() -> None:
        giving = asyncio.create_task(give(robot, Order.ARM))
        await asyncio.sleep(0.01)
        giving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await giving

    asyncio.run(main())
    assert robot.orders == [Order.ARM, Order.DISARM]
    assert capsys.readouterr().err == "disarmed: the gate did not answer the order to arm\n"


def test_an_order_to_arm_without_an_answer_is_taken_back():
    robot = SlowRobot(NoAnswerError("no answer in time"))
    with pytest.raises(NoAnswerError):
        given(robot, Order.ARM)
    assert robot.orders == [Order.ARM, Order.DISARM]


def given(robot: Robot, order: Order) -> OrderOutcome:
    return asyncio.run(give(robot, order))


@pytest.mark.parametrize("order", [Order.ARM, Order.DISARM, Order.ESTOP, Order.RESET])
def test_the_answer_of_the_robot_is_the_outcome(order: Order):
    robot = Robot(state(GateMode.ARMED))
    outcome = given(robot, order)
    assert robot.orders == [order]
    assert (outcome.reason, outcome.state) == (Reason.OK, state(GateMode.ARMED))


def test_a_refusal_comes_with_its_reason_and_the_state_of_the_gate():
    refusal = RequestRefusedError(Reason.OBSTACLE_STOP, "a wall")
    outcome = given(Robot(refusal, state(GateMode.STOPPING)), Order.ARM)
    assert (outcome.reason, outcome.text, outcome.state.mode) == (Reason.OBSTACLE_STOP, "a wall", GateMode.STOPPING)
    assert outcome.as_json()["accepted"] is False
    with pytest.raises(NoAnswerError, match="does not publish its gate state"):
        given(Robot(refusal), Order.ARM)


@pytest.mark.parametrize("error", [NoAnswerError("no answer in time"), NotFoundError("no robot")])
def test_no_answer_is_no_outcome(error: TruckError):
    with pytest.raises(type(error)):
        given(Robot(error, state(GateMode.ARMED)), Order.ARM)


def shown(
    monkeypatch: pytest.MonkeyPatch, command: Callable[..., None], outcome: OrderOutcome, *, json_output: bool = False
) -> int:
    monkeypatch.setattr(orders, "with_robot", lambda *_, **__: outcome)
    try:
        command("truck", "tcp/127.0.0.1:1", json_output)
    except typer.Exit as ended:
        return ended.exit_code
    return 0


def test_what_is_printed_and_the_exit_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    done = OrderOutcome(Order.ARM, Reason.OK, "", state(GateMode.ARMED, Reason.BATTERY_LOW))
    assert shown(monkeypatch, orders.arm, done) == 0
    assert capsys.readouterr().out == f"{HERE}: armed; battery low: speed limited\n"
    refused = OrderOutcome(Order.RESET, Reason.NOT_ARMED_SPEED, "it moves", state(GateMode.ESTOPPED))
    assert shown(monkeypatch, orders.reset, refused) == Reason.NOT_ARMED_SPEED.exit_code
    assert capsys.readouterr() == ("", f"{HERE}: reset refused: it moves\n")
    assert shown(monkeypatch, orders.reset, refused, json_output=True) == Reason.NOT_ARMED_SPEED.exit_code
    assert json.loads(capsys.readouterr().out) == {
        "order": "reset",
        "accepted": False,
        "reason": "not_armed_speed",
        "text": "it moves",
        "mode": "estopped",
        "holder": None,
        "waiting": [],
        "limited_by": [],
        "robot": HERE,
    }


def test_arming_says_who_drives_or_waits(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    driven = state(GateMode.DRIVING).model_copy(update={"holder": "tracker"})
    held = state(GateMode.ARMED).model_copy(update={"waiting": ("tracker",)})
    for after, words in ((driven, "driving; tracker drives\n"), (held, "armed; tracker waits to drive\n")):
        assert shown(monkeypatch, orders.arm, OrderOutcome(Order.ARM, Reason.OK, "", after)) == 0
        assert capsys.readouterr().out == f"{HERE}: {words}"


def test_who_sets_off_is_said_before_arming(capsys: pytest.CaptureFixture[str]):
    waiting = state(GateMode.DISARMED).model_copy(update={"waiting": ("tracker",)})
    asyncio.run(orders._announce(Robot(waiting, waiting), hold=False))  # type: ignore[arg-type]
    assert capsys.readouterr().err == "arming starts these sources: tracker; --hold arms without starting them\n"
    for newest in (state(GateMode.DISARMED), None):
        asyncio.run(orders._announce(Robot(waiting, newest), hold=False))  # type: ignore[arg-type]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("mode", "hold", "name", "words"),
    [
        (
            GateMode.DISARMED,
            False,
            "lap",
            "arming starts these sources: tracker, along path 'lap' of 14.0 m; --hold arms without starting them\n",
        ),
        (
            GateMode.DISARMED,
            False,
            "",
            "arming starts these sources: tracker, along its path of 14.0 m; --hold arms without starting them\n",
        ),
        (GateMode.DISARMED, True, "lap", ""),
        (GateMode.ARMED, False, "lap", ""),
    ],
)
def test_a_tracker_with_a_path_sets_off_though_it_asks_for_nothing_before(
    capsys: pytest.CaptureFixture[str], mode: GateMode, hold: bool, name: str, words: str
):
    robot = Robot(state(mode), state(mode))
    robot.tracker.put(
        TrackerState(
            stamp=0, received=0, seq=0, path=name, cross_track=0.0, heading_error=0.0, along=0.0, length=14.0,
            outcome=Reason.DRIVING,
        )
    )  # fmt: skip
    asyncio.run(orders._announce(robot, hold=hold))  # type: ignore[arg-type]
    assert capsys.readouterr().err == words


def test_a_calibration_that_has_expired_is_said_before_arming(capsys: pytest.CaptureFixture[str]):
    robot = Robot(state(GateMode.DISARMED))
    rows = [
        CalibrationState(wizard=name, grade="A", date="", until="", expired=why)
        for name, why in (("drive", ""), ("compass", "too old"))
    ]
    robot.calibration = CalibrationHealth(stamp=0, received=0, seq=0, wizards=tuple(rows))
    asyncio.run(orders._announce(robot, hold=True))  # type: ignore[arg-type]
    assert "calibration of compass has expired (too old)" in (said := capsys.readouterr().err)
    assert "drive" not in said
