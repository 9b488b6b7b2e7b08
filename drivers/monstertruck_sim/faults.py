"""Simulated faults: their kinds and places, and the catalog of random faults.

A fault is a pair of actions on a ``SimContext``: one starts it, the other ends it. Scripted scenarios and random drills
use the same actions.
"""

import asyncio
import errno
import itertools
import math
from collections.abc import Awaitable, Callable, Collection, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Generic, Protocol, TypeVar

import numpy as np

from monstertruck_drivers.config import Devices
from monstertruck_drivers.emulation import signals_of
from monstertruck_drivers.epos.exchange import BRIEF_SILENCES
from monstertruck_drivers.signals import Signals
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_runtime.clock import Clock, VirtualClock
from monstertruck_runtime.errors import InputError
from monstertruck_sim.computer import EmulatedComputer
from monstertruck_sim.config import DrillConfig, SimConfig
from monstertruck_sim.console import Emulated
from monstertruck_sim.robot import SimulatedRobot
from monstertruck_sim.world.obstacles import Disc

MORE_DRIVES: Final = ("drive_2", "drive_3", "drive_4")
DRIVES: Final = ("drive", *MORE_DRIVES)
"""Roles of controllers of one motor."""
SERIAL: Final = (
    *("drive", "steering", "lidar", "lidar_2", "compass", "stabiliser"),
    *(*MORE_DRIVES, "wheels", "actuators", "sonar", "imu"),
)
"""Roles of devices, most of whose kinds use a serial line."""
VITAL: Final = ("drive", "steering", "lidar", "lidar_2", "compass", *MORE_DRIVES, "wheels", "actuators", "sonar")
"""Roles whose silence stops the robot; the sonars only if they replace the lidar."""
SHORT_WRITES: Final = 19
"""Maximum number of consecutive writes cut in half."""
ALL_ROUND: Final = "-135 135"
"""Directions of all the lidar's beams (degrees)."""
UNKNOWN_CODES: Final = (*range(3, 20),)
"""Codes of the lidar for beams without information; 0 to 2 mean no return within range."""


class FaultKind(StrEnum):
    """Kinds of faults in the catalog, by name in reports."""

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
    BLIND = "blind lidar"
    LATE_ANSWERS = "late answers"
    CLOCK_DRIFT = "clock drift"
    SUPPLY_DIP = "supply dip"
    BLOCKED_SHAFT = "blocked shaft"
    CLOCK_JUMP = "clock jump"
    LOOP_STALL = "loop stalled"
    DISK_FULL = "disk full"
    RAIL_12V = "12 V lost"
    RAIL_SERVOS = "servo 5 V lost"
    RAIL_ELECTRONICS = "electronics rail lost"
    BATTERY_OFF = "battery disconnected"
    COMPUTER_POWER = "computer power lost"
    NETWORK = "network lost"
    MEMORY = "memory full"
    WORKER = "worker killed"
    OBSTACLE = "obstacle"
    BAD_ANSWERS = "bad answers"
    HELD_WHEEL = "held wheel"
    DEAD_SONAR = "dead sonar"
    STUCK_SONAR = "stuck sonar"
    CROSS_TALK = "cross-talk"
    WRONG_SIGN = "wrong sign"
    STUCK_ENCODER = "stuck encoder"
    MIRRORED_ENCODER = "mirrored encoder"


class RecorderDisk(Protocol):
    """Recorder whose disk can fail."""

    def refuse(self, error: OSError) -> None:
        """Make every following write fail."""


class ComputerPower(Protocol):
    """Power supply of the computer that runs a daemon."""

    async def cut(self) -> None:
        """End the daemon immediately; its cables must already be dead."""

    def give(self) -> None:
        """Start a new daemon, as after a boot."""


class Workers(Protocol):
    """Worker processes of a daemon."""

    def kill(self, name: str) -> None:
        """Kill a worker as with SIGKILL and wait for its end; no effect if the worker is not running."""


