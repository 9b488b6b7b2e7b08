"""Firmware of the emulated EPOS: objects, power states, velocity profile, faults; independent of the protocol."""

import math
from collections.abc import Callable

import numpy as np

from monstertruck_drivers.disobedience import DisobedientMotor
from monstertruck_drivers.emulation import MotorPlant, MotorReading
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.objects import OBJECTS, ObjectEntry
from monstertruck_drivers.epos.protocol import FAULTED, OFF, POWERED, Control, State
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND

DEFAULTS: dict[ObjectEntry, int] = {
    od.NODE_ID: 1,
    od.RS232_RATE: 3,
    od.SOFTWARE_VERSION: 0x2024,
    od.HARDWARE_VERSION: 0x4320,
    od.RS232_TIMEOUT: 500,
    od.INPUT_MASK: od.QUICK_STOP_INPUT,
    od.INPUT_EXECUTION: od.QUICK_STOP_INPUT,
    od.ENCODER_PULSES: 500,
    od.SENSOR_TYPE: 1,
    od.MODE: 1,
    od.MAX_VELOCITY: 25_000,
    od.MARK: 1_000,
    od.ACCELERATION: 10_000,
    od.DECELERATION: 10_000,
    od.QUICK_STOP_DECELERATION: 10_000,
    od.MOTOR_TYPE: 10,
    od.CONTINUOUS_CURRENT: 1_000,
    od.PEAK_CURRENT: 2_000,
    od.POLE_PAIRS: 1,
    od.MOTOR_MAX_SPEED: 25_000,
    od.THERMAL_TIME: 40,
}
"""Factory settings that are not 0."""

REPORTED = (
    od.STATUSWORD,
    od.POSITION,
    od.VELOCITY,
    od.VELOCITY_AVERAGED,
    od.VELOCITY_DEMAND,
    od.CURRENT,
    od.CURRENT_AVERAGED,
    od.ERROR_COUNT,
    od.ERROR_REGISTER,
    od.DIGITAL_INPUTS,
    od.MODE_DISPLAY,
)
"""Objects that change by themselves."""

ORDERED = (
    od.TARGET_VELOCITY,
    od.MAX_VELOCITY,
    od.ACCELERATION,
    od.DECELERATION,
    od.QUICK_STOP_DECELERATION,
    od.MODE,
)
"""Objects whose values move the motor."""

POWER_ORDERS = ("disable_voltage", "quick_stop", "halt", "enable", "fault_reset")
"""Power orders of controlwords."""


def signal_name(entry: ObjectEntry) -> str:
    """Return the name of an object's signal."""
    return entry.name.replace(" ", "_")


def power_order(word: int) -> str:
    """Return the power command in a controlword, one of ``POWER_ORDERS``."""
    if word & Control.FAULT_RESET:
        return "fault_reset"
    if not word & 0x02:
        return "disable_voltage"
    if not word & 0x04:
        return "quick_stop"
    return "halt" if word & (Control.HALT & ~Control.ENABLE) else "enable"


def signals(now: Callable[[], int], rng: np.random.Generator) -> Signals:
    """Return a controller's signals."""
    kinds = dict.fromkeys(map(signal_name, REPORTED), SignalKind.NUMBER)
    kinds |= dict.fromkeys(map(signal_name, ORDERED), SignalKind.ORDER)
    return Signals(now, kinds | dict.fromkeys(POWER_ORDERS, SignalKind.SWITCH), rng)


VOLATILE = (od.CONTROLWORD, od.TARGET_VELOCITY, od.MODE)
"""Objects that are never stored: 0 (mode: its default) after power-up."""

RANGES: dict[ObjectEntry, tuple[int, int]] = {
    od.NODE_ID: (1, 127),
    od.RS232_RATE: (0, 5),
    od.MODE: (-6, 6),
    od.VELOCITY_NOTATION: (-3, 0),
    od.MAX_VELOCITY: (1, 100_000),
    od.TARGET_VELOCITY: (-100_000, 100_000),
    od.ERROR_COUNT: (0, 0),
    od.ENCODER_PULSES: (16, 7_500),
    **dict.fromkeys((od.ACCELERATION, od.DECELERATION, od.QUICK_STOP_DECELERATION), (1, 2**32 - 1)),
}

SERIAL = bytes.fromhex("6301602400001234")


class AccessRefusedError(Exception):
    """An object access that ends with a communication error code."""

    def __init__(self, code: int) -> None:
        super().__init__(od.abort_text(code))
        self.code = code


