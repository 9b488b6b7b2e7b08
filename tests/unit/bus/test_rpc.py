"""The registry behind remote calls."""

import asyncio
import json

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import TOPICS
from monstertruckd.bus.access import EVERYTHING, Grant, Sender
from monstertruckd.bus.rpc import Rpc, topic_rows

ANN = Sender("ann", EVERYTHING)


async def echo(payload):
    return {"echo": payload}


def test_a_name_has_one_handler():
    async def main(clock: VirtualClock) -> dict[str, object]:
        rpc = Rpc(clock)
        rpc.register("echo", echo)
        with pytest.raises(RuntimeError, match="twice"):
            rpc.register("echo", echo)
        with pytest.raises(NotFoundError, match="no rpc 'nope'; there are echo"):
            await rpc.call("nope", {})
        return await rpc.call("echo", {"a": 1})

    assert run_virtual(main) == {"echo": {"a": 1}}


def test_calls_are_recorded_with_who_what_and_the_answer():
    async def refuse(payload):
        raise RequestRefusedError(Reason.BUSY, "driving")

    async def main(clock: VirtualClock) -> list[tuple[str, str, str, Reason, str]]:
        recorded: list[tuple[str, str, str, Reason, str]] = []
        rpc = Rpc(clock, record=lambda *call: recorded.append(call))
        rpc.register("goal", echo)
        rpc.register("arm", refuse)
        rpc.register("config", echo, recorded=False)
        await rpc.answer(ANN, "goal", b'{"x": 1.5}')
        await rpc.answer(ANN, "arm", b"")
        await rpc.answer(ANN, "config", b"")
        await rpc.answer(ANN, "nope", b"\xff")
        await rpc.answer(Sender("bob", Grant(AccessRole.OBSERVER, Role.STATION)), "goal", b"{}")
        return recorded

    goal, arm, nope, bob = run_virtual(main)
    assert goal == ("goal", "ann", '{"x": 1.5}', Reason.OK, '{"echo": {"x": 1.5, "source": "ann"}}')
    assert arm == ("arm", "ann", "", Reason.BUSY, '{"reason": "busy", "text": "driving"}')
    assert nope[0] == "nope"
    assert nope[3] is not Reason.OK
    assert bob[1::2] == ("bob", Reason.NOT_PERMITTED)


def test_a_slow_handler_is_cancelled_at_its_deadline():
    async def main(clock: VirtualClock) -> float:
        rpc = Rpc(clock, deadline=2.0)
        cancelled = asyncio.Event()

        async def slow(_):
            try:
                await clock.sleep(60)
            finally:
                cancelled.set()

        rpc.register("slow", slow)
        start = clock.now()
        with pytest.raises(NoAnswerError, match="slow did not end within"):
            await rpc.call("slow", {})
        assert cancelled.is_set()
        return (clock.now() - start) / 1e9

    assert run_virtual(main) == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(
    ("raised", "reason"),
    [
        (RequestRefusedError(Reason.DISARMED), "disarmed"),
        (InputError("bad"), "bad_input"),
        (TimeoutError("own bug"), "internal"),
        (ZeroDivisionError(), "internal"),
    ],
)
def test_failures_are_answered_with_their_reason(raised, reason):
    async def main(clock: VirtualClock) -> tuple[bool, bytes]:
        rpc = Rpc(clock)

        async def fail(_):
            raise raised

        rpc.register("fail", fail)
        return await rpc.answer(ANN, "fail", b"")

    success, data = run_virtual(main)
    assert not success
    assert json.loads(data)["reason"] == reason
    assert json.loads(data)["text"]


@pytest.mark.parametrize("payload", [b"{", b"[1]", b"\xff\xfe\x00", b"7"])
def test_payloads_that_are_no_json_object_are_refused(payload: bytes):
    async def main(clock: VirtualClock) -> tuple[bool, bytes]:
        rpc = Rpc(clock)
        rpc.register("echo", echo)
        return await rpc.answer(ANN, "echo", payload)

    success, data = run_virtual(main)
    assert not success
    assert json.loads(data)["reason"] == "bad_input"


def test_the_topic_table_as_json():
    rows = topic_rows("rover")
    assert [row["name"] for row in rows] == [topic.name for topic in TOPICS]
    scan = next(row for row in rows if row["name"] == "sensor/scan")
    assert scan["key"] == "mt/rover/sensor/scan"
    assert scan["schema"] == "foxglove.LaserScan"
    assert json.loads(json.dumps(rows)) == rows


@pytest.mark.parametrize("needed", AccessRole)
@pytest.mark.parametrize("has", AccessRole)
def test_a_caller_needs_the_role_of_the_call(needed: AccessRole, has: AccessRole):
    async def main(clock: VirtualClock) -> tuple[bool, bytes]:
        rpc = Rpc(clock)
        rpc.register("echo", echo, needed)
        return await rpc.answer(Sender("bob", Grant(has, Role.STATION)), "echo", b"{}")

    success, data = run_virtual(main)
    assert success == has.covers(needed)
    if not success:
        text = f"echo: bob has the role {has}, but this needs {needed}"
        assert json.loads(data) == {"reason": "not_permitted", "text": text}


@pytest.mark.parametrize(
    ("role", "passed"), [("gamepad", "keyboard"), ("station", "station"), ("king", "king"), (7, 7)]
)
def test_handlers_get_the_source_of_the_key_and_no_higher_rank_than_granted(role: object, passed: object):
    async def main(clock: VirtualClock) -> tuple[bool, bytes]:
        rpc = Rpc(clock)
        rpc.register("echo", echo)
        sender = Sender("bob", Grant(AccessRole.PILOT, Role.KEYBOARD))
        return await rpc.answer(sender, "echo", json.dumps({"source": "ann", "role": role}).encode())

    _, data = run_virtual(main)
    assert json.loads(data)["echo"] == {"source": "bob", "role": passed}
