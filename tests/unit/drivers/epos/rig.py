"""Bench for the drive controller: emulator, port, driver, a gate that talks, and what came out."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any, Generic, TypeVar

import numpy as np

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import RESTART_POLICY, EposDriver
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import Exchanger
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.epos.policy import RAD_S_PER_RPM
from monstertruck_drivers.epos.protocol import Opcode
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual
from monstertruck_runtime.service import supervise
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

M = TypeVar("M")
BAUD = 38_400


class Kept(Generic[M]):
    """Publisher that keeps everything."""

    def __init__(self) -> None:
        self.kept: list[M] = []

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: M) -> None:
        self.kept.append(message)


class Commands:
    """Latest-only subscription that a test fills."""

    def __init__(self) -> None:
        self.latest: DriveCommand | None = None
        self.drops = 0
        self._new = asyncio.Event()

    def put(self, command: DriveCommand) -> None:
        self.latest = command
        self._new.set()

    async def next(self) -> DriveCommand:
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
    """Sends drive commands at 50 Hz while ``talking``, and at once when told."""

    def __init__(self, clock: Clock, commands: Commands) -> None:
        self.action = DriveAction.DISABLE
        self.rpm = 0.0
        self.talking = True
        self._clock = clock
        self._commands = commands
        self._seq = 0

    def say(self, action: DriveAction, rpm: float = 0.0) -> None:
        """``rpm`` in the robot's sign."""
        self.action, self.rpm = action, rpm
        now = self._clock.now()
        velocity = rpm * RAD_S_PER_RPM
        self._seq += 1
        self._commands.put(
            DriveCommand(stamp=now, received=now, seq=self._seq, action=action, speed=0.0, motor_velocity=velocity)
        )

    async def run(self) -> None:
        while True:
            if self.talking:
                self.say(self.action, self.rpm)
            await self._clock.sleep(0.02)


class Rig:
    def __init__(self, clock: Clock, port: EmulatedPort, config: EposConfig, **emulator: Any) -> None:
        self.clock = clock
        self.port = port
        self.motor = FreeMotor()
        self.emulator = EposEmulator(clock, self.motor, **emulator)
        self.commands = Commands()
        self.gate = Gate(clock, self.commands)
        self.out: Kept[DriveFeedback] = Kept()
        self.events = Events()
        self.ready_at: list[int] = []
        self.health: list[ServiceHealth] = []
        self.driver = EposDriver(config, port, clock, self.commands, self.out, self.events)

    def ready(self) -> None:
        self.ready_at.append(self.clock.now())

    async def session(self) -> None:
        """One session of the driver, to its end."""
        await self.driver.run(self.ready)

    @contextlib.asynccontextmanager
    async def driving(self) -> AsyncIterator[asyncio.Task[Any]]:
        """One session in the background; a failure of it is raised at the end."""
        async with background(self.session()) as task:
            yield task

    @contextlib.asynccontextmanager
    async def supervised(self) -> AsyncIterator[asyncio.Task[Any]]:
        """Session after session in the background."""
        rng = np.random.default_rng(1)
        service = supervise(self.driver, RESTART_POLICY, self.clock, self.health.append, rng)
        async with background(service) as task:
            yield task

    @property
    def shaft_rpm(self) -> float:
        """True speed, controller's sign."""
        return self.motor.reading(self.clock.now()).rpm

    @property
    def newest(self) -> DriveFeedback:
        return self.out.kept[-1]

    async def settle(self, seconds: float) -> None:
        await self.clock.sleep(seconds)

    async def until(self, true: Callable[[], bool], limit: float = 5.0) -> float:
        """Wait for a condition; seconds it took."""
        start = self.clock.now()
        while not true():
            took = (self.clock.now() - start) / SECOND
            assert took < limit, f"not within {limit} s"
            await self.clock.sleep(0.001)
        return (self.clock.now() - start) / SECOND

    async def drive(self, rpm: float) -> None:
        """Run until the shaft has this speed (robot's sign)."""
        self.gate.say(DriveAction.RUN, rpm)
        await self.until(lambda: bool(self.out.kept))
        await self.until(lambda: abs(self.shaft_rpm + rpm) < 1 and self.newest.mode is DriveMode.ENABLED)
        await self.settle(0.2)

    def writes(self, entry: od.Entry) -> list[tuple[int, int]]:
        """(instant, value) of every write of an object that arrived whole."""
        return [
            (instant, entry.decode(frame.words[2] | frame.words[3] << 16))
            for instant, frame in self.emulator.frames
            if frame.opcode == Opcode.WRITE and frame.words[0] == entry.index
        ]


@contextlib.asynccontextmanager
async def background(coroutine: Coroutine[Any, Any, Any]) -> AsyncIterator[asyncio.Task[Any]]:
    task = asyncio.create_task(coroutine)
    try:
        yield task
    finally:
        if not task.done():  # otherwise the test has seen how it ended
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: EposConfig | None = None, *, port: EmulatedPort | None = None, **emulator: Any
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running, gate talking (DISABLE at first); the driver is started by the test."""
    rig = Rig(clock, port or MemoryPort("/dev/test"), config or EposConfig(), **emulator)
    rig.port.device.baud = BAUD
    async with background(rig.emulator.run(rig.port.device)), background(rig.gate.run()):
        await asyncio.sleep(0)
        rig.port.plug()
        try:
            yield rig
        finally:
            rig.port.unplug()


def on_bench(
    test: Callable[[Rig], Coroutine[Any, Any, None]], config: EposConfig | None = None, **emulator: Any
) -> None:
    """Run ``test(rig)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config, **emulator) as rig:
            await test(rig)

    run_virtual(main)


def on_cable(test: Callable[[EposEmulator, Link, VirtualClock], Coroutine[Any, Any, None]], **options: Any) -> None:
    """Run ``test(emulator, link, clock)``: raw bytes, without a driver, unpaced."""

    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("/dev/test")
        emulator = EposEmulator(clock, **options)
        async with background(emulator.run(port.device)):
            await asyncio.sleep(0)
            port.plug()
            async with await port.open() as link:
                await test(emulator, link, clock)

    run_virtual(main)


def on_line(test: Callable[[EposEmulator, Exchanger, VirtualClock], Coroutine[Any, Any, None]], **options: Any) -> None:
    """Run ``test(emulator, line, clock)``: object access without a driver, unpaced."""

    async def main(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        line = Exchanger(link, clock, 1)
        try:
            await test(emulator, line, clock)
        finally:
            await line.close()

    on_cable(main, **options)
