"""One emulated AX-12A: control table, control loop, temperature and alarms."""

from collections import deque
from collections.abc import Callable
from functools import partial
from math import copysign, exp, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.protocol import Alarm, Register
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND

Load = Callable[[int, int], float]
"""Load torque (N m) on the shaft of a unit (first argument) at a time (ns); counter-clockwise positive."""
Voltage = Callable[[int], float]
"""Supply voltage at a time (ns), V."""

REPORTED: Final = {
    "position": p.PRESENT_POSITION,
    "speed": p.PRESENT_SPEED,
    "load": p.PRESENT_LOAD,
    "voltage": p.PRESENT_VOLTAGE,
    "temperature": p.PRESENT_TEMPERATURE,
    "moving": p.MOVING,
}
ORDERED: Final = {
    p.TORQUE_ENABLE: "torque_enable",
    p.GOAL_POSITION: "goal_position",
    p.MOVING_SPEED: "moving_speed",
    p.TORQUE_LIMIT: "torque_limit",
}


def unit_signals(number: int) -> dict[str, SignalKind]:
    """Return a unit's signals; ``number`` is its position on the bus, counted from 1."""
    kinds = {f"{name}_{number}": SignalKind.NUMBER for name in REPORTED}
    return kinds | {f"{name}_{number}": SignalKind.ORDER for name in ORDERED.values()}


TICK: Final = 2_000_000
"""Step of the motion simulation (ns)."""
OVERLOAD_TIME: Final = 1.0
"""Overload duration that triggers the alarm (s)."""
AMBIENT: Final = 25.0
NO_ALARM: Final = Alarm(0)


