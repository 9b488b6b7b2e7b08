"""The client without asyncio, before a robot of a few lines in this process."""

import gc
import json
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import zenoh

from monstertruck_runtime import wire
from monstertruck_runtime.errors import NoAnswerError, NotFoundError, RequestRefusedError
from monstertruck_runtime.truck import Truck
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruck_schemas.topics import BATTERY, SCAN
from monstertruckd.tools.demo.runs import free_endpoint


@pytest.fixture
def robot() -> Iterator[SimpleNamespace]:
    """Endpoint of a robot that counts calls, refuses one of them, and says its battery's voltage."""
    endpoint = free_endpoint()
    config = zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": [endpoint]},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            }
        )
    )
    with zenoh.open(config) as session:

        def answer(query: zenoh.Query) -> None:
            with query:
                if "/rpc/refused/" in str(query.key_expr):
                    query.reply_err(json.dumps({"reason": Reason.BUSY.value, "text": "not now"}))
                else:
                    query.reply(query.key_expr, json.dumps({"said": json.loads(query.payload.to_string())}))

        session.declare_queryable("mt/truck/rpc/**", answer)
        level = BatteryLevel.NORMAL
        battery = Battery(stamp=1, received=1, seq=0, voltage=24.5, raw_voltage=24.5, cells=6, level=level)
        data, stop = wire.encode(BATTERY, battery), threading.Event()

        def speak() -> None:
            while not stop.wait(0.02):
                session.put(BATTERY.key("truck"), data)

        speaking = threading.Thread(target=speak)
        speaking.start()
        yield SimpleNamespace(endpoint=endpoint)
        stop.set()
        speaking.join()


def threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "truck"]


def test_calls_messages_refusals_and_silence(robot: SimpleNamespace):
    with Truck("truck", robot.endpoint, timeout=2.0) as truck:
        assert truck.call("anything", {"a": 1}) == {"said": {"a": 1}}
        with pytest.raises(RequestRefusedError, match="not now") as refused:
            truck.call("refused")
        assert refused.value.refusal is Reason.BUSY
        assert truck.get(BATTERY).voltage == 24.5
        with truck.stream(BATTERY) as messages:
            assert [next(messages).cells for _ in range(3)] == [6, 6, 6]
        with pytest.raises(NoAnswerError, match=r"sensor/scan within 0\.1 s"):
            truck.get(SCAN, timeout=0.1)
        assert len(threads()) == 1
    assert threads() == []


def test_a_forgotten_one_closes_itself(robot: SimpleNamespace):
    truck = Truck("truck", robot.endpoint)
    assert truck.call("anything") == {"said": {}}
    assert len(threads()) == 1
    del truck
    gc.collect()
    assert threads() == []


def test_a_robot_that_is_not_there_is_reported_and_leaves_nothing_behind():
    with pytest.raises(NotFoundError, match="no robot answers"), Truck("truck", "tcp/127.0.0.1:1", timeout=0.3):
        pass
    assert threads() == []
