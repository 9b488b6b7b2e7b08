"""Emulated AX-12A bus behind a USB2Dynamixel adapter, byte for byte."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config, JointConfig
from monstertruck_drivers.ax12.protocol import Alarm, Ax12Parser, Instruction, Packet
from monstertruck_drivers.ax12.unit import Load, Unit, Voltage, no_load, steady_voltage, unit_signals
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, Horn, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError

AS_SET: Final = Horn(None, None)

DAMAGES: Final = ("mute", "double", "truncate", "garble")
"""Faults of single answers."""


def _vanish(unit: Unit) -> None:
    unit.present = False


def _return(unit: Unit) -> None:
    unit.present = True


def _block(unit: Unit, blocked: bool) -> None:
    unit.blocked = blocked


def _freeze(unit: Unit, frozen: bool) -> None:
    unit.frozen = frozen


def _heat(unit: Unit, celsius: str) -> None:
    unit.temperature = float(celsius)


def _stray(unit: Unit, place: str) -> None:
    unit.stray = None if place == "off" else float(place)


UNIT_FAULTS: Final[Mapping[str, Callable[..., None]]] = {
    "vanish ID": _vanish,
    "return ID": _return,
    "block ID on|off": _block,
    "freeze ID on|off": _freeze,
    "heat ID CELSIUS": _heat,
    "trip ID": lambda unit: unit.trip(Alarm.OVERLOAD),
    "stray ID POSITION|off": _stray,
    "reset ID": Unit.factory_reset,
    "renumber ID NEW": lambda unit, number: unit.put(p.ID, int(number)),
}
"""Faults of one unit."""


class Ax12Bus(FaultyDevice):
    """Up to six units on one half-duplex line; ``end.baud = 1_000_000`` gives exchanges their real duration.

    USB powers the adapter and the 12 V rail powers the units: unplugging does not affect the units, and ``power off``
    silences all units while the port remains. Two units with the same id both answer, and their answers collide.

    Faults (``inject``): ``vanish ID``, ``return ID``, ``power on|off``, ``block ID on|off``, ``freeze ID on|off``
    (position sensor), ``heat ID CELSIUS``, ``voltage VOLTS|source``, ``trip ID`` (overload now), ``stray ID
    POSITION|off`` (turns to POSITION instead of its goal), ``reset ID`` (factory), ``renumber ID NEW``, ``latch
    on|off`` (error bits outlast their cause), ``echo on|off``, and, for the next ``COUNT`` answers (default 1),
    ``mute``, ``double``, ``truncate``, ``garble`` and ``late SECONDS``.

    Args:
        clock: time.
        ids: unit ids.
        seed: seed for the corruption of colliding answers.
        echo: the adapter echoes every byte it receives from the host.
        latency_s: latency that the adapter adds to answers (s).
        host_baud: baud rate of the host's port; units set to another rate receive nothing.
        answers_damage: whether a request with a wrong checksum is answered (checksum error bit) or ignored.
        positions: initial shaft positions by unit id (steps); default 512.
        load: load on the shafts.
        voltage: supply voltage at the units.

    Raises:
        InputError: too many units, or an invalid id.
    """

    def __init__(
        self,
        clock: Clock,
        ids: Sequence[int] = (1, 2),
        *,
        seed: int = 0,
        echo: bool = False,
        latency_s: float = 0.001,
        host_baud: int = p.AX12_BAUD,
        answers_damage: bool = True,
        positions: Mapping[int, float] | None = None,
        load: Load = no_load,
        voltage: Voltage = steady_voltage,
    ) -> None:
        units_max = 6
        if len(ids) > units_max or not all(0 <= ident <= p.ID_MAX for ident in ids):
            raise InputError(f"ax12: ids {tuple(ids)}: expected at most {units_max}, each 0..{p.ID_MAX}")
        self.name = "ax12"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self.latency_s = latency_s
        self._clock = clock
        self._host_baud = host_baud
        self._answers_damage = answers_damage
        self._source = voltage
        self._volts: float | None = None
        self._rng = np.random.default_rng(seed)
        self._late_s, self._late = 0.0, 0
        """Additional delay of answers (s), and the number of delayed answers."""
        places = positions or {}
        now = clock.now()
        kinds: dict[str, SignalKind] = {}
        for number in range(1, len(ids) + 1):
            kinds |= unit_signals(number)
        self.signals = Signals(clock.now, kinds, self._rng)
        self.units = [
            Unit(ident, places.get(ident, 512), now, load, self._voltage, self.signals, number)
            for number, ident in enumerate(ids, 1)
        ]
        self.faults = FaultTable(
            self.name,
            {
                "power on|off": lambda on: self._power(on=on),
                "voltage VOLTS|source": self._set_voltage,
                "latch on|off": self._latch,
                "echo on|off": echo,
                f"{'|'.join(DAMAGES)} [COUNT]": 0,
                "late SECONDS [COUNT]": self._delay,
                **{usage: partial(self._unit_fault, start) for usage, start in UNIT_FAULTS.items()},
            },
        )

    # Interface to the simulated world

    def angle(self, ident: int, time_ns: int) -> float:
        """Shaft angle of a unit (rad), counter-clockwise positive, 0 at position 0; see ``angles``."""
        return float(self.angles(ident, np.array([time_ns]))[0])

    def angles(self, ident: int, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Shaft angles of a unit at several times (ns), at most two seconds in the past; see ``angle``."""
        return self._find(ident).angles(times_ns) * p.STEP

    def power_cycle(self) -> None:
        """Switch the 12 V supply off and on: the RAM area of the control table is lost."""
        self._power(on=False)
        self._power(on=True)

    def _set_voltage(self, volts: str) -> None:
        self._volts = None if volts == "source" else float(volts)

    def _latch(self, latched: bool) -> None:
        for unit in self.units:
            unit.latched = latched

    def _delay(self, seconds: str, count: str = "1") -> None:
        self._late_s = float(seconds)
        self._late = int(count)

    def _unit_fault(self, start: Callable[..., None], number: str, *values: str | bool) -> None:
        unit = self._find(int(number))
        unit.advance(self._clock.now())
        start(unit, *values)

    def _find(self, ident: int) -> Unit:
        for unit in self.units:
            if unit.get(p.ID) == ident:
                return unit
        raise InputError(f"{self.name}: no unit {ident}; expected one of {[unit.get(p.ID) for unit in self.units]}")

    def _power(self, *, on: bool) -> None:
        now = self._clock.now()
        for unit in self.units:
            unit.power(on, now)

    def _voltage(self, time_ns: int) -> float:
        return self._source(time_ns) if self._volts is None else self._volts

    # Serving

    async def run(self, end: DeviceEnd) -> None:
        """Serve the connected host."""
        parser, heard = Ax12Parser(), 0
        while True:
            data = await end.read()
            now = self._clock.now()
            if now - heard > 100_000_000:  # timeout inside a packet (ns); then a unit drops it
                parser = Ax12Parser()
            heard = now
            self.received.extend(data)
            if self.faults["echo"]:
                end.write(data, self.latency_s)
            for packet in parser.feed(data):
                self._obey(end, packet)
            if self._answers_damage:
                for unit in [unit for ident in parser.damaged for unit in self._listening(ident)]:
                    self._answer(end, [Packet(unit.get(p.ID), unit.error(now) | Alarm.CHECKSUM)], [unit])

    def _listening(self, ident: int) -> list[Unit]:
        baud_tolerance = 0.03
        return [
            unit
            for unit in self.units
            if unit.powered
            and unit.present
            and ident in (unit.get(p.ID), p.BROADCAST)
            and abs(2_000_000 / (unit.get(p.BAUD_CODE) + 1) / self._host_baud - 1) <= baud_tolerance
        ]

    def _obey(self, end: DeviceEnd, packet: Packet) -> None:
        units = self._listening(packet.unit)
        if packet.code == Instruction.SYNC_WRITE:
            self._sync_write(packet.params)
            return
        answers = [answer for unit in units if (answer := self._execute(unit, packet)) is not None]
        # A broadcast ping is answered only if a single unit is on the bus.
        if packet.unit != p.BROADCAST or (packet.code == Instruction.PING and len(units) == 1):
            self._answer(end, answers, units)

    def _execute(self, unit: Unit, packet: Packet) -> Packet | None:
        """Execute a request; return the answer if the unit's status return level includes one."""
        now, params = self._clock.now(), packet.params
        ident, answers_from = unit.get(p.ID), unit.get(p.STATUS_LEVEL)
        level, error, data = 2, Alarm(0), b""
        match packet.code, len(params):
            case Instruction.PING, 0:
                level = 0
            case Instruction.READ, 2:
                level = 1
                error, data = unit.read(params[0], params[1], now)
            case Instruction.WRITE, size if size >= 2:
                error = unit.write(params[0], params[1:], now)
            case Instruction.REG_WRITE, size if size >= 2:
                error = unit.register(params[0], params[1:])
            case Instruction.ACTION, 0:
                error = unit.act(now)
            case Instruction.RESET, 0:
                unit.factory_reset()
            case _:
                error = Alarm.INSTRUCTION
        return Packet(ident, unit.error(now) | error, data) if answers_from >= level else None

    def _sync_write(self, params: bytes) -> None:
        if len(params) < 2 or (len(params) - 2) % (params[1] + 1):
            return
        address, width = params[0], params[1]
        for at in range(2, len(params), width + 1):
            for unit in self._listening(params[at]):
                unit.write(address, params[at + 1 : at + 1 + width], self._clock.now())

    def _answer(self, end: DeviceEnd, answers: Sequence[Packet], units: Sequence[Unit]) -> None:
        if not answers:
            return
        wire = answers[0].encode()
        if len(answers) > 1:
            wire = self._garbled(wire)
        delay = min(unit.get(p.RETURN_DELAY) for unit in units) * p.DELAY_UNIT
        for damage in filter(self.faults.strikes, DAMAGES):
            match damage:
                case "mute":
                    return
                case "truncate":
                    wire = wire[:-2]
                case "garble":
                    wire = self._garbled(wire)
                case "double":
                    wire += wire
        if self._late:
            self._late -= 1
            asyncio.get_running_loop().call_later(self._late_s, end.write, wire)
            return
        end.write(wire, self.latency_s + delay + 10 / p.AX12_BAUD)

    def _garbled(self, wire: bytes) -> bytes:
        noise = self._rng.integers(1, 256, len(wire), dtype=np.uint8)
        return bytes(np.frombuffer(wire, dtype=np.uint8) ^ noise)