class Unit:
    """One emulated servo; its simulated time advances when its state is read.

    The shaft moves to the goal at a speed proportional to the drive. The drive rises over the compliance slope beyond
    the margin, is at least the punch, and is limited by torque limit and moving speed. A load slows the shaft down.

    Args:
        ident: id on the bus.
        position: initial shaft position (steps).
        time_ns: current time.
        load: load on the shaft.
        voltage: supply voltage.
        signals: signals of the whole bus.
        number: position on the bus, counted from 1; the suffix of its signal names.
    """

    def __init__(
        self,
        ident: int,
        position: float,
        time_ns: int,
        load: Load,
        voltage: Voltage,
        signals: Signals,
        number: int,
    ) -> None:
        self._signals = signals
        self._number = number
        self.blocked = False
        self.frozen = False
        """Whether the position sensor repeats its last value."""
        self.stray: float | None = None
        """Position (steps) that the control loop turns to instead of the goal."""
        self.powered = True
        self.present = True
        """Whether the unit is on the bus."""
        self.latched = True
        """Whether alarms stay in the error bits until torque is switched on; otherwise only while their cause lasts."""
        self.temperature = AMBIENT
        self.position = position
        self._load = load
        self._voltage = voltage
        self._time = time_ns
        self._speed = 0.0
        self._drive = 0.0
        self._overload_for = 0.0
        self._alarms = NO_ALARM
        self._sensed = position
        self._pending: tuple[int, bytes] | None = None
        history = 1024  # number of past shaft positions that are kept: two seconds of motion
        self._past: deque[tuple[int, float]] = deque([(time_ns, position)], maxlen=history)
        self._table = bytearray(p.TABLE_SIZE)
        self._values: dict[int, int] = {}
        """Register values by address, as in the register table."""
        self.factory_reset()
        self.put(p.ID, ident)

    # Control table

    def get(self, register: Register) -> int:
        """Value of a register."""
        return self._values[register.address]

    def put(self, register: Register, value: int) -> None:
        """Set a register regardless of its access rights."""
        self._table[register.address : register.address + register.size] = register.encode(value)
        self._values[register.address] = value

    def read(self, address: int, count: int, time_ns: int) -> tuple[Alarm, bytes]:
        """Read bytes of the table; the returned error bits concern only this request."""
        if not count or address + count > p.TABLE_SIZE:
            return Alarm.RANGE, b""
        self.advance(time_ns)
        self._refresh()
        return NO_ALARM, bytes(self._table[address : address + count])

    def write(self, address: int, data: bytes, time_ns: int) -> Alarm:
        """Write all bytes, or none if an error bit is returned."""
        error = self._refusal(address, data)
        if error:
            return error
        self.advance(time_ns)
        table = self._table.copy()
        table[address : address + len(data)] = data
        for register in p.REGISTERS:
            if not self._touches(register, address, data):
                continue
            value, name = register.decode(table), ORDERED.get(register)
            if name is None:
                self.put(register, value)
            else:
                self._signals.order(f"{name}_{self._number}", value, partial(self._obey, register))
        return error

    def _obey(self, register: Register, value: int) -> None:
        self.put(register, min(max(value, 0), register.high))
        if register is p.TORQUE_LIMIT and self.get(p.TORQUE_LIMIT):
            self._alarms &= ~(Alarm.OVERLOAD | Alarm.OVERHEAT)
            self._overload_for = 0.0

    def register(self, address: int, data: bytes) -> Alarm:
        """Store a write to execute at the next ``act``."""
        error = self._refusal(address, data)
        if not error:
            self._pending = (address, data)
            self.put(p.REGISTERED, 1)
        return error

    def act(self, time_ns: int) -> Alarm:
        """Execute the stored write."""
        if self._pending is None:
            return Alarm.INSTRUCTION
        (address, data), self._pending = self._pending, None
        self.put(p.REGISTERED, 0)
        return self.write(address, data, time_ns)

    def factory_reset(self) -> None:
        """Reset every register to its default, including the id (1)."""
        for register in p.REGISTERS:
            self.put(register, register.default)
        self._boot()

    def _boot(self) -> None:
        for register in p.REGISTERS:
            if not register.is_stored:
                self.put(register, register.default)
        self.put(p.TORQUE_LIMIT, self.get(p.MAX_TORQUE))
        self._alarms = NO_ALARM
        self._overload_for = 0.0
        self._pending = None

    def _refusal(self, address: int, data: bytes) -> Alarm:
        end = address + len(data)
        if not data or end > p.TABLE_SIZE:
            return Alarm.RANGE
        if address < p.RAM_START and self.get(p.LOCK):
            return Alarm.RANGE
        table = self._table.copy()
        table[address:end] = data
        for register in p.REGISTERS:
            if not self._touches(register, address, data):
                continue
            value = register.decode(table)
            unlocks = register is p.LOCK and value < self.get(p.LOCK)
            if register.read_only or unlocks or value > register.high:
                return Alarm.RANGE
            if register is p.GOAL_POSITION and not self.wheel_mode and not self._reachable(value):
                return Alarm.ANGLE
        return NO_ALARM

    def _touches(self, register: Register, address: int, data: bytes) -> bool:
        return register.address < address + len(data) and address < register.address + register.size

    def _reachable(self, goal: int) -> bool:
        return self.get(p.CW_LIMIT) <= goal <= self.get(p.CCW_LIMIT)

    @property
    def wheel_mode(self) -> bool:
        """Whether the unit is in endless-turn mode: both angle limits are 0."""
        return not self.get(p.CW_LIMIT) and not self.get(p.CCW_LIMIT)

    def _refresh(self) -> None:
        """Update the measurements in the table."""
        if not self.frozen:
            self._sensed = self.position
        measured = {
            p.PRESENT_POSITION: min(max(round(self._sensed), 0), p.POSITION_MAX),
            p.PRESENT_SPEED: round(self._speed * p.STEP / p.SPEED_UNIT),
            p.PRESENT_LOAD: round(self._drive / p.LOAD_UNIT),
            p.PRESENT_VOLTAGE: round(self._volts() / p.VOLT_UNIT),
            p.PRESENT_TEMPERATURE: round(self.temperature),
            p.MOVING: int(self._speed != 0),
        }
        for name, register in REPORTED.items():
            value = self._signals.report(f"{name}_{self._number}", measured[register])
            if register in (p.PRESENT_SPEED, p.PRESENT_LOAD):
                self.put(register, p.to_sign_bit(value))
            else:
                self.put(register, min(max(value, 0), register.high))

    def error(self, time_ns: int) -> Alarm:
        """Error bits from the unit's state."""
        self.advance(time_ns)
        return self._alarms

    def trip(self, alarm: Alarm) -> None:
        """Trigger an alarm now."""
        self._alarms |= alarm
        if alarm & self.get(p.SHUTDOWN):
            self.put(p.TORQUE_LIMIT, 0)

    # Supply

    def power(self, on: bool, time_ns: int) -> None:
        """Switch the supply; the EEPROM and the shaft's position survive."""
        self.advance(time_ns)
        self.powered = on
        if on:
            self._boot()

    def _volts(self) -> float:
        return self._voltage(self._time)

    # Motion

    def angles(self, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Shaft positions (steps) at times within the last few seconds; otherwise the nearest known position."""
        self.advance(int(times_ns.max()))
        if times_ns.min() >= self._time:
            return np.full(times_ns.shape, self.position)
        oldest, since = int(times_ns.min()), list[tuple[int, float]]()
        for point in reversed(self._past):
            since.append(point)
            if point[0] <= oldest:
                break
        past = np.array(since[::-1])
        return np.asarray(np.interp(times_ns.astype(np.float64), past[:, 0], past[:, 1]))

    def advance(self, time_ns: int) -> None:
        """Let time pass."""
        while self._time < time_ns:
            self._drive = self._wanted_drive()
            self._speed = self._wanted_speed()
            idle_tick = 100_000_000  # nanoseconds of one step of a motion without speed, as where the shaft stalls
            tick = TICK if self._speed else idle_tick if self._drive else time_ns
            span = min(tick, time_ns - self._time)
            self._step(span / SECOND)
            self._time += span
            self._past.append((self._time, self.position))
            self._judge(span / SECOND)

    @property
    def _aim(self) -> float:
        return float(self.get(p.GOAL_POSITION)) if self.stray is None else self.stray

    def _wanted_drive(self) -> float:
        if not self.powered or not self.get(p.TORQUE_ENABLE):
            return 0.0
        limit = self.get(p.TORQUE_LIMIT) / 1023
        if self.wheel_mode:
            drive = p.from_sign_bit(self.get(p.MOVING_SPEED)) / 1023
            return copysign(min(abs(drive), limit), drive)
        left = self._aim - self.position
        margin, slope = (p.CCW_MARGIN, p.CCW_SLOPE) if left > 0 else (p.CW_MARGIN, p.CW_SLOPE)
        beyond = abs(left) - self.get(margin)
        if beyond <= 0:
            return 0.0
        drive = max(self.get(p.PUNCH) / 1023, beyond / p.slope_of(self.get(slope)))
        return copysign(min(drive, limit, 1.0), left)

    def _wanted_speed(self) -> float:
        """Commanded speed (steps/s)."""
        push = self._load(self.get(p.ID), self._time)
        rated_voltage = 12.0
        volts = self._volts() / rated_voltage
        if self.blocked or volts <= 0:
            return 0.0
        gear_friction = 0.15  # N m that the unpowered gear holds
        if self._drive == 0 and abs(push) <= gear_friction:
            return 0.0
        no_load_speed = 59 * tau / 60 / p.STEP  # steps a second at rated voltage and full drive
        stall_torque = 1.5  # N m at rated voltage
        speed = no_load_speed * (self._drive * volts + push / stall_torque)
        top = self.get(p.MOVING_SPEED) * p.SPEED_UNIT / p.STEP
        if self.wheel_mode or not top or not self._drive:
            return speed
        return copysign(min(abs(speed), top), speed)

    def _step(self, seconds: float) -> None:
        move = self._speed * seconds
        if self.wheel_mode:
            self.position = (self.position + move) % (tau / p.STEP)
        elif self._speed:
            left = self._aim - self.position
            overshoots = self._drive * move > 0 and abs(move) > abs(left)
            before = self.position
            self.position = min(max(before + (left if overshoots else move), 0.0), float(p.POSITION_MAX))
            self._speed = (self.position - before) / seconds
        heat_rise = 80.0  # final temperature above ambient at full drive, degrees
        target = AMBIENT + heat_rise * self._drive**2
        heat_time = 100.0  # time constant of the temperature, s
        self.temperature += (target - self.temperature) * (1 - exp(-seconds / heat_time))

    def _judge(self, seconds: float) -> None:
        if not self.powered:
            return
        overload_drive = 0.8  # fraction of the full torque that counts as overload without motion
        stalled = abs(self._drive) >= min(overload_drive, self.get(p.TORQUE_LIMIT) / 1023) and abs(self._speed) < 1
        self._overload_for = self._overload_for + seconds if stalled and self._drive else 0.0
        volts = self._volts() / p.VOLT_UNIT
        fired = NO_ALARM
        if self._overload_for > OVERLOAD_TIME:
            fired |= Alarm.OVERLOAD
        if self.temperature > self.get(p.TEMPERATURE_LIMIT):
            fired |= Alarm.OVERHEAT
        if not self.get(p.VOLTAGE_MIN) <= volts <= self.get(p.VOLTAGE_MAX):
            fired |= Alarm.VOLTAGE
        if fired or self._alarms:
            self._alarms = self._alarms & (Alarm.OVERLOAD | Alarm.OVERHEAT) if self.latched else NO_ALARM
            self.trip(fired)


def steady_voltage(_: int) -> float:
    """Supply voltage from an ideal 12 V converter."""
    return 11.1


def no_load(_: int, __: int) -> float:
    """Return no load torque."""
    return 0.0