@dataclass(frozen=True, slots=True)
class SimContext:
    """Fault targets: the simulation, and the daemon's disk, workers and computer supply.

    Args:
        config: configuration of the simulation.
        devices: devices of the robot.
        robot: world and emulators.
        computer: USB tree and cables.
        clock: time.
        disk: disk of the recording; None without a recorder.
        power: supply of the computer; None if the daemon runs on this computer.
        workers: worker processes; None if no fault affects them.
    """

    config: SimConfig
    devices: Devices
    robot: SimulatedRobot
    computer: EmulatedComputer
    clock: Clock
    disk: RecorderDisk | None = None
    power: ComputerPower | None = None
    workers: Workers | None = None

    def device(self, role: str) -> Emulated:
        """Return the emulator and cable of a device."""
        return Emulated(self.robot.emulators[role], self.computer.ports[role])

    def signals(self, role: str) -> Signals:
        """Return the signals of a device or of a computer monitor.

        Raises:
            InputError: the robot has no such device, or the device declares no signals.
        """
        signals = signals_of(self.robot.emulators.get(role) or self.robot.monitored.get(role))
        if signals is None:
            raise InputError(f"{role}: it names no signals that could be falsified")
        return signals

    def command(self, role: str, *lines: str) -> None:
        """Send fault console commands to a device; no effect if the truck lacks it."""
        if role in self.robot.emulators:
            for line in lines:
                self.device(role).command(line.split())

    def monitored(self, name: str, fault: str, *values: str) -> None:
        """Change the readings of a monitor; no effect if the truck lacks it."""
        if name in self.robot.monitored:
            self.robot.monitored[name].inject(fault, *values)

    def lose_hubs(self, *hubs: str) -> None:
        """Make hubs drop off the bus."""
        for hub in hubs:
            self.computer.usb.lose_hub(hub)

    async def return_hubs(self, *hubs: str, enumerated: bool = False) -> None:
        """Return hubs to the bus; the kernel enumerates them in parallel, each in its own work item (``usb_hub_wq``).

        Args:
            hubs: names.
            enumerated: whether all devices behind the hub are present immediately, as after a boot.
        """
        times = {"first": 0.0, "between": 0.0} if enumerated else {}
        usb, clock = self.computer.usb, self.clock
        await asyncio.gather(*(usb.return_hub(hub, clock, **times) for hub in hubs))

    def exchange_cables(self, one: str, other: str) -> None:
        """Unplug two cables and plug each into the other's port."""
        ports = [self.computer.ports[role] for role in (one, other)]
        for port in ports:
            port.unplug()
        ports[0].device, ports[1].device = ports[1].device, ports[0].device
        for port in ports:
            port.plug()


C = TypeVar("C", bound=SimContext)
Action = Callable[[C], Awaitable[None] | None]
"""Start or end of a fault."""


async def apply(action: Action[C], context: C) -> None:
    """Execute the start or end of a fault."""
    waiting = action(context)
    if waiting is not None:
        await waiting


def nothing(_: SimContext) -> None:
    """Do nothing: the end of a fault that passes by itself."""


@dataclass(frozen=True, slots=True)
class Fault(Generic[C]):
    """A temporary fault.

    Args:
        name: name for reports.
        start: starts the fault.
        end: ends the fault.
        hold: duration (s).
    """

    name: str
    start: Action[C]
    end: Action[C] = nothing
    hold: float = 2.5


# Actions


def command(role: str, *lines: str) -> Action[SimContext]:
    """Return an action that sends fault console commands to a device."""
    return lambda context: context.command(role, *lines)


def monitored(name: str, fault: str, *values: str) -> Action[SimContext]:
    """Return an action that changes the readings of a monitor."""
    return lambda context: context.monitored(name, fault, *values)


def exchange_cables(one: str, other: str) -> Action[SimContext]:
    """Return an action that swaps two devices' cables between their ports; a second call undoes it."""
    return lambda context: context.exchange_cables(one, other)


def place_obstacle(gap: float) -> Action[SimContext]:
    """Return an action that places a post ``gap`` metres in front of the bumper."""
    post_radius = 0.1  # radius of an obstacle, m

    def place(context: SimContext) -> None:
        now = context.clock.now()
        truth = context.robot.world.truth(now)
        ahead = context.config.world.truck.length / 2 + gap + post_radius
        post = Disc(truth.x + ahead * math.cos(truth.yaw), truth.y + ahead * math.sin(truth.yaw), post_radius)
        context.robot.world.add(now, post)

    return place


