"""What a service publishes, reports and hears, for tests without a bus."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.computer import Computer, Machine, Sysfs
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

M = TypeVar("M", bound=Message)


def emulated_computer(root: Path, clock: Clock) -> Computer:
    """The computer whose files are in ``root``; they are read at once, so that the virtual clock goes on."""
    return Computer(Machine(clock, Sysfs(root / "sys"), root / "dev", inline), root)


async def read_until(link: Link, end: bytes) -> bytes:
    """Bytes up to and including ``end``."""
    data = b""
    while not data.endswith(end):
        data += await link.exactly(1)
    return data


class Kept(Generic[M]):
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[M] = []
        self._more = asyncio.Event()

    @property
    def last(self) -> M:
        return self.kept[-1]

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: M) -> None:
        self.kept.append(message)
        self._more.set()

    async def total(self, wanted: int) -> None:
        """Wait until so many messages have come in all."""
        async with asyncio.timeout(60):
            while len(self.kept) < wanted:
                self._more.clear()
                await self._more.wait()

    async def count(self, more: int) -> None:
        """Wait for so many messages from now on."""
        await self.total(len(self.kept) + more)


class Events:
    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str, dict[str, Any]]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, text, values))

    def reasons(self) -> list[Reason]:
        return [reason for reason, *_ in self.kept]


@contextlib.asynccontextmanager
async def background(coroutine: Coroutine[Any, Any, Any]) -> AsyncIterator[asyncio.Task[Any]]:
    """Runs while the test runs; a failure is raised at the end."""
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


class Driver(Protocol):
    async def run(self, ready: Callable[[], None]) -> None: ...


class DriverRig:
    """One driver on its port, and what came out; a device's own rig adds the emulator and the topics."""

    driver: Driver

    def __init__(self, clock: Clock, port: EmulatedPort | None) -> None:
        self.clock = clock
        self.port: EmulatedPort = port or MemoryPort("/dev/test")
        self.events = Events()
        self.ready_at: list[int] = []

    def ready(self) -> None:
        self.ready_at.append(self.clock.now())

    async def session(self) -> None:
        """One session of the driver, to its end."""
        await self.driver.run(self.ready)

    def driving(self) -> contextlib.AbstractAsyncContextManager[asyncio.Task[Any]]:
        """The driver serves in the background; a failure of its session is raised at the end."""
        return background(self.session())

    async def settle(self, seconds: float) -> None:
        await self.clock.sleep(seconds)

    @contextlib.asynccontextmanager
    async def plugged_in(self, *devices: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """The emulator, and what else belongs to the bench, runs and the cable is in."""
        async with contextlib.AsyncExitStack() as stack:
            for device in devices:
                await stack.enter_async_context(background(device))
            await asyncio.sleep(0)  # the emulator watches its plug now
            self.port.plug()
            try:
                yield
            finally:
                self.port.unplug()
