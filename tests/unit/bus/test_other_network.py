"""A station in a network namespace of its own: what a computer on the same network can ask, and what it cannot."""

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.stations import TLS_VARIABLE
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GATE, REQ_CONTROL, REQ_DRIVE, Writer
from monstertruckd.tools.security.folder import Folder
from tests.bus_kit import free_endpoint, gate_state, running_robot

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[3]
HERE, THERE = "10.213.107.1", "10.213.107.2"
REFUSED = "import socket, sys; sys.exit(socket.socket().connect_ex((sys.argv[1], int(sys.argv[2]))) != 111)"


@pytest.fixture
def elsewhere() -> Iterator[tuple[str, ...]]:
    """Words before a command that is run on another computer, as far as networks go."""
    holder = None
    try:
        holder = subprocess.Popen(["unshare", "--net", "sh", "-c", "echo up; exec sleep 60"], stdout=subprocess.PIPE)
        assert holder.stdout is not None
        holder.stdout.readline()
        inside = ("nsenter", "-t", str(holder.pid), "-n")
        for words in (
            ("ip", "link", "add", "mt-here", "type", "veth", "peer", "name", "mt-there", "netns", str(holder.pid)),
            ("ip", "addr", "add", f"{HERE}/30", "dev", "mt-here"),
            ("ip", "link", "set", "mt-here", "up"),
            (*inside, "ip", "addr", "add", f"{THERE}/30", "dev", "mt-there"),
            (*inside, "ip", "link", "set", "mt-there", "up"),
        ):
            subprocess.run(words, check=True, capture_output=True)
        yield inside
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no rights for network namespaces")
    finally:
        if holder is not None:
            holder.kill()
            holder.communicate()


async def test_an_observer_on_the_network_asks_for_everything_and_gets_nothing_done(
    tmp_path: Path, elsewhere: tuple[str, ...]
):
    folder = Folder(tmp_path)
    now = (WallClock().now() + WallClock().real_offset()) // SECOND
    folder.init("truck", (HERE,), folder.robot, now)
    for name, role in (("ann", AccessRole.PILOT), ("eve", AccessRole.OBSERVER)):
        folder.add(name, role, Role.STATION, now)
    port = free_endpoint().rpartition(":")[2]
    endpoint = f"tls/{HERE}:{port}"
    settings = folder.zenoh().model_dump() | {"listen_pilots": (), "listen": (endpoint,), "local_socket": False}
    called: list[str] = []

    async def take(payload: dict[str, Any]) -> dict[str, Any]:
        called.append(payload["source"])
        return {}

    async with running_robot(endpoint, **settings) as robot:
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        for name in ("arm", "set", "recording_delete"):
            robot.rpc.register(name, take)
        asked = [robot.bus.subscribe(topic, fifo(1000)) for topic in (REQ_DRIVE, REQ_CONTROL)]
        fuzzer = await asyncio.create_subprocess_exec(
            *elsewhere, sys.executable, "-m", "benchmarks.fuzz_requests",
            "--fuzzer", endpoint, "arm,set,recording_delete", "1000", "1", "2000",
            cwd=ROOT, env={**os.environ, TLS_VARIABLE: str(tmp_path / "stations" / "eve")}, stdout=subprocess.PIPE,
        )  # fmt: skip
        output, _ = await fuzzer.communicate()
        assert json.loads(output)["sent"] == 1000
        assert called == []
        assert [box.drain() for box in asked] == [[], []]
        refused = robot.events.drain()
        assert {event.reason for event in refused} <= {Reason.BAD_INPUT, Reason.NOT_PERMITTED}
        assert refused
        assert all(str(event.values["by"]).startswith("eve:") for event in refused), "who, beside why"
        async with await asyncio.start_server(lambda *_: None, "127.0.0.1", 0) as server:
            words = (sys.executable, "-c", REFUSED, HERE, str(server.sockets[0].getsockname()[1]))
            reached = await asyncio.create_subprocess_exec(*elsewhere, *words)
            assert await reached.wait() == 0, "what listens on the loopback address is not there for others"
