"""Messages taken in the thread that reads the network."""

import asyncio
import os
import sys
import threading
from pathlib import Path

import zenoh

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.threads import ThreadHop
from monstertruck_runtime.zenoh_threads import VARIABLE, in_network_thread
from monstertruck_schemas.topics import DRIVE
from tests.bus_kit import running_robot
from tests.unit.bus.test_zenoh_session import put, raw_session


def place() -> str:
    """Of whose threads the present one is, by its name."""
    return Path(f"/proc/self/task/{threading.get_native_id()}/comm").read_text().partition("-")[0]


async def test_messages_are_taken_in_a_network_thread_whose_state_is_kept():
    places: set[str] = set()
    memory = threading.local()
    counts: dict[int, list[int]] = {}

    def take(_: zenoh.Sample) -> None:
        places.add(place())
        memory.count = getattr(memory, "count", 0) + 1
        counts.setdefault(threading.get_native_id(), []).append(memory.count)

    async with running_robot() as robot:
        with raw_session(robot.endpoint) as reader, raw_session(robot.endpoint) as writer:
            reader.declare_subscriber("mt/truck/chatter", in_network_thread(take))
            while sum(map(len, counts.values())) < 20:
                put(writer, "mt/truck/chatter", b"x")
                await asyncio.sleep(0.01)
    assert places == {"rx"}
    for counted in counts.values():
        assert counted == list(range(1, len(counted) + 1))


async def test_clients_take_messages_there(monkeypatch):
    places: set[str] = set()
    put_in_queue = ThreadHop.put

    def noted(hop: ThreadHop[bytes], item: bytes) -> None:
        places.add(place())
        put_in_queue(hop, item)

    monkeypatch.setattr(ThreadHop, "put", noted)
    async with running_robot() as robot, TruckClient(endpoint=robot.endpoint) as client, asyncio.timeout(5):
        with client.subscribe(DRIVE, fifo(10)) as messages, raw_session(robot.endpoint) as writer:
            while not places:
                put(writer, DRIVE.key("truck"), b"{}")
                await asyncio.sleep(0.01)
            assert not messages.drain()
    assert places == {"rx"}


STATION = """
import asyncio, os, sys
from pathlib import Path
from monstertruck_runtime.client import TruckClient

async def main():
    async with TruckClient(endpoint=sys.argv[1]):
        names = {path.read_text().partition("-")[0] for path in Path("/proc/self/task").glob("*/comm")}
    print("app" in names, "rx" in names, os.environ.get("ZENOH_RUNTIME"))

asyncio.run(main())
"""


async def station(endpoint: str, **environment: str) -> str:
    """Of a station's own process: whether threads watch links or read them, and what programs it starts inherit."""
    command = (sys.executable, "-c", STATION, endpoint)
    inherited = {name: value for name, value in os.environ.items() if name != VARIABLE}
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, env=inherited | environment
    )
    answer, _ = await process.communicate()
    return answer.decode().strip()


async def test_a_stations_links_are_watched_by_the_threads_that_read_them():
    async with running_robot() as robot, asyncio.timeout(20):
        assert await station(robot.endpoint) == "False True None"


async def test_what_the_user_says_of_zenohs_threads_stands():
    own = "(rx: (worker_threads: 3))"
    async with running_robot() as robot, asyncio.timeout(20):
        assert await station(robot.endpoint, ZENOH_RUNTIME=own) == f"True True {own}"
