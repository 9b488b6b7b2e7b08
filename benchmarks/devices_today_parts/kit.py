"""A driver at its emulator on the virtual clock: its output, and disturbances of its link."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, Generic, TypeVar

from monstertruck_drivers.cable import MemoryPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceError, WrongDeviceError
from monstertruck_schemas.base import Message

M = TypeVar("M", bound=Message)
STRANGER = b"$C320.5P0.2R-18.3T19.0*3C\r\n"
"""What another device says."""
PAUSE = 0.1
"""Seconds between two sessions."""


class Newest(Generic[M]):
    """Publisher that keeps all messages."""

    def __init__(self) -> None:
        self.kept: list[M] = []

    def next_seq(self) -> int:
        """Sequence number of the next message."""
        return len(self.kept)

    def put(self, message: M) -> None:
        """Keep a message."""
        self.kept.append(message)


class Bench:
    """A driver, whose sessions follow each other, and its emulator.

    Args:
        clock: source of time.
        emulator: emulator of the device.
        make: creates the driver from its port and the sink of events.
    """

    def __init__(self, clock: VirtualClock, emulator: Any, make: Callable[[MemoryPort, Any], Any]) -> None:
        self.clock = clock
        self.port = MemoryPort("/dev/bench")
        self.emulator = emulator
        self.driver = make(self.port, lambda *_, **__: None)
        self.ended: list[DeviceError] = []
        """Why sessions ended."""

    async def serve(self) -> None:
        """Run one session after the other."""
        while True:
            try:
                await self.driver.run(lambda: None)
            except DeviceError as error:
                self.ended.append(error)
                await self.clock.sleep(PAUSE)


@contextlib.asynccontextmanager
async def running(*jobs: Coroutine[Any, Any, Any]) -> Any:
    """Run jobs in the background."""
    tasks = [asyncio.create_task(job) for job in jobs]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


B = TypeVar("B", bound=Bench)
R = TypeVar("R")


def on_bench(make: Callable[[VirtualClock], B], test: Callable[[B], Awaitable[R]]) -> R:
    """Return the result of ``test`` on a bench whose emulator runs and is plugged in."""

    async def main(clock: VirtualClock) -> R:
        bench = make(clock)
        async with running(bench.emulator.run(bench.port.device)):
            await asyncio.sleep(0)
            bench.port.plug()
            return await test(bench)

    return run_virtual(main, start=SECOND)


async def stranger_refused(bench: Bench) -> bool:
    """Whether the driver refuses a different device on its port."""

    async def talk() -> None:
        while True:
            bench.port.device.write(STRANGER)
            await bench.clock.sleep(0.03)

    bench.port.plug()
    async with running(talk()):
        try:
            await bench.driver.run(lambda: None)
        except WrongDeviceError:
            return True
        except DeviceError:
            return False
    return False


LINE = {
    "messages lost": ("lose_rate", 0.1),
    "bytes lost": ("drop_rate", 0.005),
    "bytes flipped": ("flip_rate", 0.005),
    "single bytes": ("chunk", 1),
}
"""Faults of the line, by the attribute that makes them."""


async def survived(bench: Bench, healthy: Callable[[], bool], *stalls: tuple[str, str]) -> dict[str, bool]:
    """Return, for each disturbance, whether the driver serves again.

    Args:
        bench: bench whose ``serve`` is running.
        healthy: whether the device works.
        stalls: faults of the emulator: commands to start and end each.
    """
    found: dict[str, bool] = {}
    faults, clock = bench.port.device.faults, bench.clock
    for name, (attribute, value) in LINE.items():
        before = getattr(faults, attribute)
        setattr(faults, attribute, value)
        await clock.sleep(3.0)
        setattr(faults, attribute, before)
        await clock.sleep(5.0)
        found[name] = healthy()
    for start, end in stalls:
        bench.emulator.inject(*start.split())
        await clock.sleep(2.0)
        bench.emulator.inject(*end.split())
        await clock.sleep(5.0)
        found[start] = healthy()
    bench.port.unplug()
    await clock.sleep(1.0)
    bench.port.plug()
    await clock.sleep(5.0)
    found["unplugged"] = healthy()
    return found


def score(found: dict[str, bool]) -> str:
    """Format the number of passed tests, with the names of the failed ones."""
    failed = [name for name, passed in found.items() if not passed]
    return f"{len(found) - len(failed)}/{len(found)}" + (f" ({', '.join(failed)})" if failed else "")
