"""Bench for the stabiliser's servos: emulated bus, port, driver, what was wished and what came out."""

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.driver import Ax12Driver
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.ax12.protocol import AX12_BAUD, ID, STEP, Ax12Parser, Packet, Present
from monstertruck_drivers.ax12.unit import Unit
from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import StabiliserFeedback
from tests.unit.drivers.kit import DriverRig, Kept

LEVEL = {1: 511.0, 2: 204.0}
"""Shafts with the lidar level."""
FAST = Ax12Config(usb_latency=0.001, rate=50.0)


class Rig(DriverRig):
    def __init__(self, clock: Clock, port: EmulatedPort | None, config: Ax12Config, **bus: Any) -> None:
        super().__init__(clock, port)
        self.config = config
        self.bus = Ax12Bus(clock, **({"positions": LEVEL} | bus))
        self.commands: Mailbox[StabiliserCommand] = Mailbox(latest())
        self.out: Kept[StabiliserFeedback] = Kept()
        self.driver = Ax12Driver(config, self.port, clock, self.commands, self.out, self.events)
        self._seq = 0

    def request(self, pitch: float, roll: float, age: float = 0.0) -> None:
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
        return Ax12Parser().feed(await self.raw(request, wait))

    async def status(self, request: bytes) -> Packet:
        (packet,) = await self.ask(request)
        return packet


@contextlib.asynccontextmanager
async def bench(
    clock: Clock,
    config: Ax12Config | None = None,
    *,
    port: EmulatedPort | None = None,
    host_baud: int = AX12_BAUD,
    **bus: Any,
) -> AsyncIterator[Rig]:
    """Bus plugged in and running; the driver is started by the test."""
    rig = Rig(clock, port, config or FAST, host_baud=host_baud, **bus)
    rig.port.device.baud = host_baud
    async with rig.plugged_in(rig.bus.run(rig.port.device)):
        yield rig


@contextlib.asynccontextmanager
async def wire(clock: Clock, **bus: Any) -> AsyncIterator[tuple[Ax12Bus, Host]]:
    """Bus and a host that speaks bytes."""
    async with bench(clock, **bus) as rig, await rig.port.open() as link:
        yield rig.bus, Host(link, clock)


def on_bench(test, config: Ax12Config | None = None, **options):
    """Run ``test(rig)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config, **options) as rig:
            await test(rig)

    run_virtual(main)


def requests(rig: Rig) -> list[p.Packet]:
    """Everything the host sent so far."""
    return p.Ax12Parser().feed(bytes(rig.bus.received))


def on_wire(test, **options):
    """Run ``test(bus, host, clock)`` on the virtual clock."""

    async def main(clock: VirtualClock) -> None:
        async with wire(clock, **({"positions": {}} | options)) as (bus, host):
            await test(bus, host, clock)

    run_virtual(main)


def write(unit: int, register: p.Register, value: int) -> bytes:
    return p.write(unit, register, register.encode(value))


async def value(host: Host, unit: int, register: p.Register) -> int:
    packet = await host.status(p.read(unit, register, register.size))
    return int.from_bytes(packet.params, "little")


async def present(host: Host, unit: int = 1) -> Present:
    return Present.decode((await host.status(p.read(unit, p.PRESENT_POSITION, p.PRESENT_SIZE))).params)


def instruction(unit: int, code: p.Instruction, data: bytes = b"") -> bytes:
    """A packet of the host that the driver has no use for."""
    return Packet(unit, code, data).encode()


def reg_write(unit: int, start: p.Register, data: bytes) -> bytes:
    """As ``write``, but carried out at the next ``ACTION``."""
    return instruction(unit, p.Instruction.REG_WRITE, bytes((start.address,)) + data)