def block_shaft(shaft: int = 0, *, on: bool) -> Action[SimContext]:
    """Return an action that holds or releases a driven shaft."""
    return lambda context: context.robot.world.block_shaft(context.clock.now(), shaft, on=on)


def clear_obstacles(context: SimContext) -> None:
    """Remove all objects that were added to the world."""
    for post in context.robot.world.obstacles:
        context.robot.world.remove(context.clock.now(), post)


# The catalog


@dataclass(frozen=True, slots=True, kw_only=True)
class CatalogFault(Fault[SimContext]):
    """A fault drawn from the catalog.

    Args:
        kind: kind of the fault.
        must_stop: whether the truck must stop soon and stay at rest.
        disarms: whether the fault must disarm the robot, which must not start again by itself.
    """

    kind: FaultKind
    must_stop: bool = False
    disarms: bool = False


Maker = Callable[[np.random.Generator], CatalogFault]
"""Draws a fault of one kind."""


def hubs_of(devices: Devices, without: Collection[str] = ()) -> tuple[str, ...]:
    """Hubs with connected devices, ignoring devices with the roles ``without``."""
    hubs: dict[str, set[str]] = {}
    for role, device in devices.present().items():
        if isinstance(device.port, UsbPortConfig):
            hubs.setdefault(device.port.hub, set()).add(role)
    return tuple(sorted(hub for hub, roles in hubs.items() if roles.isdisjoint(without)))


