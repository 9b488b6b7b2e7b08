"""What can go wrong, drawn at random: one device's cable or self, a hub, a supply rail, the computer around them."""

import errno
import math
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import numpy as np

from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.config import Devices
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_sim.computer import EmulatedComputer
from monstertruck_sim.config import DrillConfig, SimConfig
from monstertruck_sim.console import Emulated
from monstertruck_sim.robot import SimulatedRobot
from monstertruck_sim.world.obstacles import Disc

SERIAL: Final = ("drive", "steering", "lidar", "compass", "stabiliser")
"""Roles that hang on a line of bytes."""
VITAL: Final = ("drive", "steering", "lidar", "compass")
"""The truck stops when one of these falls silent."""
HOT: Final = 92.0
"""Degrees Celsius of a computer whose fan stands."""
COOL: Final = 48.0


class Kind(StrEnum):
    """What a fault is, by its name in the report."""

    UNPLUG = "unplug"
    HUB_LOSS = "hub loss"
    GARBAGE = "garbage"
    BIT_ERRORS = "bit errors"
    STALL = "stall"
    SLOW = "slow"
    SHORT_WRITE = "short write"
    ECHO = "echo"
    RESET = "reset"
    BROWN_OUT = "brown-out"
    WRONG_DEVICE = "wrong device"
    FROZEN = "frozen value"
    CLOCK_JUMP = "clock jump"
    DISK_FULL = "disk full"
    RAIL_12V = "12 V lost"
    RAIL_SERVOS = "servo 5 V lost"
    RAIL_ELECTRONICS = "electronics rail lost"
    BATTERY_OFF = "battery disconnected"
    OBSTACLE = "obstacle"


class Disk(Protocol):
    """What can refuse to record."""

    def refuse(self, error: OSError) -> None:
        """Fail from now on."""
        ...


@dataclass(frozen=True, slots=True)
class Site:
    """What faults may lay hands on: the simulated side, never the daemon (but for its disk).

    Args:
        config: of the simulation.
        devices: of the robot.
        robot: world and emulators.
        computer: USB tree and cables.
        clock: time.
        disk: None where nothing records.
    """

    config: SimConfig
    devices: Devices
    robot: SimulatedRobot
    computer: EmulatedComputer
    clock: Clock
    disk: Disk | None = None

    def port(self, role: str) -> EmulatedPort:
        """The cable of a device."""
        return self.computer.ports[role]

    def say(self, role: str, *lines: str) -> None:
        """Words for the fault console of a device; nothing where the truck has none."""
        if role in self.robot.emulators:
            emulated = Emulated(self.robot.emulators[role], self.port(role))
            for line in lines:
                emulated.command(line.split())

    def heat(self, degrees: float) -> None:
        """Temperature of the computer, where it is watched."""
        if "host" in self.robot.monitored:
            self.robot.monitored["host"].inject("temperature", str(degrees))

    def lose_hubs(self, *hubs: str) -> None:
        """Hubs drop off the bus."""
        for hub in hubs:
            self.computer.usb.lose_hub(hub)

    async def return_hubs(self, *hubs: str) -> None:
        """They come back, one after the other."""
        for hub in hubs:
            await self.computer.usb.return_hub(hub, self.clock)

    def exchange(self, one: str, other: str) -> None:
        """Pull two cables and plug each into the other's place."""
        ports = [self.port(role) for role in (one, other)]
        for port in ports:
            port.unplug()
        ports[0].device, ports[1].device = ports[1].device, ports[0].device
        for port in ports:
            port.plug()


