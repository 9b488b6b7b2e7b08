"""The two ends of ``bus.py``: scans to and fro over Zenoh, as typed messages or plain bytes.

    python bus_peers.py typed|raw|direct ping|echo HERE THERE

``typed``: message object to bus, bridge and Zenoh; Zenoh to client and a message object awaited in asyncio.
``raw``: plain bytes, put and awaited in asyncio, received through zenoh-python's default handler. ``direct``: the same,
received in the thread that reads the network, as in the product. Every end listens at HERE, as a robot, which sends,
and connects to THERE, as a station, which receives. ``ping`` reads lines ``COUNT RATE`` (rate 0: one after the other)
from its standard input and answers with a JSON list of round trips in ns.
"""

import asyncio
import json
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import numpy as np
import zenoh

from monstertruck_runtime import wire
from monstertruck_runtime.client import in_network_thread
from monstertruck_runtime.clock import WallClock, run_wall
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.memory import settle
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from monstertruck_schemas.topics import SCAN, Writer
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig, listeners, session_config
from monstertruckd.bus.zenoh_session import ZenohBridge
from monstertruckd.tools.demo.runs import connect

BEAMS = 682
RANGES = np.random.default_rng(1).uniform(0.1, 5.5, BEAMS)
CODES = np.full(BEAMS, VALID_BEAM, np.uint8)
for _array in (RANGES, CODES):
    _array.flags.writeable = False
TIMEOUT = 5.0
OTHER = {"ping": "echo", "echo": "ping"}


def scan(number: int, stamp: int) -> LaserScan:
    """Return a scan like a driver's."""
    return LaserScan(
        stamp=stamp,
        received=stamp,
        seq=number,
        frame="lidar",
        start_angle=-2.086,
        end_angle=2.086,
        time_increment=0.1 / 1024,
        scan_time=0.1,
        range_min=0.02,
        range_max=5.6,
        ranges=RANGES,
        codes=CODES,
        tilt=0.01,
    )


@asynccontextmanager
async def typed(me: str, here: str, there: str) -> AsyncIterator[tuple[Callable[[LaserScan], None], Callable]]:
    """Put and receive functions of the product's own classes."""
    clock = WallClock()
    bus = Bus(clock)
    out = bus.publisher(SCAN, Writer.DRIVER)
    ready = asyncio.Event()
    bridge = ZenohBridge(me, bus, ZenohConfig(listen=(here,)), clock, Rpc(clock))
    await bridge.open()
    serving = asyncio.create_task(bridge.run(ready.set))
    await ready.wait()
    async with await connect(clock, OTHER[me], there) as client:
        with client.subscribe(SCAN, fifo(16)) as scans:
            yield out.put, scans.next
    serving.cancel()
    await asyncio.wait([serving])


class Inbox:
    """Minimal queue of plain bytes from Zenoh's thread to one waiting coroutine."""

    def __init__(self) -> None:
        self._items: deque[bytes] = deque(maxlen=16)
        self._loop = asyncio.get_running_loop()
        self._waiter: asyncio.Future[None] | None = None

    def put(self, sample: zenoh.Sample) -> None:
        """Take a sample; called by Zenoh."""
        self._items.append(sample.payload.to_bytes())
        self._loop.call_soon_threadsafe(self._wake)

    async def get(self) -> bytes:
        """Wait for the next message."""
        while not self._items:
            self._waiter = self._loop.create_future()
            await self._waiter
        return self._items.popleft()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


@asynccontextmanager
async def raw(
    me: str, here: str, there: str, receive: "Callable[[zenoh.Sample], None] | zenoh.handlers.Callback[zenoh.Sample]"
) -> AsyncIterator[Callable[[bytes], None]]:
    """Put function of plain bytes; ``receive`` is called with every sample of the other end.

    Sessions are configured like the product's: the comparison is of the code between session and reader.
    """
    server, client = ZenohConfig(listen=(here,)), ZenohConfig(connect=(there,))
    listening = zenoh.open(zenoh.Config.from_json5(session_config(me, server, listeners(server)[0])))
    dial = json.loads(session_config(me, client, listeners(client)[0], probe=True))
    while True:
        try:
            dialled = zenoh.open(zenoh.Config.from_json5(json.dumps(dial)))
            break
        except zenoh.ZError:
            await asyncio.sleep(0.2)
    with listening, dialled:
        dialled.declare_subscriber(SCAN.key(OTHER[me]), receive)
        yield listening.declare_publisher(
            SCAN.key(me), encoding=wire.encoding(SCAN), congestion_control=zenoh.CongestionControl.DROP
        ).put


async def pings(put: Callable[[int], None], receive: Callable[[], Awaitable[object]]) -> None:
    """Serve the commands on standard input."""
    await asyncio.sleep(3.0)  # until the other end has subscribed and settled
    print("ready", flush=True)
    while words := (await asyncio.to_thread(sys.stdin.readline)).split():
        count, rate = int(words[0]), float(words[1])
        times = []
        due = time.monotonic()
        for number in range(count):
            if rate:
                due += 1 / rate
                await asyncio.sleep(max(0.0, due - time.monotonic()))
            begin = time.perf_counter_ns()
            put(number)
            async with asyncio.timeout(TIMEOUT):
                await receive()
            times.append(time.perf_counter_ns() - begin)
        print(json.dumps(times), flush=True)


async def run(_clock: WallClock, kind: str, me: str, here: str, there: str) -> None:
    """Run one end until standard input ends (ping) or for ever (echo)."""
    payload = wire.encode(SCAN, scan(0, time.monotonic_ns()))
    async with AsyncExitStack() as stack:
        asyncio.get_running_loop().call_later(1.5, settle)  # as the daemon does
        if kind == "typed":
            put, receive = await stack.enter_async_context(typed(me, here, there))
            if me == "ping":
                await pings(lambda number: put(scan(number, time.monotonic_ns())), receive)
            while True:
                put(await receive())
        inbox = Inbox()
        take = in_network_thread(inbox.put) if kind == "direct" else inbox.put
        send = await stack.enter_async_context(raw(me, here, there, take))
        if me == "ping":
            await pings(lambda _: send(payload), inbox.get)
        while True:
            send(await inbox.get())


if __name__ == "__main__":
    run_wall(lambda clock: run(clock, *sys.argv[1:]))