class FaultCatalog:
    """Catalog of a robot's faults.

    Args:
        devices: devices of the robot.
        monitors: monitors of its computer, by name.
        records: whether the daemon writes a log.
        restarts: whether the computer can be switched off.
        workers: names of its daemon's worker processes.
        unguarded: roles of motor controllers without any device that stops them while they are unreachable; they are
            never disconnected.
    """

    def __init__(
        self,
        devices: Devices,
        monitors: Collection[str] = (),
        *,
        records: bool,
        restarts: bool = False,
        workers: tuple[str, ...] = (),
        unguarded: Collection[str] = (),
    ) -> None:
        present = devices.present()
        self._roles = tuple(present)
        self._serial = tuple(role for role in SERIAL if role in present and present[role].kind.opens == "serial")
        self._guarded = tuple(role for role in self._roles if role not in unguarded)
        self._drives = tuple(role for role in DRIVES if role in self._roles)
        self._vital = frozenset(VITAL) - ({"sonar"} if "lidar" in self._roles else frozenset())
        self._sonars = () if devices.sonar is None else tuple(devices.sonar.driver.sonars)
        settings = None if devices.wheels is None else devices.wheels.driver
        self._motors = settings.motors if isinstance(settings, StepperConfig) else 0
        self._hubs = hubs_of(devices, unguarded)
        self._all_hubs = self._hubs == hubs_of(devices)
        """Whether all hubs may be lost at once."""
        self._monitors = monitors
        self._records = records
        self._restarts = restarts
        self._workers = workers
        self._makers = dict(itertools.chain(self._of_devices(), self._of_the_computer()))

    @property
    def kinds(self) -> tuple[FaultKind, ...]:
        """Kinds of faults that ``draw`` can return."""
        return tuple(self._makers)

    def draw(self, rng: np.random.Generator, *, without: frozenset[FaultKind] = frozenset()) -> CatalogFault:
        """Draw one fault; all kinds are equally likely."""
        kinds = [kind for kind in self._makers if kind not in without]
        return self._makers[kinds[rng.integers(len(kinds))]](rng)

    def _of_devices(self) -> Iterator[tuple[FaultKind, Maker]]:
        yield from self._of_lines()
        yield FaultKind.CLOCK_JUMP, _clock_jump
        if self._all_hubs and self._guarded == self._roles:
            yield FaultKind.LOOP_STALL, _loop_stall
        if "lidar" in self._roles:
            yield FaultKind.OBSTACLE, _obstacle
        if "steering" in self._roles:
            yield FaultKind.RAIL_SERVOS, _servo_rail
        if self._drives:
            yield FaultKind.BATTERY_OFF, _battery_off
        if "steering" in self._roles:
            yield FaultKind.BROWN_OUT, lambda rng: _brown_out(rng, self._roles)
        if frozen := tuple(role for role in ("compass", "imu") if role in self._roles):
            yield FaultKind.FROZEN, lambda rng: _frozen(rng, frozen)
        if "lidar" in self._roles:
            yield FaultKind.BLIND, _blind
            yield FaultKind.CLOCK_DRIFT, _clock_drift
        yield from self._of_motors()
        if "stabiliser" in self._roles:
            yield FaultKind.ECHO, lambda rng: _cable(rng, FaultKind.ECHO, "stabiliser", *_switch("echo"))
            yield FaultKind.RAIL_12V, _rail_12v
        yield from self._of_wheels_and_sonars()

    def _of_lines(self) -> Iterator[tuple[FaultKind, Maker]]:
        serial, vital = self._serial, self._vital
        guarded = tuple(role for role in serial if role in self._guarded)
        if self._guarded:
            yield FaultKind.UNPLUG, lambda rng: _unplug(rng, _pick(rng, self._guarded), vital)
        if guarded:
            yield FaultKind.STALL, lambda rng: _stall(rng, _pick(rng, guarded), vital)
        if serial:
            yield FaultKind.GARBAGE, lambda rng: _garbage(rng, _pick(rng, serial))
            yield FaultKind.BIT_ERRORS, lambda rng: _bit_errors(rng, _pick(rng, serial))
            yield FaultKind.SLOW, lambda rng: _slow(rng, _pick(rng, serial))
            yield FaultKind.SHORT_WRITE, lambda rng: _short_write(rng, _pick(rng, serial), guarded)
            yield FaultKind.RESET, lambda rng: _once(rng, FaultKind.RESET, _pick(rng, serial), "power-cycle")
        if len(guarded) > 1:
            yield FaultKind.WRONG_DEVICE, lambda rng: _wrong(rng, guarded, vital)

    def _of_motors(self) -> Iterator[tuple[FaultKind, Maker]]:
        if late := tuple(role for role in ("drive", "steering", *MORE_DRIVES, "wheels") if role in self._roles):
            yield FaultKind.LATE_ANSWERS, lambda rng: _late_answers(rng, _pick(rng, late))
        if drives := self._drives:
            yield FaultKind.SUPPLY_DIP, lambda rng: _supply_dip(rng, drives)
            yield FaultKind.BLOCKED_SHAFT, lambda rng: _blocked_shaft(rng, len(drives))

    def _of_wheels_and_sonars(self) -> Iterator[tuple[FaultKind, Maker]]:
        sonars, motors = self._sonars, self._motors
        if motors:
            yield FaultKind.BAD_ANSWERS, lambda rng: _once(rng, FaultKind.BAD_ANSWERS, "wheels", _noise(rng))
            yield FaultKind.HELD_WHEEL, lambda rng: _held_wheel(rng, motors)
        if sonars:
            yield FaultKind.DEAD_SONAR, lambda rng: _sonar(rng, FaultKind.DEAD_SONAR, _pick(rng, sonars), "dead")
            yield FaultKind.STUCK_SONAR, lambda rng: _sonar(rng, FaultKind.STUCK_SONAR, _pick(rng, sonars), "stuck")
            yield FaultKind.CROSS_TALK, lambda rng: _cross_talk(rng, _pick(rng, sonars))
        if "imu" in self._roles:
            yield FaultKind.WRONG_SIGN, lambda rng: _cable(rng, FaultKind.WRONG_SIGN, "imu", *_switch("inverted"))
        if "encoders" in self._roles:
            yield FaultKind.STUCK_ENCODER, lambda rng: _encoder(rng, FaultKind.STUCK_ENCODER, "stuck")
            yield FaultKind.MIRRORED_ENCODER, lambda rng: _encoder(rng, FaultKind.MIRRORED_ENCODER, "mirrored")

    def _of_the_computer(self) -> Iterator[tuple[FaultKind, Maker]]:
        if self._hubs:
            yield FaultKind.HUB_LOSS, lambda rng: _hubs(rng, FaultKind.HUB_LOSS, (_pick(rng, self._hubs),))
        if self._hubs and self._all_hubs:
            yield FaultKind.RAIL_ELECTRONICS, lambda rng: _hubs(rng, FaultKind.RAIL_ELECTRONICS, self._hubs)
            if self._restarts:
                yield FaultKind.COMPUTER_POWER, lambda rng: _computer_power(rng, self._hubs)
        if self._records:
            yield FaultKind.DISK_FULL, _disk_full
        if "link" in self._monitors:
            yield FaultKind.NETWORK, _network
        if "host" in self._monitors:
            yield FaultKind.MEMORY, _memory
        if self._workers:
            yield FaultKind.WORKER, lambda rng: _worker(rng, _pick(rng, self._workers))


