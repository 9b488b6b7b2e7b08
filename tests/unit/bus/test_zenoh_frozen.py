"""Stations that take nothing more: whatever they were to get, the truck goes on."""

import asyncio
import signal
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_schemas.topics import MAP, POSE, Writer
from tests.bus_kit import odometry, running_robot
from tests.unit.bus.test_zenoh_session import GRID

STATIONS = """
    import json, sys, time, zenoh
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [sys.argv[2]]}}))
    with zenoh.open(config) as session:
        if sys.argv[1] == "reader":
            session.declare_subscriber("mt/truck/**", lambda _: None)
        if sys.argv[1] == "asker":
            unread = session.declare_subscriber("mt/truck/**", zenoh.handlers.FifoChannel(4))
        print("ready", flush=True)
        while sys.argv[1] == "writer":
            session.put("mt/truck/chatter", b"x" * 60_000, congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.002)
        if sys.argv[1] == "asker":
            sys.stdin.readline()
            for _ in range(30):
                session.get("mt/truck/rpc/schema/**", lambda _: None, timeout=20.0)
            print("asked", flush=True)
        time.sleep(60)
"""


@asynccontextmanager
async def other_station(kind: str, endpoint: str) -> AsyncIterator["subprocess.Popen[bytes]"]:
    program = [sys.executable, "-c", textwrap.dedent(STATIONS), kind, endpoint]
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert await asyncio.to_thread(process.stdout.readline) == b"ready\n"
            yield process
        finally:
            process.kill()


async def test_a_frozen_reader_never_slows_the_truck():
    async with running_robot() as robot, other_station("reader", robot.endpoint) as reader:
        publisher = robot.bus.publisher(MAP, Writer.ESTIMATION)
        await asyncio.sleep(0.1)
        reader.send_signal(signal.SIGSTOP)
        took = []
        for _ in range(200):  # 32 MB, far more than any socket buffers
            start = WallClock().now()
            publisher.put(GRID)
            took.append(WallClock().now() - start)
    assert sorted(took)[100] < 2_000_000
    assert sum(took) < 2 * SECOND


async def test_frozen_readers_of_other_stations_messages_never_slow_the_truck():
    async with running_robot() as robot, AsyncExitStack() as stack:
        for _ in range(2):
            reader = await stack.enter_async_context(other_station("reader", robot.endpoint))
            await asyncio.sleep(0.2)
            reader.send_signal(signal.SIGSTOP)
        for _ in range(2):
            await stack.enter_async_context(other_station("writer", robot.endpoint))
        publisher = robot.bus.publisher(POSE, Writer.ESTIMATION)
        longest = 0
        for seq in range(300):
            start = WallClock().now()
            publisher.put(odometry(seq))
            longest = max(longest, WallClock().now() - start)
            await asyncio.sleep(0.01)
    assert longest < 0.1 * SECOND
