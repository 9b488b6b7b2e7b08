"""Bench for the stabiliser's servos: emulated bus, port, driver, what was wished and what came out."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from typing import Any

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.driver import Ax12Driver
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.ax12.protocol import BAUD, ID, STEP, Packet, Parser
from monstertruck_drivers.ax12.unit import Unit
from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import StabiliserFeedback

LEVEL = {1: 511.0, 2: 204.0}
"""Shafts with the lidar level."""
FAST = Ax12Config(usb_latency=0.001)


class Kept:
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[StabiliserFeedback] = []

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: StabiliserFeedback) -> None:
        self.kept.append(message)


class Events:
    def __init__(self) -> None:
        self.kept: list[tuple[Reason, Severity, str, dict[str, Any]]] = []

    def __call__(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Any) -> None:
        self.kept.append((reason, severity, text, values))

    def reasons(self) -> list[Reason]:
        return [reason for reason, *_ in self.kept]


@contextlib.asynccontextmanager
async def background(coroutine: Coroutine[Any, Any, None]) -> AsyncIterator[asyncio.Task[None]]:
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


class Rig:
    def __init__(self, clock: Clock, port: EmulatedPort, config: Ax12Config, **bus: Any) -> None:
        self.clock = clock
        self.port = port
        self.config = config
        self.bus = Ax12Bus(clock, **({"positions": LEVEL} | bus))
        self.commands: Mailbox[StabiliserCommand] = Mailbox(latest())
        self.out = Kept()
        self.events = Events()
        self.ready_at: list[int] = []
        self.driver = Ax12Driver(config, port, clock, self.commands, self.out, self.events)
        self._seq = 0

    def ready(self) -> None:
        self.ready_at.append(self.clock.now())

    async def session(self) -> None:
        await self.driver.run(self.ready)

    @contextlib.asynccontextmanager
    async def driving(self) -> AsyncIterator[asyncio.Task[None]]:
        """The driver serves in the background; a failure of its session is raised at the end."""
        async with background(self.session()) as task:
            yield task

    def wish(self, pitch: float, roll: float, age: float = 0.0) -> None:
        now = self.clock.now() - round(age * 1e9)
        self.commands.put(StabiliserCommand(stamp=now, received=now, seq=self._seq, pitch=pitch, roll=roll))
        self._seq += 1

    def joint(self, name: str) -> float:
        """True joint angle, rad."""
        joint = self.config.pitch if name == "pitch" else self.config.roll
        shaft = self.bus.angle(joint.id, self.clock.now())
        return joint.angle(shaft / STEP)

    def unit(self, ident: int) -> Unit:
        return next(unit for unit in self.bus.units if unit.get(ID) == ident)

    async def settle(self, seconds: float) -> None:
        await self.clock.sleep(seconds)


class Host:
    """Talks bytes to the bus, without driver."""

    def __init__(self, link: Link, clock: Clock) -> None:
        self._link = link
        self._clock = clock

    async def raw(self, request: bytes, wait: float = 0.02) -> bytes:
        """Everything that comes within ``wait`` seconds."""
        self._link.discard()
        self._link.write(request)
        await self._clock.sleep(wait)
        data = bytes(self._link._buffer)
        self._link.discard()
        return data

    async def ask(self, request: bytes, wait: float = 0.02) -> list[Packet]:
        return Parser().feed(await self.raw(request, wait))

    async def status(self, request: bytes) -> Packet:
        (packet,) = await self.ask(request)
        return packet


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: Ax12Config | None = None, *, port: EmulatedPort | None = None, **bus: Any
) -> AsyncIterator[Rig]:
    """Bus plugged in and running; the driver is started by the test."""
    rig = Rig(clock, port or MemoryPort("/dev/test"), config or FAST, **bus)
    rig.port.device.baud = BAUD
    async with background(rig.bus.run(rig.port.device)):
        rig.port.plug()
        try:
            yield rig
        finally:
            rig.port.unplug()


@contextlib.asynccontextmanager
async def wire(clock: Clock, **bus: Any) -> AsyncIterator[tuple[Ax12Bus, Host]]:
    """Bus and a host that speaks bytes."""
    async with bench(clock, **bus) as rig, await rig.port.open() as link:
        yield rig.bus, Host(link, clock)