def _pick(rng: np.random.Generator, among: tuple[str, ...]) -> str:
    return among[rng.integers(len(among))]


def _hold(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.7, 1.5))


def _fault(
    kind: FaultKind,
    where: str,
    start: Action[SimContext],
    end: Action[SimContext],
    hold: float,
    *,
    must_stop: bool = False,
    disarms: bool = False,
) -> CatalogFault:
    """Return a fault in a device, hub or rail."""
    name = f"{kind.value}: {where}" if where else kind.value
    return CatalogFault(name=name, start=start, end=end, hold=hold, kind=kind, must_stop=must_stop, disarms=disarms)


def _switch(words: str) -> tuple[tuple[str], tuple[str]]:
    return (f"{words} on",), (f"{words} off",)


def _cable(
    rng: np.random.Generator,
    kind: FaultKind,
    role: str,
    start: tuple[str, ...],
    end: tuple[str, ...],
    *,
    stops: bool = False,
) -> CatalogFault:
    return _fault(kind, role, command(role, *start), command(role, *end), _hold(rng), must_stop=stops)


def _once(rng: np.random.Generator, kind: FaultKind, role: str, *lines: str) -> CatalogFault:
    return _fault(kind, role, command(role, *lines), nothing, _hold(rng))


def _unplug(rng: np.random.Generator, role: str, vital: Collection[str]) -> CatalogFault:
    return _cable(rng, FaultKind.UNPLUG, role, ("unplug",), ("plug",), stops=role in vital)


def _stall(rng: np.random.Generator, role: str, vital: Collection[str]) -> CatalogFault:
    return _cable(rng, FaultKind.STALL, role, *_switch("line stalled"), stops=role in vital)


def _frozen(rng: np.random.Generator, roles: tuple[str, ...]) -> CatalogFault:
    role = roles[0] if len(roles) == 1 else _pick(rng, roles)
    return _cable(rng, FaultKind.FROZEN, role, *_switch("frozen"))


def _noise(rng: np.random.Generator) -> str:
    return f"noise {rng.integers(1, 12)}"


def _held_wheel(rng: np.random.Generator, motors: int) -> CatalogFault:
    """Hold a wheel: a stepper then loses steps without reporting it."""
    motor = int(rng.integers(motors)) + 1
    return _cable(rng, FaultKind.HELD_WHEEL, "wheels", *_switch(f"overload {motor}"))


def _sonar(rng: np.random.Generator, kind: FaultKind, name: str, fault: str) -> CatalogFault:
    starts, ends = _switch(f"{fault} {name}")
    return _fault(kind, name, command("sonar", *starts), command("sonar", *ends), _hold(rng))


def _encoder(rng: np.random.Generator, kind: FaultKind, fault: str) -> CatalogFault:
    side = _pick(rng, ("left", "right"))
    starts, ends = _switch(f"{fault} {side}")
    return _fault(kind, side, command("encoders", *starts), command("encoders", *ends), _hold(rng))


def _cross_talk(rng: np.random.Generator, name: str) -> CatalogFault:
    """Simulate the sound of another sonar: an echo from a distance where there is no object."""
    metres = rng.uniform(0.15, 3.0)
    starts, ends = command("sonar", f"ghost {name} {metres:.2f}"), command("sonar", f"ghost {name} off")
    return _fault(FaultKind.CROSS_TALK, f"{name}, {metres:.2f} m", starts, ends, _hold(rng))


