"""The client without asyncio, before a robot of a few lines in this process."""

import asyncio
import gc
import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from types import SimpleNamespace

import pytest
import zenoh

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError, RequestRefusedError
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


def test_a_name_that_no_key_may_hold_leaves_nothing_behind():
    with pytest.raises(InputError, match="source"):
        Truck(source="a/b").alive()
    assert threads() == []


def test_a_stream_keeps_the_session_that_nothing_else_refers_to(robot: SimpleNamespace):
    messages = Truck("truck", robot.endpoint).stream(BATTERY)
    assert next(messages).voltage == 24.5
    del messages
    assert threads() == []


def test_it_closes_at_the_programs_end_when_pools_take_no_work(robot: SimpleNamespace, monkeypatch: pytest.MonkeyPatch):
    truck = Truck("truck", robot.endpoint)
    assert truck.alive() is False
    monkeypatch.setattr("concurrent.futures.thread._shutdown", True)
    truck.close()
    assert threads() == []


def test_another_threads_call_ends_when_it_is_closed(robot: SimpleNamespace):
    with Truck("truck", robot.endpoint) as truck, ThreadPoolExecutor() as pool:
        waiting = [pool.submit(truck.get, SCAN, 30.0), pool.submit(truck._do, lambda _: asyncio.sleep(30.0))]
        while len(asyncio.all_tasks(truck._opened()._loop)) < 3:
            time.sleep(0.01)
        truck.close()
        for each in waiting:
            with pytest.raises(RuntimeError, match="closed"):
                each.result(5.0)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_is_refused_instead_of_waiting_for_ever(robot: SimpleNamespace):
    with Truck("truck", robot.endpoint) as truck:
        child = os.fork()
        if child == 0:
            signal.alarm(10)  # of which it dies where it waits
            with suppress(BaseException):
                truck.call("anything")
                os._exit(1)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert truck.call("anything") == {"said": {}}