def really(joint: JointConfig, horn: Horn) -> tuple[float, int]:
    """Actual zero position (steps) and direction of a joint, given its assembly."""
    zero = joint.zero if horn.zero is None else horn.zero
    return float(zero), joint.direction if horn.direction is None else horn.direction


class TrueJoints:
    """``JointSource`` with the true shaft positions of an emulated stabiliser.

    Args:
        bus: bus of the units.
        config: assignment of units to joints.
        horns: how each servo is assembled.
    """

    def __init__(self, bus: Ax12Bus, config: Ax12Config, horns: tuple[Horn, Horn] = (AS_SET, AS_SET)) -> None:
        self._bus = bus
        self._joints = [
            (joint.id, *really(joint, horn)) for joint, horn in zip((config.pitch, config.roll), horns, strict=True)
        ]

    def angles(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pitch and roll of the mount (rad)."""
        pitch, roll = (
            direction * (self._bus.angles(ident, times_ns) - zero * p.STEP) for ident, zero, direction in self._joints
        )
        return pitch, roll


def emulated(setup: EmulatorSetup) -> Ax12Bus:
    """Create both units under a simulated truck's lidar, at rest and parallel to the body, with the real bus speed."""
    config: Ax12Config = setup.settings or Ax12Config()
    joints, horns = (config.pitch, config.roll), setup.physics.horns()
    real = {joint.id: really(joint, horn) for joint, horn in zip(joints, horns, strict=True)}
    places = {ident: zero for ident, (zero, _) in real.items()}
    numbers = {ident: (i, direction) for i, (ident, (_, direction)) in enumerate(real.items())}

    def load(ident: int, _time_ns: int) -> float:
        number, direction = numbers[ident]
        return direction * setup.physics.mount_torque(number)

    bus = Ax12Bus(setup.clock, [joint.id for joint in joints], load=load, seed=setup.seed, positions=places)
    setup.port.device.baud = p.AX12_BAUD
    setup.physics.carry_lidar(TrueJoints(bus, config, horns))
    return bus