def _garbage(rng: np.random.Generator, role: str) -> CatalogFault:
    burst = rng.bytes(int(rng.integers(1, 300))).hex()
    return _once(rng, FaultKind.GARBAGE, role, f"line garbage {burst}")


def _bit_errors(rng: np.random.Generator, role: str) -> CatalogFault:
    start, end = (f"line flip_rate {10 ** rng.uniform(-4, -1.3)}",), ("line flip_rate 0", "line drop_rate 0")
    return _cable(rng, FaultKind.BIT_ERRORS, role, start, end)


def _slow(rng: np.random.Generator, role: str) -> CatalogFault:
    start = "line chunk 1" if rng.random() < 0.5 else f"line delay {rng.uniform(0.005, 0.15):.3f}"
    return _cable(rng, FaultKind.SLOW, role, (start,), ("line chunk off", "line delay 0"))


def _short_write(rng: np.random.Generator, role: str, guarded: Collection[str]) -> CatalogFault:
    """Shorten writes; several in a row disconnect a controller, so an unguarded controller gets only a few."""
    most = SHORT_WRITES if role in guarded else BRIEF_SILENCES
    start, end = (f"line short_writes {rng.integers(1, most + 1)}",), ("line short_writes 0",)
    return _cable(rng, FaultKind.SHORT_WRITE, role, start, end)


def _blind(rng: np.random.Generator) -> CatalogFault:
    """Blind the lidar: a full or partial cover, the sun, or a mirror."""
    begin = rng.uniform(-110.0, 60.0)
    part = f"{begin:.0f} {begin + rng.uniform(20.0, 60.0):.0f}"
    where, fault = (
        ("all round", f"cover {ALL_ROUND} {rng.choice(UNKNOWN_CODES)}"),
        ("a part", f"cover {part} {rng.choice(UNKNOWN_CODES)}"),
        ("hand", f"cover {part} {rng.integers(20, 60)}"),
        ("sun", f"cover {part} {rng.choice(UNKNOWN_CODES)} {rng.uniform(0.2, 0.9):.2f}"),
        ("mirror", f"mirror {part}"),
    )[rng.integers(5)]
    start, end = command("lidar", fault), command("lidar", "cover off")
    return _fault(FaultKind.BLIND, where, start, end, _hold(rng), must_stop=where == "all round")


def _clock_drift(rng: np.random.Generator) -> CatalogFault:
    """Simulate an inaccurate crystal, or the slew of a clock that is being set."""
    ppm = float(rng.choice((-1.0, 1.0)) * 10 ** rng.uniform(2, 5))
    start, end = command("lidar", f"drift {ppm:.0f}"), command("lidar", "drift 0")
    return _fault(FaultKind.CLOCK_DRIFT, f"{ppm:+.3g} ppm", start, end, float(rng.uniform(2.0, 5.0)))


def _late_answers(rng: np.random.Generator, role: str) -> CatalogFault:
    if role not in DRIVES:
        return _once(rng, FaultKind.LATE_ANSWERS, role, f"late {rng.uniform(0.05, 0.25):.3f} {rng.integers(1, 5)}")
    start, end = (f"delay {rng.uniform(5.0, 80.0):.0f}",), ("delay 0",)
    return _cable(rng, FaultKind.LATE_ANSWERS, role, start, end)


def _supply_dip(rng: np.random.Generator, roles: tuple[str, ...]) -> CatalogFault:
    """Restart the controller while the host waits for its answer; the truck coasts until the controller is up again."""
    role = roles[0] if len(roles) == 1 else _pick(rng, roles)
    return _fault(FaultKind.SUPPLY_DIP, role, command(role, "restart 1"), nothing, 1.0 + _hold(rng), disarms=True)


def _blocked_shaft(rng: np.random.Generator, shafts: int) -> CatalogFault:
    """Block one of several shafts, which does not hold the robot: the others turn until the gate detects the fault."""
    shaft = 0 if shafts == 1 else int(rng.integers(shafts))
    held, free, where = block_shaft(shaft, on=True), block_shaft(shaft, on=False), "" if shafts == 1 else DRIVES[shaft]
    return _fault(FaultKind.BLOCKED_SHAFT, where, held, free, 1.0 + _hold(rng), must_stop=shafts == 1, disarms=True)


