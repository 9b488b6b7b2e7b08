"""Bench for the drive controller: emulator, port, driver, a gate that talks, and what came out."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import numpy as np

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import RAD_S_PER_RPM, EposDriver
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import Exchanger
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.epos.protocol import (
    Control,
    Frame,
    Opcode,
    State,
    state_of,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.health import ServiceHealth
from monstertruck_schemas.sensor import DriveFeedback, DriveMode
from tests.unit.drivers.kit import DriverRig, Kept, background

BAUD = 38_400


class Gate:
    """Sends drive commands at 50 Hz while ``talking``, and at once when asked."""

    def __init__(self, clock: Clock, commands: Mailbox[DriveCommand]) -> None:
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


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: EposConfig, **emulator: Any) -> None:
        super().__init__(clock, port)
        self.motor = FreeMotor()
        self.emulator = EposEmulator(clock, self.motor, **emulator)
        self.commands: Mailbox[DriveCommand] = Mailbox(latest())
        self.gate = Gate(clock, self.commands)
        self.out: Kept[DriveFeedback] = Kept()
        self.health: list[ServiceHealth] = []
        self.driver = EposDriver(config, self.port, clock, self.commands, self.out, self.events)

    @contextlib.asynccontextmanager
    async def supervised(self) -> AsyncIterator[asyncio.Task[Any]]:
        """Session after session in the background."""
        rng = np.random.default_rng(1)
        service = supervise(self.driver, RestartPolicy(max_delay=0.5), self.clock, self.health.append, rng)
        async with background(service) as task:
            yield task

    @property
    def shaft_rpm(self) -> float:
        """True speed, controller's sign."""
        return self.motor.reading(self.clock.now()).rpm

    @property
    def newest(self) -> DriveFeedback:
        return self.out.kept[-1]

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

    def writes(self, entry: od.ObjectEntry) -> list[tuple[int, int]]:
        """(instant, value) of every write of an object that arrived whole."""
        return [
            (instant, entry.decode(frame.words[2] | frame.words[3] << 16))
            for instant, frame in self.emulator.frames
            if frame.opcode == Opcode.WRITE and frame.words[0] == entry.index
        ]


@contextlib.asynccontextmanager
async def bench(
    clock: Clock, config: EposConfig | None = None, *, port: EmulatedPort | None = None, **emulator: Any
) -> AsyncIterator[Rig]:
    """Emulator plugged in and running, gate talking (DISABLE at first); the driver is started by the test."""
    rig = Rig(clock, port, config or EposConfig(), **emulator)
    rig.port.device.baud = BAUD
    async with rig.plugged_in(rig.emulator.run(rig.port.device), rig.gate.run()):
        yield rig


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


def controls(rig: Rig) -> list[int]:
    return [value for _, value in rig.writes(od.CONTROLWORD)]


def targets(rig: Rig) -> list[int]:
    return [value for _, value in rig.writes(od.TARGET_VELOCITY)]


async def heard(link: Link, clock: VirtualClock, seconds: float) -> bytes:
    """Everything that comes within a time."""
    await clock.sleep(seconds)
    data = b""
    try:
        async with clock.deadline(0.0001):
            data = await link.read()
    except TimeoutError:
        pass
    return data


async def ask(link: Link, clock: VirtualClock, request: Frame) -> bytes:
    """Whole exchange by hand; the answer's body."""
    link.write(request.head)
    assert await link.exactly(1) == b"O"
    link.write(request.body)
    assert await link.exactly(2) == b"O\0"
    link.write(b"O")
    data = await heard(link, clock, 0.01)
    link.write(b"O")
    return data


async def state(line: Exchanger) -> State:
    return state_of(await line.read(od.STATUSWORD))


async def control(line: Exchanger, *words: int) -> None:
    for word in words:
        await line.write(od.CONTROLWORD, word)


async def enable(line: Exchanger, clock: VirtualClock, rpm: int = 0) -> None:
    await line.write(od.MODE, od.PROFILE_VELOCITY)
    await line.write(od.TARGET_VELOCITY, rpm)
    await control(line, Control.SHUTDOWN, Control.SWITCH_ON)
    await clock.sleep(0.31)
    await control(line, Control.ENABLE)
    await clock.sleep(0.31)
    assert await state(line) is State.ENABLED
