"""Messages taken in the thread that reads the network."""

import asyncio
import os
import re
import sys
import threading
from pathlib import Path

import zenoh

from monstertruck_runtime.client import TruckClient, in_network_thread
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.threads import ThreadHop
from monstertruck_schemas.topics import DRIVE, GATE, Writer
from tests.bus_kit import gate_state, running_robot
from tests.unit.bus.test_zenoh_session import put, raw_session


def is_pythons() -> bool:
    """Whether the present thread is one of Python's own, not one of Zenoh's network."""
    return threading.get_native_id() in {thread.native_id for thread in threading.enumerate()}


async def test_messages_are_taken_in_a_network_thread_whose_state_is_kept():
    pythons: set[bool] = set()
    memory = threading.local()
    counts: dict[int, list[int]] = {}

    def take(_: zenoh.Sample) -> None:
        pythons.add(is_pythons())
        memory.count = getattr(memory, "count", 0) + 1
        counts.setdefault(threading.get_native_id(), []).append(memory.count)

    async with running_robot() as robot:
        with raw_session(robot.endpoint) as reader, raw_session(robot.endpoint) as writer:
            reader.declare_subscriber("mt/truck/chatter", in_network_thread(take))
            while sum(map(len, counts.values())) < 20:
                put(writer, "mt/truck/chatter", b"x")
                await asyncio.sleep(0.01)
    assert pythons == {False}
    for counted in counts.values():
        assert counted == list(range(1, len(counted) + 1))


async def test_clients_take_messages_there(monkeypatch):
    pythons: set[bool] = set()
    put_in_queue = ThreadHop.put

    def noted(hop: ThreadHop[bytes], item: bytes) -> None:
        pythons.add(is_pythons())
        put_in_queue(hop, item)

    monkeypatch.setattr(ThreadHop, "put", noted)
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client, asyncio.timeout(5):
        with client.subscribe(DRIVE, fifo(10)) as messages, raw_session(robot.endpoint) as writer:
            while not pythons:
                put(writer, DRIVE.key("truck"), b"{}")
                await asyncio.sleep(0.01)
            assert not messages.drain()
    assert pythons == {False}


STATION = """
import asyncio, sys
from pathlib import Path
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas.topics import GATE

async def main():
    async with TruckClient(endpoint=sys.argv[1]) as client:
        await client.subscribe(GATE, fifo(1)).next()
        print(*{path.read_text().partition("-")[0].strip() for path in Path("/proc/self/task").glob("*/comm")})

asyncio.run(main())
"""


async def station(endpoint: str, threads: str) -> set[str]:
    """Kinds of Zenoh's threads in a process that heard the gate."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", STATION, endpoint),
        stdout=asyncio.subprocess.PIPE,
        env=os.environ | {"ZENOH_RUNTIME": threads},
    )
    answer, _ = await process.communicate()
    return set(answer.decode().split())


async def test_the_threads_that_read_a_stations_link_can_also_watch_it():
    page = (Path(__file__).parents[3] / "docs/zenoh.md").read_text()
    (little_delay,) = re.findall(r"`ZENOH_RUNTIME=(\(.*?\))`", page)
    async with running_robot() as robot, asyncio.timeout(20):
        robot.bus.publisher(GATE, Writer.GATE).put(gate_state(1))
        usual, quick = [await station(robot.endpoint, threads) for threads in ("()", little_delay)]
    assert "app" in usual
    assert quick == usual - {"app"}