def _wrong(rng: np.random.Generator, serial: tuple[str, ...], vital: Collection[str]) -> CatalogFault:
    one, other = (str(role) for role in rng.choice(serial, 2, replace=False))
    swap, stops = exchange_cables(one, other), not {one, other}.isdisjoint(vital)
    return _fault(FaultKind.WRONG_DEVICE, f"{one}, {other}", swap, swap, _hold(rng), must_stop=stops)


def _brown_out(rng: np.random.Generator, roles: tuple[str, ...]) -> CatalogFault:
    role = _pick(rng, tuple(role for role in ("steering", "drive", "stabiliser") if role in roles))
    hold = _hold(rng)
    if role == "steering":
        start: tuple[str, ...] = (f"brown_out {0.8 * hold:.2f}",)
        end: tuple[str, ...] = ()
    else:
        start, end = ("power off",), ("power on",)
    starts, ends = command(role, *start), command(role, *end)
    return _fault(FaultKind.BROWN_OUT, role, starts, ends, hold, must_stop=role == "drive")


def _clock_jump(rng: np.random.Generator) -> CatalogFault:
    seconds = float(rng.choice((-1.0, 1.0)) * 10 ** rng.uniform(-1, 8))

    def jump(context: SimContext) -> None:
        if isinstance(context.clock, VirtualClock):  # the real clock of this computer is not set
            context.clock.step_real(seconds)

    return _fault(FaultKind.CLOCK_JUMP, f"{seconds:+.3g} s", jump, nothing, _hold(rng))


def _loop_stall(rng: np.random.Generator) -> CatalogFault:
    """Block the event loop, as another program on the processor would; devices, cables and world continue."""
    seconds = float(10 ** rng.uniform(-1.3, 0.5))

    def stall(context: SimContext) -> None:
        if isinstance(context.clock, VirtualClock):  # this computer itself is not stalled
            context.clock.stall(seconds)

    return _fault(FaultKind.LOOP_STALL, f"{seconds:.2f} s", stall, nothing, seconds + float(rng.uniform(0.0, 1.0)))


def _disk_full(rng: np.random.Generator) -> CatalogFault:
    def fill(context: SimContext) -> None:
        if context.disk is not None:
            context.disk.refuse(OSError(errno.ENOSPC, "No space left on device"))

    return _fault(FaultKind.DISK_FULL, "", fill, nothing, _hold(rng))


def _obstacle(rng: np.random.Generator) -> CatalogFault:
    gap = float(rng.uniform(0.15, 0.5))
    return _fault(FaultKind.OBSTACLE, f"{gap:.2f} m ahead", place_obstacle(gap), clear_obstacles, 2 * _hold(rng))


def _network(rng: np.random.Generator) -> CatalogFault:
    """Remove the network interface or its signal."""
    lost, back = (("remove",), ("plug",)) if rng.random() < 0.5 else (("signal", "-95"), ("signal", "-55"))
    lose, give_back = monitored("link", *lost), monitored("link", *back)
    return _fault(FaultKind.NETWORK, lost[0], lose, give_back, float(rng.uniform(1.5, 3.0)))


def _memory(rng: np.random.Generator) -> CatalogFault:
    fill, free = monitored("host", "memory", "0.01"), monitored("host", "memory", "0.6")
    return _fault(FaultKind.MEMORY, "", fill, free, float(rng.uniform(1.5, 3.0)))


def _worker(rng: np.random.Generator, name: str) -> CatalogFault:
    def kill(context: SimContext) -> None:
        if context.workers is not None:
            context.workers.kill(name)

    return _fault(FaultKind.WORKER, name, kill, nothing, _hold(rng))


# Supply rails: battery -> EPOS; 12 V -> stabiliser, fan; M4-ATX -> computer, 5 V -> servos, electronics -> lidar, hubs