class FreeMotor:
    """Unloaded motor, used when the emulator runs alone: exact ramps, slow coasting.

    Args:
        supply_v: supply voltage.
    """

    COAST_RPM_S = 20_000.0

    def __init__(self, supply_v: float = 24.0) -> None:
        self.supply_v = supply_v
        self._time = 0
        self._turns = 0.0
        self._rpm = 0.0
        self._goal = 0.0
        self._accel = self.COAST_RPM_S

    def command(self, time_ns: int, target_rpm: float | None, accel_rpm_s: float) -> None:
        """See ``MotorPlant.command``."""
        self._advance(time_ns)
        self._goal = target_rpm or 0.0
        self._accel = self.COAST_RPM_S if target_rpm is None else accel_rpm_s

    def reading(self, time_ns: int) -> MotorReading:
        """See ``MotorPlant.reading``."""
        self._advance(time_ns)
        current = 60.0 * math.copysign(self._rpm != 0, self._rpm) + 0.01 * (self._goal - self._rpm)
        return MotorReading(self._turns, self._rpm, self._rpm, current, self.supply_v)

    def _advance(self, time_ns: int) -> None:
        span = max(0.0, (time_ns - self._time) / SECOND)
        self._time = max(self._time, time_ns)
        ramp = min(span, abs(self._goal - self._rpm) / self._accel)
        speed = self._rpm + math.copysign(self._accel * ramp, self._goal - self._rpm)
        if ramp < span:
            speed = self._goal
        self._turns += ((self._rpm + speed) / 2 * ramp + speed * (span - ramp)) / 60
        self._rpm = speed


