"""``monstertruckd estop``: the order is sent before the command line is loaded."""

import asyncio
import json
import subprocess
import sys
from pathlib import Path

import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.req import ControlRequest, Order
from monstertruck_schemas.topics import REQ_CONTROL, estop_key
from monstertruckd import early_estop
from monstertruckd.early_estop import ENCODING, estop_payload
from tests.bus_kit import free_endpoint, running_robot


def test_key_encoding_and_order_are_those_of_the_topic():
    assert early_estop.estop_key("rover", "ann:1") == estop_key("rover", "ann:1")
    assert wire.encoding(REQ_CONTROL) == ENCODING
    request = wire.decode(REQ_CONTROL, estop_payload("ann:1"))
    assert isinstance(request, ControlRequest)
    assert (request.order, request.source, request.nonce) == (Order.ESTOP, "ann:1", "")


def test_nothing_heavy_is_loaded_for_it():
    heavy = "asyncio typer pydantic numpy google uvloop monstertruck_schemas.topics"
    code = f"import sys, {early_estop.__name__}; print([name for name in '{heavy}'.split() if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize(
    ("arguments", "sent"),
    [
        ((), ("truck", "tcp/127.0.0.1:7447")),
        (("-r", "rover", "--endpoint", "tcp/10.0.0.1:1"), ("rover", "tcp/10.0.0.1:1")),
        (("--json", "--robot=rover", "-etcp/10.0.0.1:1"), ("rover", "tcp/10.0.0.1:1")),
        (("--help",), None),
        (("-h",), None),
        (("now",), None),
        (("--no-such-option",), None),
    ],
)
def test_the_options_are_those_of_the_command(
    arguments: tuple[str, ...], sent: tuple[str, str] | None, monkeypatch: pytest.MonkeyPatch
):
    orders: list[tuple[str, str]] = []
    closed: list[bool] = []

    class Session:
        def close(self) -> None:
            closed.append(True)

    def send(robot: str, endpoint: str, timeout: float) -> Session:
        orders.append((robot, endpoint))
        return Session()

    monkeypatch.setattr(early_estop, "send_estop", send)
    monkeypatch.setattr(early_estop, "nearest", lambda endpoint: endpoint)
    with early_estop.early_estop(arguments):
        assert not closed
    assert orders == ([] if sent is None else [sent])
    assert closed == [True] * len(orders)


async def test_the_command_orders_at_once_and_again_when_it_can_wait_for_the_outcome():
    async with running_robot() as robot:
        orders = robot.bus.subscribe(REQ_CONTROL, fifo(10))
        command = (sys.executable, "-m", "monstertruckd", "estop", "-e", robot.endpoint, "--json")
        running = await asyncio.create_subprocess_exec(*command, stderr=subprocess.PIPE)
        _, printed = await running.communicate()
        first, second, *_ = orders.drain()
    assert running.returncode != 0, "nothing answers the call here"
    assert b"Traceback" not in printed
    assert (first.order, second.order) == (Order.ESTOP, Order.ESTOP)
    assert first.source == second.source
    assert (first.seq, second.seq > 0) == (0, True)


def test_where_nothing_listens_the_command_says_so():
    command = (sys.executable, "-m", "monstertruckd", "estop", "-e", free_endpoint())
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "no robot answers at" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_a_certificate_the_command_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MONSTERTRUCKD_TLS", str(tmp_path))
    command = (sys.executable, "-m", "monstertruckd", "estop", "-e", free_endpoint("tls"), "--json")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "ca.pem: not there" in done.stderr + json.dumps(done.stdout)
