"""Bench for the servo controller: emulator, port, driver, what was commanded and what came out."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any, Generic, TypeVar

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_runtime.clock import Clock
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback
from tests.unit.drivers.kit import Latest

M = TypeVar("M")


class Kept(Generic[M]):
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[M] = []
        self._more = asyncio.Event()

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: M) -> None:
        self.kept.append(message)
        self._more.set()

    async def count(self, more: int) -> None:
        """Wait for so many messages from now on."""
        wanted = len(self.kept) + more
        async with asyncio.timeout(30):
            while len(self.kept) < wanted:
                self._more.clear()
                await self._more.wait()


class Commands:
    """Latest-only subscription that a test fills."""

    def __init__(self) -> None:
        self.latest: SteeringCommand | None = None
        self.drops = 0
        self._new = asyncio.Event()

    def put(self, command: SteeringCommand) -> None:
        self.latest = command
        self._new.set()

    async def next(self) -> SteeringCommand:
        await self._new.wait()
        self._new.clear()
        assert self.latest is not None
        return self.latest


class Events:
    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str, dict[str, Any]]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, text, values))

    def reasons(self) -> list[Reason]:
        return [reason for reason, *_ in self.kept]


class Gate:
    """Sends steering commands at 50 Hz while ``talking``."""

    def __init__(self, clock: Clock, commands: Commands) -> None:
        self.front = 0.0
        self.rear = 0.0
        self.talking = True
        self.deadman = True
        self._clock = clock
        self._commands = commands

    async def run(self) -> None:
        seq = 0
        while True:
            if self.talking:
                now = self._clock.now()
                command = SteeringCommand(
                    stamp=now,
                    received=now,
                    seq=seq,
                    front=0.0,
                    rear=0.0,
                    front_servo=self.front,
                    rear_servo=self.rear,
                    deadman=self.deadman,
                )
                self._commands.put(command)
                seq += 1
            await self._clock.sleep(0.02)


class Rig:
    def __init__(self, clock: Clock, port: EmulatedPort, config: MaestroConfig, **emulator: Any) -> None:
        self.clock = clock
        self.port = port
        self.outputs: list[tuple[int, bool, int]] = []
        self.emulator = MaestroEmulator(clock, usb=port, on_output=self._changed, **emulator)
        self.commands = Commands()
        self.gate = Gate(clock, self.commands)
        self.out: Kept[SteeringFeedback] = Kept()
        self.battery: Kept[Battery] = Kept()
        self.events = Events()
        self.ready_at: list[int] = []
        self.drive: Latest[DriveFeedback] = Latest()
        self.driver = MaestroDriver(
            config, port, clock, self.commands, self.out, self.battery, self.events, drive=self.drive
        )

    def _changed(self, channel: int, high: bool) -> None:
        self.outputs.append((channel, high, self.clock.now()))

    def ready(self) -> None:
        self.ready_at.append(self.clock.now())

    async def session(self) -> None:
        """One session of the driver, to its end."""
        await self.driver.run(self.ready)

    @contextlib.asynccontextmanager
    async def driving(self) -> AsyncIterator[None]:
        """The driver serves in the background; a failure of its session is raised at the end."""
        async with background(self.session()):
            yield

    def pulse(self, channel: int) -> float | None:
        return self.emulator.pulse_us(channel, self.clock.now())

    async def settle(self, seconds: float) -> None:
        await self.clock.sleep(seconds)


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
    clock: Clock,
    config: MaestroConfig | None = None,
    *,
    port: EmulatedPort | None = None,
    gate: bool = True,
    **emulator: Any,
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running, gate talking; the driver is started by the test."""
    rig = Rig(clock, port or MemoryPort("/dev/test"), config or MaestroConfig(), **emulator)
    rig.gate.talking = gate
    async with background(rig.emulator.run(rig.port.device)), background(rig.gate.run()):
        await asyncio.sleep(0)  # the emulator watches its plug now
        rig.port.plug()
        try:
            yield rig
        finally:
            rig.port.unplug()