class Firmware:
    """The controller's firmware.

    Args:
        now: returns the current time (ns).
        motor: shaft with its load.
        rng: random numbers for noise and state delays.
    """

    def __init__(self, now: Callable[[], int], motor: MotorPlant, rng: np.random.Generator) -> None:
        self.signals = signals(now, rng)
        self._now = now
        self._motor = motor
        self._rng = rng
        self.strict_transitions = False
        """Whether to answer an impossible controlword with "wrong device state" instead of ignoring it."""
        self.latched_quick_stop = False
        """Whether a quick stop can be left only through power stage off (the real controller's behaviour is
        uncertain).
        """
        self.over_voltage_above = 27.0  # volts; the real limit is unknown
        self.causes: set[int] = set()
        """Injected fault codes whose cause is still present; supply faults start and end by themselves."""
        self.quick_stop_input = False
        self.runaway: DisobedientMotor | None = None
        """Deviation of the power stage from the commands."""
        self._live: dict[ObjectEntry, Callable[[MotorReading], int]] = {
            od.STATUSWORD: self._statusword,
            od.POSITION: self._position,
            od.VELOCITY: self._velocity,
            od.VELOCITY_AVERAGED: lambda _: round(self._velocity_average),
            od.VELOCITY_DEMAND: lambda reading: round(reading.demand_rpm),
            od.CURRENT: self._current,
            od.CURRENT_AVERAGED: lambda _: round(self._current_average),
            od.ERROR_COUNT: lambda _: len(self._history),
            od.ERROR_REGISTER: lambda _: int(self.state in FAULTED),
            od.DIGITAL_INPUTS: lambda _: od.QUICK_STOP_INPUT * self.quick_stop_input,
            od.MODE_DISPLAY: lambda _: self._values[od.MODE],
        }
        self._stored = self._factory()
        self.boot()

    def boot(self) -> None:
        """Power up with stored settings, "switch-on disabled", target 0, position 0 and an empty error history."""
        self.state = State.SWITCH_ON_DISABLED
        self._values = dict(self._stored)
        self._history: list[int] = []
        self._pending: tuple[int, State] | None = None
        self._supply: set[int] = set()
        self._command_motor()
        reading = self._motor.reading(self._now())
        self._origin = reading.turns
        self._seen = (self._now(), reading.turns)
        self._velocity_average = reading.rpm
        self._current_average = reading.current_ma

    def shut_down(self) -> None:
        """Handle loss of the supply: the power stage is off."""
        self._set(State.NOT_READY)

    @staticmethod
    def _factory() -> dict[ObjectEntry, int]:
        return {entry: DEFAULTS.get(entry, 0) for entry in OBJECTS.values()}

    @property
    def frame_timeout(self) -> float:
        """Silence after which the controller drops an incomplete frame (s)."""
        return self._values[od.RS232_TIMEOUT] / 1000

    # Objects

    def read(self, index: int, sub: int) -> int:
        """Read an object of up to 32 bits.

        Raises:
            AccessRefusedError: the object does not exist or is not readable.
        """
        entry = self._find(index, sub)
        if entry.access == "wo" or entry.width > 32:
            raise AccessRefusedError(od.READ_OF_WRITE_ONLY if entry.access == "wo" else od.LENGTH_MISMATCH)
        value = self._measured(entry, self.advance())
        if entry in REPORTED:
            value = self.signals.report(signal_name(entry), value)
        low, high = entry.limits
        return entry.encode(min(max(value, low), high))

    def read_long(self, index: int, sub: int) -> bytes:
        """Bytes of an object for a segmented read.

        Raises:
            AccessRefusedError: the object does not exist.
        """
        entry = self._find(index, sub)
        return SERIAL if entry is od.SERIAL_NUMBER else self.read(index, sub).to_bytes(4, "little")[: entry.width // 8]

    def write(self, index: int, sub: int, raw: int) -> None:
        """Write an object.

        Raises:
            AccessRefusedError: the object does not exist or is read-only, the value is out of range, or the state is
                wrong.
        """
        entry = self._find(index, sub)
        if entry.access == "ro":
            raise AccessRefusedError(od.WRITE_OF_READ_ONLY)
        value = entry.decode(raw)
        low, high = RANGES.get(entry, entry.limits)
        if value < low:
            raise AccessRefusedError(od.TOO_LOW)
        if value > high:
            raise AccessRefusedError(od.TOO_HIGH)
        self.advance()
        if entry in ORDERED:
            self.signals.order(signal_name(entry), value, lambda given: self._apply(entry, min(max(given, low), high)))
        elif entry is od.CONTROLWORD:
            self.signals.order(power_order(value), value, self._obey)
        else:
            self._apply(entry, value)

    def _obey(self, word: int) -> None:
        """Execute a controlword; nothing is executed without supply voltage."""
        if self.state is not State.NOT_READY:
            self._control(word)

    def _find(self, index: int, sub: int) -> ObjectEntry:
        entry = OBJECTS.get((index, sub))
        if entry is None:
            known = any(index == known for known, _ in OBJECTS)
            raise AccessRefusedError(od.NO_SUBINDEX if known else od.NO_OBJECT)
        return entry

    def _measured(self, entry: ObjectEntry, reading: MotorReading) -> int:
        if entry in od.ERROR_HISTORY:
            return self._history[entry.sub - 1] if entry.sub <= len(self._history) else 0
        live = self._live.get(entry)
        return self._values[entry] if live is None else live(reading)

    def _position(self, reading: MotorReading) -> int:
        counts = math.floor((reading.turns - self._origin) * self._values[od.ENCODER_PULSES] * od.COUNTS_PER_PULSE)
        return (counts + 2**31) % 2**32 - 2**31

    def _velocity(self, reading: MotorReading) -> int:
        """Velocity (rpm) from the counts within 1 ms, hence coarse."""
        per_ms = self._values[od.ENCODER_PULSES] * od.COUNTS_PER_PULSE / 60_000
        return round(round(reading.rpm * per_ms + self._rng.uniform(-0.5, 0.5)) / per_ms)

    def _current(self, reading: MotorReading) -> int:
        return round(reading.current_ma + 8.0 * self._rng.standard_normal())  # standard deviation, mA

    def _statusword(self, reading: MotorReading) -> int:
        remote = 1 << 9
        word = self.state.value | remote
        velocity_window = 50.0
        if self.state is State.ENABLED and abs(reading.rpm - self._target()) < velocity_window:
            target_reached = 1 << 10
            word |= target_reached
        standstill = 1 << 12
        return word | (standstill if abs(reading.rpm) < velocity_window else 0)

    def _apply(self, entry: ObjectEntry, value: int) -> None:
        match entry:
            case od.ERROR_COUNT:
                self._history.clear()
            case od.STORE:
                if value != od.SAVE:
                    raise AccessRefusedError(od.CANNOT_STORE)
                self._stored = {**self._values, **{entry: DEFAULTS.get(entry, 0) for entry in VOLATILE}}
            case od.RESTORE:
                if value != od.LOAD:
                    raise AccessRefusedError(od.CANNOT_STORE)
                self._stored = self._factory()
            case _:
                self._values[entry] = value
                if self.state is State.ENABLED and entry in (od.TARGET_VELOCITY, od.MODE, od.MAX_VELOCITY):
                    self._command_motor()

    # Power states

    def _control(self, word: int) -> None:
        edge = word & ~self._values[od.CONTROLWORD] & Control.FAULT_RESET
        self._values[od.CONTROLWORD] = word
        if self.state in FAULTED:
            if edge and self.state is State.FAULT and not (self.causes or self._supply):
                self._set(State.SWITCH_ON_DISABLED)
            return
        new = self._transition(word)
        if new is None:
            if self.strict_transitions:
                raise AccessRefusedError(od.WRONG_STATE)
        elif new in (State.SWITCHED_ON, State.ENABLED) and self.state in (State.READY, State.SWITCHED_ON):
            passing = State.REFRESH if new is State.SWITCHED_ON else State.MEASURE_INIT
            self._set(passing)
            self._pending = (self._now() + int(self._rng.uniform(0.1, 0.3) * SECOND), new)
        else:
            self._set(new)
            if new is State.ENABLED:  # also when it was: the halt bit may have changed
                self._command_motor()

    def _transition(self, word: int) -> State | None:
        """State requested by a controlword; None if it cannot be reached from the current state."""
        if not word & 0x02:
            return State.SWITCH_ON_DISABLED
        if not word & 0x04:
            return State.QUICK_STOP if self.state in POWERED else State.SWITCH_ON_DISABLED
        if self.quick_stop_input:
            return None
        if not word & 0x01:
            return None if self.state is State.QUICK_STOP else State.READY
        if not word & 0x08:
            return State.SWITCHED_ON if self.state in (State.READY, State.ENABLED) else None
        if self.state is State.QUICK_STOP and self.latched_quick_stop:
            return None
        return State.ENABLED if self.state in (State.SWITCHED_ON, *POWERED) else None

    def set_quick_stop_input(self, active: bool) -> None:
        """Set the quick-stop input: while it is active, the motor is stopped and cannot be enabled."""
        self.advance()
        self.quick_stop_input = active
        if active and self.state is State.ENABLED:
            self._set(State.QUICK_STOP)
        elif active and self.state not in FAULTED | OFF | {State.QUICK_STOP}:
            self._set(State.SWITCH_ON_DISABLED)
        elif self.runaway is not None:
            self._command_motor()

    def fail(self, code: int) -> None:
        """Handle a fault: add it to the history, react, and switch the power stage off."""
        self._history = [code, *self._history][: od.HISTORY_SIZE]
        running = self.state in POWERED
        self._set(State.FAULT_REACTION_ENABLED if running else State.FAULT_REACTION_DISABLED)
        reaction_time = 0.05  # duration of a fault reaction before the state is FAULT (s)
        self._pending = (self._now() + int(reaction_time * SECOND), State.FAULT)

    def advance(self) -> MotorReading:
        """Update everything that depends on time: filters, supply faults, transient states.

        Returns the motor's state.
        """
        now, state = self._now(), self.state
        reading = self._motor.reading(now)
        then, turns = self._seen
        if now > then:
            span = (now - then) / SECOND
            share = 1 - math.exp(-span / 0.02)  # time constant of the averaged velocity and current, s
            self._velocity_average += share * ((reading.turns - turns) / span * 60 - self._velocity_average)
            self._current_average += share * (reading.current_ma - self._current_average)
            self._seen = (now, reading.turns)
        supply = self._supply_faults(reading.supply_v)
        fresh, self._supply = supply - self._supply, supply
        if fresh and self.state not in FAULTED:
            self.fail(min(fresh))
        if self._pending is not None and now >= self._pending[0]:
            self._set(self._pending[1])
        return reading if self.state is state else self._motor.reading(now)

    def _supply_faults(self, volts: float) -> set[int]:
        if volts < 9.0:  # least supply
            return {od.UNDER_VOLTAGE}
        return {od.OVER_VOLTAGE} if volts > self.over_voltage_above else set()

    def _set(self, state: State) -> None:
        self._pending = None
        if state is not self.state:
            self.state = state
            self._command_motor()

    def run_away(self, runaway: DisobedientMotor | None) -> None:
        """Start to deviate from the commands; None to obey again."""
        self.advance()
        self.runaway = runaway
        self._command_motor()

    def _target(self) -> int:
        halted = self._values[od.CONTROLWORD] & (Control.HALT & ~Control.ENABLE)
        if halted or self._values[od.MODE] != od.PROFILE_VELOCITY:
            return 0
        limit = self._values[od.MAX_VELOCITY]
        return min(max(self._values[od.TARGET_VELOCITY], -limit), limit)

    def _command_motor(self) -> None:
        now = self._now()
        rpm = self._motor.reading(now).rpm
        target, ramp = self._demand(rpm)
        if self.runaway is not None and self.state is not State.NOT_READY:
            target = self.runaway.target(target, rpm, line=self.quick_stop_input)
            ramp = ramp or self._values[od.ACCELERATION]
        self._motor.command(now, target, float(ramp))

    def _demand(self, rpm: float) -> tuple[float | None, int]:
        """Commanded speed (None if the power stage is off) and its ramp (rpm/s)."""
        match self.state:
            case State.ENABLED:
                target = self._target()
                speeding = abs(target) > abs(rpm) and target * rpm >= 0
                return float(target), self._values[od.ACCELERATION if speeding else od.DECELERATION]
            case State.QUICK_STOP | State.FAULT_REACTION_ENABLED:
                return 0.0, self._values[od.QUICK_STOP_DECELERATION]
            case _:
                return None, 0
