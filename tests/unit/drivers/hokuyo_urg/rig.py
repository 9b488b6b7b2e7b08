"""Bench for the scanner: emulator, port, driver and what came out of it."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.driver import HokuyoDriver
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan

STEP_NS = SECOND / 10 / 1024


class Pattern:
    """A revolution that tells its number, with every error code, and keeps the times it was asked for."""

    def __init__(self) -> None:
        self.times: list[int] = []

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        self.times.append(time_ns)
        values = 500 + np.arange(769, dtype=np.int32) * 5 + len(self.times)
        values[100:120] = np.arange(20)
        return values


class Scans:
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[LaserScan] = []
        self._seq = -1
        self._more = asyncio.Event()

    def next_seq(self) -> int:
        self._seq += 1
        return self._seq

    def put(self, message: LaserScan) -> None:
        self.kept.append(message)
        self._more.set()

    async def count(self, wanted: int) -> None:
        while len(self.kept) < wanted:
            self._more.clear()
            await self._more.wait()


@dataclass
class Events:
    """Event sink that keeps everything."""

    kept: list[tuple[Reason, Severity, str, dict[str, Any]]] = field(default_factory=list)

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, text, values))

    def reasons(self) -> list[Reason]:
        return [kept[0] for kept in self.kept]


class Rig:
    """Everything on one bench."""

    def __init__(self, clock: Clock, port: EmulatedPort, emulator: HokuyoEmulator, config: HokuyoConfig) -> None:
        self.clock = clock
        self.port = port
        self.emulator = emulator
        self.out = Scans()
        self.events = Events()
        self.ready_at: list[int] = []
        self.driver = HokuyoDriver(config, port, clock, self.out, self.events)

    async def session(self) -> None:
        await self.driver.run(lambda: self.ready_at.append(self.clock.now()))

    @contextlib.asynccontextmanager
    async def driving(self) -> AsyncIterator["asyncio.Task[None]"]:
        """A running session, cancelled at the end; its failure surfaces."""
        task = asyncio.create_task(self.session())
        try:
            yield task
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


@contextlib.asynccontextmanager
async def bench(
    clock: Clock,
    source: Any = None,
    *,
    port: EmulatedPort | None = None,
    config: HokuyoConfig | None = None,
    emulator: HokuyoEmulator | None = None,
    **kwargs: Any,
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running."""
    port = port or MemoryPort("lidar")
    emulator = emulator or HokuyoEmulator(clock, source or Pattern(), **kwargs)
    port.plug()
    device = asyncio.create_task(emulator.run(port.device))
    try:
        yield Rig(clock, port, emulator, config or HokuyoConfig())
    finally:
        port.unplug()
        device.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await device


async def talk(port: MemoryPort, clock: Clock, *requests: str, wait: float = 0.05) -> bytes:
    """What a plain terminal would see: send each line, collect what comes within ``wait`` seconds each."""
    heard = b""
    async with await port.open() as link:
        for line in requests:
            link.write(line.encode() + b"\n")
            with contextlib.suppress(TimeoutError):
                async with clock.deadline(wait):
                    while True:
                        heard += await link.read()
    return heard
