"""An order is answered by the gate's events and states, and the answer is the exit code."""

import asyncio
import json
from collections.abc import Callable
from typing import Any

import pytest
import typer

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import EVENT, GATE, Topic
from monstertruckd.tools.cli import orders
from monstertruckd.tools.cli.answer import Answer, give

HEADER = {"stamp": 1, "received": 1, "seq": 0}


def state(mode: GateMode, *reasons: Reason) -> GateState:
    return GateState(**HEADER, mode=mode, nonce="n", speed_limit=0.2, reasons=reasons)


def event(by: str = "me", request: str = "arm", reason: Reason = Reason.OBSTACLE_STOP) -> Event:
    return Event(
        **HEADER, reason=reason, severity=Severity.WARNING, source="gate", values={"by": by, "request": request}
    )


class Robot:
    """A gate that answers an order by a script of messages, and repeats its state as the real one does."""

    source = "me"

    def __init__(self, mode: GateMode, *answer: Event | GateMode) -> None:
        self.mode = mode
        self.answer = answer
        self.orders: list[Order] = []
        self.boxes: dict[str, Mailbox[Any]] = {}

    def subscribe(self, topic: Topic[Any], delivery: Delivery) -> Mailbox[Any]:
        box: Mailbox[Any] = Mailbox(delivery)
        self.boxes[topic.name] = box
        if topic is GATE:
            box.put(state(self.mode))
        return box

    async def get_retained(self, topic: Topic[Any]) -> Any:
        return state(self.mode)

    async def order(self, order: Order, lease: float = 1.0) -> None:
        self.orders.append(order)
        for message in self.answer:
            if isinstance(message, Event):
                self.boxes[EVENT.name].put(message)
            else:
                self.mode = message

    async def live(self, clock: VirtualClock) -> None:
        while True:
            await clock.sleep(0.1)
            self.boxes[GATE.name].put(state(self.mode))


def answered(robot: Robot, order: Order) -> Answer:
    async def main(clock: VirtualClock) -> Answer:
        living = asyncio.create_task(robot.live(clock))
        try:
            return await give(robot, clock, order)
        finally:
            living.cancel()
            await asyncio.wait([living])

    return run_virtual(main)


@pytest.mark.parametrize(
    ("order", "before", "after"),
    [
        (Order.ARM, GateMode.DISARMED, GateMode.ARMED),
        (Order.ARM, GateMode.ARMED, GateMode.ARMED),
        (Order.DISARM, GateMode.ARMED, GateMode.DISARMED),
        (Order.DISARM, GateMode.ESTOPPED, GateMode.ESTOPPED),
        (Order.ESTOP, GateMode.DRIVING, GateMode.ESTOPPED),
        (Order.RESET, GateMode.ESTOPPED, GateMode.DISARMED),
    ],
)
def test_the_state_shows_an_order_as_carried_out(order: Order, before: GateMode, after: GateMode):
    robot = Robot(before, after)
    answer = answered(robot, order)
    assert robot.orders == [order]
    assert (answer.reason, answer.state.mode) == (Reason.OK, after)


@pytest.mark.parametrize("mode", [GateMode.DISARMED, GateMode.STOPPING, GateMode.ARMED])
def test_a_refusal_is_the_answer_also_where_the_state_would_have_served(mode: GateMode):
    answer = answered(Robot(mode, event()), Order.ARM)
    assert (answer.reason, answer.text) == (Reason.OBSTACLE_STOP, Reason.OBSTACLE_STOP.text)
    assert answer.as_json()["accepted"] is False


def test_refusals_of_others_or_of_other_orders_are_not_the_answer():
    robot = Robot(GateMode.DISARMED, event(by="you"), event(request="reset"), GateMode.ARMED)
    assert answered(robot, Order.ARM).reason is Reason.OK


def test_a_gate_that_does_nothing_is_no_answer():
    with pytest.raises(NoAnswerError, match=r"arm: the gate did not answer within 5 s"):
        answered(Robot(GateMode.DISARMED), Order.ARM)


def shown(
    monkeypatch: pytest.MonkeyPatch, command: Callable[..., None], answer: Answer, *, json_output: bool = False
) -> int:
    def run_wall(main: Any) -> Answer:
        return answer

    monkeypatch.setattr(orders, "run_wall", run_wall)
    try:
        command("truck", "tcp/127.0.0.1:1", json_output)
    except typer.Exit as ended:
        return ended.exit_code
    return 0


def test_what_is_printed_and_the_exit_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    done = Answer(Order.ARM, Reason.OK, "", state(GateMode.ARMED, Reason.BATTERY_LOW))
    assert shown(monkeypatch, orders.arm, done) == 0
    assert capsys.readouterr().out == "armed; battery low: speed limited\n"
    refused = Answer(Order.RESET, Reason.NOT_ARMED_SPEED, "it moves", state(GateMode.ESTOPPED))
    assert shown(monkeypatch, orders.reset, refused) == Reason.NOT_ARMED_SPEED.exit_code
    assert capsys.readouterr() == ("", "reset refused: it moves\n")
    assert shown(monkeypatch, orders.reset, refused, json_output=True) == Reason.NOT_ARMED_SPEED.exit_code
    assert json.loads(capsys.readouterr().out) == {
        "order": "reset",
        "accepted": False,
        "reason": "not_armed_speed",
        "text": "it moves",
        "mode": "estopped",
        "holder": None,
        "limited_by": [],
    }
