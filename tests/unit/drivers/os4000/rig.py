"""Bench for the compass: a world to point at, emulator, port, driver and what came out."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any

from monstertruck_drivers.base import CompassReading
from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.driver import Os4000Driver
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_runtime.clock import Clock
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude

POSE = CompassReading(
    heading_deg=123.44,
    pitch_deg=5.0,
    roll_deg=-7.0,
    temperature_c=21.5,
    field=(-140.0, 210.0, -390.0),
    acceleration=(0.087, -0.122, 0.989),
)


class Table:
    """Attitude source that a test turns by hand; keeps the times it was asked for."""

    def __init__(self) -> None:
        self.reading = POSE
        self.times: list[int] = []

    def turn(self, **values: Any) -> None:
        self.reading = replace(self.reading, **values)

    def compass(self, time_ns: int) -> CompassReading:
        self.times.append(time_ns)
        return self.reading


class Attitudes:
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[Attitude] = []
        self._seq = -1
        self._more = asyncio.Event()

    def next_seq(self) -> int:
        self._seq += 1
        return self._seq

    def put(self, message: Attitude) -> None:
        self.kept.append(message)
        self._more.set()

    async def count(self, more: int) -> None:
        """Wait for so many messages from now on."""
        wanted = len(self.kept) + more
        async with asyncio.timeout(60):
            while len(self.kept) < wanted:
                self._more.clear()
                await self._more.wait()


class Events:
    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **_: Any) -> None:
        self.kept.append((reason, severity, text))

    def reasons(self) -> list[Reason]:
        return [reason for reason, *_ in self.kept]


class Rig:
    def __init__(self, clock: Clock, port: EmulatedPort, config: Os4000Config, **emulator: Any) -> None:
        self.clock = clock
        self.port = port
        self.table = Table()
        self.emulator = Os4000Emulator(clock, self.table, **emulator)
        self.out = Attitudes()
        self.events = Events()
        self.ready_at: list[int] = []
        self.driver = Os4000Driver(config, port, clock, self.out, self.events)

    async def session(self) -> None:
        """One session of the driver, to its end."""
        await self.driver.run(lambda: self.ready_at.append(self.clock.now()))

    def driving(self) -> "contextlib.AbstractAsyncContextManager[asyncio.Task[Any]]":
        """The driver serves in the background; a failure of its session is raised at the end."""
        return background(self.session())

    @property
    def sent(self) -> bytes:
        """What the host wrote."""
        return bytes(self.emulator.received)


@contextlib.asynccontextmanager
async def background(coroutine: Any) -> AsyncIterator[asyncio.Task[Any]]:
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: Os4000Config | None = None, *, port: EmulatedPort | None = None, **emulator: Any
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running; the driver is started by the test."""
    rig = Rig(clock, port or MemoryPort("/dev/test"), config or Os4000Config(), **emulator)
    async with background(rig.emulator.run(rig.port.device)):
        await asyncio.sleep(0)  # the emulator watches its plug now
        rig.port.plug()
        try:
            yield rig
        finally:
            rig.port.unplug()