Act = Callable[[Site], Awaitable[None] | None]


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, ready to happen.

    Args:
        kind: of its kind.
        where: device, hub or rail; for the report.
        start: makes it.
        end: takes it away.
        hold: seconds it lasts.
        stops: the truck must stand soon, and stay so.
    """

    kind: Kind
    where: str
    start: Act
    end: Act
    hold: float
    stops: bool = False

    @property
    def name(self) -> str:
        """For the report."""
        return f"{self.kind.value}: {self.where}" if self.where else self.kind.value


def hubs_of(devices: Devices) -> tuple[str, ...]:
    """Hubs that devices hang on."""
    ports = (device.port for device in devices.present().values())
    return tuple(sorted({port.hub for port in ports if isinstance(port, UsbPortConfig)}))


class Menu:
    """Faults that a robot can have.

    Args:
        devices: of the robot.
        records: whether its daemon writes a log.
    """

    def __init__(self, devices: Devices, *, records: bool) -> None:
        self._roles = tuple(devices.present())
        self._hubs = hubs_of(devices)
        self._records = records
        self._makers = dict(self._list())

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """What ``draw`` can give."""
        return tuple(self._makers)

    def draw(self, rng: np.random.Generator, *, without: frozenset[Kind] = frozenset()) -> Fault:
        """One fault, all kinds alike."""
        kinds = [kind for kind in self._makers if kind not in without]
        return self._makers[kinds[rng.integers(len(kinds))]](rng)

    def _list(self) -> Iterator[tuple[Kind, Callable[[np.random.Generator], Fault]]]:
        serial = tuple(role for role in SERIAL if role in self._roles)
        yield Kind.UNPLUG, lambda rng: _cable(rng, Kind.UNPLUG, _pick(rng, self._roles), ("unplug",), ("plug",))
        yield Kind.STALL, lambda rng: _cable(rng, Kind.STALL, _pick(rng, serial), *_switch("line stalled"))
        yield Kind.GARBAGE, lambda rng: _garbage(rng, _pick(rng, serial))
        yield Kind.BIT_ERRORS, lambda rng: _bit_errors(rng, _pick(rng, serial))
        yield Kind.SLOW, lambda rng: _slow(rng, _pick(rng, serial))
        yield Kind.SHORT_WRITE, lambda rng: _short_write(rng, _pick(rng, serial))
        yield Kind.RESET, lambda rng: _once(rng, Kind.RESET, _pick(rng, serial), "power-cycle")
        yield Kind.WRONG_DEVICE, lambda rng: _wrong(rng, serial)
        yield Kind.CLOCK_JUMP, _clock_jump
        yield Kind.OBSTACLE, _obstacle
        yield Kind.RAIL_SERVOS, _servo_rail
        yield Kind.BATTERY_OFF, _battery_off
        if "steering" in self._roles:
            yield Kind.BROWN_OUT, lambda rng: _brown_out(rng, self._roles)
        if "compass" in self._roles:
            yield Kind.FROZEN, lambda rng: _cable(rng, Kind.FROZEN, "compass", *_switch("frozen"), stops=False)
        if "stabiliser" in self._roles:
            yield Kind.ECHO, lambda rng: _cable(rng, Kind.ECHO, "stabiliser", *_switch("echo"))
            yield Kind.RAIL_12V, _rail_12v
        if self._hubs:
            yield Kind.HUB_LOSS, lambda rng: _hubs(rng, Kind.HUB_LOSS, (_pick(rng, self._hubs),))
            yield Kind.RAIL_ELECTRONICS, lambda rng: _hubs(rng, Kind.RAIL_ELECTRONICS, self._hubs)
        if self._records:
            yield Kind.DISK_FULL, _disk_full


def _pick(rng: np.random.Generator, among: tuple[str, ...]) -> str:
    return among[rng.integers(len(among))]


def _hold(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.7, 1.5))


def _says(role: str, *lines: str) -> Act:
    return lambda site: site.say(role, *lines)


def _nothing(_: Site) -> None:
    return None


def _switch(words: str) -> tuple[tuple[str], tuple[str]]:
    return (f"{words} on",), (f"{words} off",)


def _cable(
    rng: np.random.Generator, kind: Kind, role: str, start: tuple[str, ...], end: tuple[str, ...], *, stops: bool = True
) -> Fault:
    return Fault(kind, role, _says(role, *start), _says(role, *end), _hold(rng), stops and role in VITAL)


def _once(rng: np.random.Generator, kind: Kind, role: str, *words: str) -> Fault:
    return Fault(kind, role, _says(role, *words), _nothing, _hold(rng))


def _garbage(rng: np.random.Generator, role: str) -> Fault:
    burst = rng.bytes(int(rng.integers(1, 300))).hex()
    return _once(rng, Kind.GARBAGE, role, f"line garbage {burst}")


def _bit_errors(rng: np.random.Generator, role: str) -> Fault:
    rate = 10 ** rng.uniform(-4, -1.3)
    return _cable(
        rng, Kind.BIT_ERRORS, role, (f"line flip_rate {rate}",), ("line flip_rate 0", "line drop_rate 0"), stops=False
    )


def _slow(rng: np.random.Generator, role: str) -> Fault:
    start = "line chunk 1" if rng.random() < 0.5 else f"line delay {rng.uniform(0.005, 0.15):.3f}"
    return _cable(rng, Kind.SLOW, role, (start,), ("line chunk off", "line delay 0"), stops=False)


def _short_write(rng: np.random.Generator, role: str) -> Fault:
    start, end = (f"line short_writes {rng.integers(1, 20)}",), ("line short_writes 0",)
    return _cable(rng, Kind.SHORT_WRITE, role, start, end, stops=False)


def _wrong(rng: np.random.Generator, serial: tuple[str, ...]) -> Fault:
    one, other = (str(role) for role in rng.choice(serial, 2, replace=False))

    def swap(site: Site) -> None:
        site.exchange(one, other)

    return Fault(Kind.WRONG_DEVICE, f"{one}, {other}", swap, swap, _hold(rng), bool({one, other} & {*VITAL}))


def _brown_out(rng: np.random.Generator, roles: tuple[str, ...]) -> Fault:
    role = _pick(rng, tuple(role for role in ("steering", "drive", "stabiliser") if role in roles))
    hold = _hold(rng)
    if role == "steering":
        start: tuple[str, ...] = (f"brown_out {0.8 * hold:.2f}",)
        end: tuple[str, ...] = ()
    else:
        start, end = ("power off",), ("power on",)
    return Fault(Kind.BROWN_OUT, role, _says(role, *start), _says(role, *end), hold, role == "drive")


def _clock_jump(rng: np.random.Generator) -> Fault:
    seconds = float(rng.choice((-1.0, 1.0)) * 10 ** rng.uniform(-1, 8))

    def jump(site: Site) -> None:
        if isinstance(site.clock, VirtualClock):  # nobody sets the real clock of the computer this runs on
            site.clock.step_real(seconds)

    return Fault(Kind.CLOCK_JUMP, f"{seconds:+.3g} s", jump, _nothing, _hold(rng))


def _disk_full(rng: np.random.Generator) -> Fault:
    def fill(site: Site) -> None:
        if site.disk is not None:
            site.disk.refuse(OSError(errno.ENOSPC, "No space left on device"))

    return Fault(Kind.DISK_FULL, "", fill, _nothing, _hold(rng))


def _obstacle(rng: np.random.Generator) -> Fault:
    gap, radius = float(rng.uniform(0.15, 0.5)), 0.1
    posts: list[Disc] = []

    def put(site: Site) -> None:
        now = site.clock.now()
        truth = site.robot.world.truth(now)
        ahead = site.config.world.truck.length / 2 + gap + radius
        posts.append(Disc(truth.x + ahead * math.cos(truth.yaw), truth.y + ahead * math.sin(truth.yaw), radius))
        site.robot.world.add(now, posts[0])

    def take(site: Site) -> None:
        site.robot.world.remove(site.clock.now(), posts.pop())

    return Fault(Kind.OBSTACLE, f"{gap:.2f} m ahead", put, take, 2 * _hold(rng))


# Supply rails: battery -> EPOS; 12 V -> stabiliser, fan; 5 V -> servos; electronics -> lidar and hubs


def _rail_12v(rng: np.random.Generator) -> Fault:
    def lose(site: Site) -> None:
        site.say("stabiliser", "power off")
        site.heat(HOT)

    def give(site: Site) -> None:
        site.say("stabiliser", "power on")
        site.heat(COOL)

    return Fault(Kind.RAIL_12V, "", lose, give, _hold(rng))


def _servo_rail(rng: np.random.Generator) -> Fault:
    return Fault(
        Kind.RAIL_SERVOS,
        "",
        lambda site: site.robot.world.supply_servos(site.clock.now(), on=False),
        lambda site: site.robot.world.supply_servos(site.clock.now(), on=True),
        float(rng.uniform(4.0, 6.0)),
    )


def _hubs(rng: np.random.Generator, kind: Kind, hubs: tuple[str, ...]) -> Fault:
    where = hubs[0] if kind is Kind.HUB_LOSS else ""
    return Fault(
        kind, where, lambda site: site.lose_hubs(*hubs), lambda site: site.return_hubs(*hubs), _hold(rng), stops=True
    )


def _battery_off(rng: np.random.Generator) -> Fault:
    """The computer lives on through its bench supply; motor, servos and stabiliser do not."""

    def pull(site: Site) -> None:
        site.robot.world.connect_battery(site.clock.now(), connected=False)
        site.robot.world.supply_servos(site.clock.now(), on=False)
        site.say("drive", "power off")
        site.say("stabiliser", "power off")

    def plug(site: Site) -> None:
        site.robot.world.connect_battery(site.clock.now(), connected=True)
        site.robot.world.supply_servos(site.clock.now(), on=True)
        site.say("drive", "power on")
        site.say("stabiliser", "power on")

    return Fault(Kind.BATTERY_OFF, "", pull, plug, _hold(rng), stops=True)


class Mishaps:
    """Lets faults happen to a running simulation, by its configuration's ``sim.drill``.

    Args:
        site: where.
        config: seed and period.
        say: told of each fault.
    """

    def __init__(self, site: Site, config: DrillConfig, say: Callable[[str], None] = lambda _: None) -> None:
        self._site = site
        self._period = config.period
        self._rng = np.random.default_rng(config.seed)
        self._menu = Menu(site.devices, records=site.disk is not None)
        self._say = say

    async def run(self) -> None:
        """One after another until cancelled."""
        full = frozenset[Kind]() if self._site.disk is not None else frozenset({Kind.DISK_FULL})
        while True:
            await self._site.clock.sleep(self._period * float(self._rng.uniform(0.5, 1.5)))
            fault = self._menu.draw(self._rng, without=full)
            if fault.kind is Kind.DISK_FULL:
                full = frozenset({Kind.DISK_FULL})
            self._say(f"fault: {fault.name} for {fault.hold:.1f} s")
            await happen(fault.start, self._site)
            await self._site.clock.sleep(fault.hold)
            await happen(fault.end, self._site)


async def happen(act: Act, site: Site) -> None:
    """Carry out one end of a fault."""
    waiting = act(site)
    if waiting is not None:
        await waiting