def _rail_12v(rng: np.random.Generator) -> CatalogFault:
    def lose(context: SimContext) -> None:
        context.command("stabiliser", "power off")
        # 92.0: temperature of a computer whose fan stands, degrees Celsius
        context.monitored("host", "temperature", str(92.0))

    def give(context: SimContext) -> None:
        context.command("stabiliser", "power on")
        context.monitored("host", "temperature", str(48.0))  # degrees Celsius

    return _fault(FaultKind.RAIL_12V, "", lose, give, _hold(rng))


def _servo_rail(rng: np.random.Generator) -> CatalogFault:
    return _fault(
        FaultKind.RAIL_SERVOS,
        "",
        lambda context: context.robot.world.supply_servos(context.clock.now(), on=False),
        lambda context: context.robot.world.supply_servos(context.clock.now(), on=True),
        float(rng.uniform(4.0, 6.0)),
    )


def _hubs(rng: np.random.Generator, kind: FaultKind, hubs: tuple[str, ...]) -> CatalogFault:
    where = hubs[0] if kind is FaultKind.HUB_LOSS else ""

    def lose(context: SimContext) -> None:
        context.lose_hubs(*hubs)

    def give_back(context: SimContext) -> Awaitable[None]:
        return context.return_hubs(*hubs)

    return _fault(kind, where, lose, give_back, _hold(rng), must_stop=True)


def _computer_power(rng: np.random.Generator, hubs: tuple[str, ...]) -> CatalogFault:
    """Cut the computer's supply (M4-ATX): computer, hubs, lidar and servos go off; motor and stabiliser remain on.

    The boot time of the computer is not simulated: when the fault ends, the hubs are enumerated and a new daemon
    starts.
    """

    async def lose(context: SimContext) -> None:
        context.lose_hubs(*hubs)
        context.robot.world.supply_servos(context.clock.now(), on=False)
        if context.power is not None:
            await context.power.cut()

    async def give_back(context: SimContext) -> None:
        context.robot.world.supply_servos(context.clock.now(), on=True)
        await context.return_hubs(*hubs, enumerated=True)
        if context.power is not None:
            context.power.give()

    return _fault(FaultKind.COMPUTER_POWER, "", lose, give_back, _hold(rng), must_stop=True)


def _battery_off(rng: np.random.Generator) -> CatalogFault:
    """Cut the supply of motor, servos and stabiliser; the computer keeps its own supply."""

    def pull(context: SimContext) -> None:
        context.robot.world.connect_battery(context.clock.now(), connected=False)
        context.robot.world.supply_servos(context.clock.now(), on=False)
        for role in (*DRIVES, "stabiliser"):
            context.command(role, "power off")

    def plug(context: SimContext) -> None:
        context.robot.world.connect_battery(context.clock.now(), connected=True)
        context.robot.world.supply_servos(context.clock.now(), on=True)
        for role in (*DRIVES, "stabiliser"):
            context.command(role, "power on")

    return _fault(FaultKind.BATTERY_OFF, "", pull, plug, _hold(rng), must_stop=True)


class FaultInjector:
    """Injects random faults into a running simulation, as configured in ``sim.drill``.

    Args:
        context: targets of the faults.
        config: seed and period.
        report: called with one line for each fault.
    """

    def __init__(
        self, context: SimContext, config: DrillConfig, report: Callable[[str], None] = lambda _: None
    ) -> None:
        self._context = context
        self._period = config.period
        self._rng = np.random.default_rng(config.seed)
        self._catalog = FaultCatalog(
            context.devices,
            context.robot.monitored,
            records=context.disk is not None,
            restarts=context.power is not None,
        )
        self._report = report

    async def run(self) -> None:
        """Inject one fault after another until cancelled."""
        clock = self._context.clock
        full = frozenset[FaultKind]()
        while True:
            await clock.sleep(self._period * float(self._rng.uniform(0.5, 1.5)))
            fault = self._catalog.draw(self._rng, without=full)
            if fault.kind is FaultKind.DISK_FULL:
                full = frozenset({FaultKind.DISK_FULL})
            self._report(f"fault: {fault.name} for {fault.hold:.1f} s")
            await apply(fault.start, self._context)
            await clock.sleep(fault.hold)
            await apply(fault.end, self._context)
