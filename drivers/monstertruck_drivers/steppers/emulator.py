"""Emulated stepper controller: line protocol, ramps, watchdog, and steppers that lose steps.

Like the real controller, it only answers requests, ignores damaged lines, counts commanded steps rather than the
rotor's, steps at whole multiples of its timer period, and starts at 0 after every power-up.
"""

import asyncio
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.disobedience import USAGE, DisobedientMotor
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ReceivedBytes
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice, LateAnswers
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.steppers.protocol import (
    MAX_RATE,
    MOTORS,
    NAME,
    STEPPERS_BAUD,
    VERSION,
    Identity,
    Line,
    LineError,
    MotorState,
    RefusalCode,
    Splitter,
    Status,
    wrapped,
)
from monstertruck_runtime.clock import SECOND, Clock

TICK_US: Final = 10
"""Timer period, microseconds."""
COASTING: Final = 1e6
"""Deceleration of a rotor without current, from friction of its gear and wheel (rpm/s)."""


class StepperEmulator(FaultyDevice):
    """The controller with its motors.

    Faults (``inject``): ``overload MOTOR on|off`` (the rotor blocks), ``silent on|off`` (no answers), ``late SECONDS
    [COUNT]`` (late answers), ``reset`` (the processor restarts at any point), ``noise COUNT`` (COUNT answers contain a
    wrong byte), ``runaway`` (all motors disobey, see ``DisobedientMotor``).

    Args:
        clock: time.
        plants: motor loads; missing entries are replaced by unloaded motors.
        motors: number of motors.
        steps_per_turn: steps per turn of each motor.
    """

    def __init__(
        self,
        clock: Clock,
        plants: Sequence[MotorPlant] = (),
        *,
        motors: int = MOTORS,
        steps_per_turn: int = 400,
    ) -> None:
        self.name = "steppers"
        self.received = ReceivedBytes()
        """Latest bytes from the host."""
        numbers = [f"{what}_{motor}" for what in ("position", "rate") for motor in range(1, motors + 1)]
        kinds = dict.fromkeys(["state", "bad_lines", "time", *numbers], SignalKind.NUMBER)
        kinds |= dict.fromkeys([f"run_{motor}" for motor in range(1, motors + 1)], SignalKind.ORDER)
        kinds |= dict.fromkeys(("stop", "off"), SignalKind.SWITCH)
        self.signals = Signals(clock.now, kinds, np.random.default_rng(0))
        self._clock = clock
        self._identity = Identity(NAME, VERSION, motors, steps_per_turn, TICK_US)
        self._plants = [*plants, *(FreeMotor() for _ in range(motors - len(plants)))][:motors]
        self._held = [False] * motors
        self._late = LateAnswers()
        self.faults = FaultTable(
            self.name,
            {
                "overload MOTOR on|off": self._overload,
                "silent on|off": False,
                "late SECONDS [COUNT]": self._late.start,
                "noise COUNT": 0,
                "reset": self.power_cycle,
                f"runaway {USAGE}": self._run_away,
            },
        )
        self._runaway: DisobedientMotor | None = None
        self._fed_again = asyncio.Event()
        self._boot()

    def _boot(self) -> None:
        now = self._clock.now()
        self._splitter = Splitter()
        self._booted = self._fed = now
        # (4000, 8000, 500): ramp and quick stop, steps/s^2, and watchdog, ms, after power-up
        self._acceleration, self._quick, self._watchdog = (4000, 8000, 500)
        self._state = MotorState.OFF
        self._rates = [0.0] * self._identity.motors
        self._ordered = [0.0] * self._identity.motors
        """Rates of the latest commands (steps/s)."""
        self._counters = [FreeMotor() for _ in self._plants]
        for counter in self._counters:
            counter.reading(now)
        self._stalled = [False] * self._identity.motors
        self._turn(None, self._quick)

    def power_cycle(self) -> None:
        """Switch the supply off and on: coils off, counters at 0, factory settings."""
        self._boot()
        self._fed_again.set()

    def _overload(self, motor: str, held: bool) -> None:
        self._held[int(motor) - 1] = held
        self._drive()

    def _run_away(self, *words: str) -> None:
        self._runaway = DisobedientMotor.parse(*words)
        self._turn(self._asked, self._acceleration)

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch())
            while True:
                data = await end.read()
                self.received.extend(data)
                for line in self._splitter.feed(data):
                    self._answer(end, line)

    def _answer(self, end: DeviceEnd, line: Line) -> None:
        try:
            reply = self._obey(line)
        except LineError:
            reply = Line("e", line.seq, (str(int(RefusalCode.ARGUMENTS)),))
        if self.faults["silent"]:
            return
        data = bytes(reply)
        if self.faults.strikes("noise"):
            data = data[:3] + bytes((data[3] ^ 0x04,)) + data[4:]
        end.write(data, self._late.take(0.0005))  # seconds from the end of a line to its answer

    def _obey(self, line: Line) -> Line:
        verbs: dict[str, Callable[[Line], RefusalCode | None]] = {
            "R": self._run,
            "Q": lambda line: self._stop(line, MotorState.STOPPED),
            "D": lambda line: self._stop(line, MotorState.OFF),
            "S": lambda line: self._expect(line, 0),
        }
        if line.verb == "I":
            self._expect(line, 0)
            return self._identity.line(line.seq)
        if line.verb == "C":
            code = self._set(line)
            return Line("c", line.seq, line.words) if code is None else Line("e", line.seq, (str(int(code)),))
        code = verbs[line.verb](line) if line.verb in verbs else RefusalCode.UNKNOWN
        return self._reported().line(line.seq) if code is None else Line("e", line.seq, (str(int(code)),))

    @staticmethod
    def _expect(line: Line, count: int) -> None:
        line.integers(count)

    def _set(self, line: Line) -> RefusalCode | None:
        ramp, quick, watchdog = line.integers(3)
        if not (0 < ramp <= quick <= 1_000_000 and 50 <= watchdog <= 2000):
            return RefusalCode.ARGUMENTS
        if any(self._status().rates):
            return RefusalCode.NOT_NOW
        self._acceleration, self._quick, self._watchdog = ramp, quick, watchdog
        return None

    def _run(self, line: Line) -> RefusalCode | None:
        rates = line.integers(self._identity.motors)
        if max(map(abs, rates)) > MAX_RATE:
            return RefusalCode.ARGUMENTS
        if self._state is MotorState.WATCHDOG:
            return RefusalCode.TRIPPED
        self._state, self._fed = MotorState.RUN, self._clock.now()
        self._fed_again.set()
        for i, rate in enumerate(rates):
            self.signals.order(f"run_{i + 1}", rate, partial(self._order_rate, i))
        self._turn(self._ordered, self._acceleration)
        return None

    def _order_rate(self, motor: int, rate: int) -> None:
        self._ordered[motor] = _stepped(min(max(rate, -MAX_RATE), MAX_RATE) / 1000)
        if self._running:
            self._turn(self._ordered, self._acceleration)

    def _stop(self, line: Line, state: MotorState) -> None:
        self._expect(line, 0)
        self.signals.order("off" if state is MotorState.OFF else "stop", state, self._order_stop)

    def _order_stop(self, state: MotorState) -> None:
        self._state = state
        self._ordered = [0.0] * self._identity.motors
        self._turn(None if state is MotorState.OFF else self._ordered, self._quick)

    def _turn(self, rates: list[float] | None, acceleration: float) -> None:
        """Command rates (steps/s); None for no current."""
        self._asked = rates
        rates = self._disobeyed(rates)
        self._powered, self._ramp = rates is not None, acceleration * self._rpm
        self._rates = rates or [0.0] * self._identity.motors
        now = self._clock.now()
        for counter, rate in zip(self._counters, self._rates, strict=True):
            counter.command(now, rate * self._rpm, self._ramp if self._powered else COASTING)
        self._drive()

    def _disobeyed(self, rates: list[float] | None) -> list[float] | None:
        """Return the rates that the firmware applies instead of the commanded ones."""
        if (runaway := self._runaway) is None:
            return rates
        now, asked = self._clock.now(), [None] * self._identity.motors if rates is None else rates
        made = [
            runaway.target(None if rate is None else rate * self._rpm, counter.reading(now).rpm)
            for rate, counter in zip(asked, self._counters, strict=True)
        ]
        turning = [rpm / self._rpm for rpm in made if rpm is not None]
        return turning or None

    def _drive(self) -> None:
        """Let the rotors follow the commanded rates within their torque limits."""
        now = self._clock.now()
        for i, (plant, rate) in enumerate(zip(self._plants, self._rates, strict=True)):
            # 150.0: steps/s below which a rotor that stands follows again
            # 300.0: steps/s beyond which a rotor no longer follows: it stands and hums, and the counter counts on
            self._stalled[i] = abs(rate) > (150.0 if self._stalled[i] else 300.0)
            follows = self._powered and not self._stalled[i] and not self._held[i]
            target = (rate * self._rpm if follows else 0.0) if self._powered else None
            plant.command(now, target, self._ramp if follows else COASTING)

    @property
    def _rpm(self) -> float:
        """Shaft speed (rpm) at one step/s."""
        return 60.0 / self._identity.steps_per_turn

    def _status(self) -> Status:
        now = self._clock.now()
        readings = [counter.reading(now) for counter in self._counters]
        return Status(
            self._state,
            self._splitter.bad % 65_536,
            (now - self._booted) // 1_000_000 % (1 << 32),
            tuple(wrapped(int(reading.turns * self._identity.steps_per_turn // 1)) for reading in readings),
            tuple(round(1000 * reading.rpm / self._rpm) for reading in readings),
        )

    def _reported(self) -> Status:
        """Status as sent to the host."""
        true, report = self._status(), self.signals.report
        state = report("state", int(true.state))
        return Status(
            MotorState(state) if state in list(MotorState) else true.state,
            report("bad_lines", true.bad_lines),
            report("time", true.uptime_ms),
            tuple(wrapped(report(f"position_{i}", steps)) for i, steps in enumerate(true.positions, 1)),
            tuple(report(f"rate_{i}", rate) for i, rate in enumerate(true.rates, 1)),
        )

    @property
    def _running(self) -> bool:
        return self._state is MotorState.RUN

    async def _watch(self) -> None:
        """Run the watchdog, which trips even if the host is silent."""
        while True:
            self._fed_again.clear()
            if not self._running:
                await self._fed_again.wait()
                continue
            await self._clock.sleep_until(self._fed + self._watchdog * SECOND // 1000)
            self._trip()

    def _trip(self) -> None:
        if self._running and self._clock.now() - self._fed >= self._watchdog * SECOND // 1000:
            self._state = MotorState.WATCHDOG
            self._turn([0.0] * self._identity.motors, self._quick)


def _stepped(rate: float) -> float:
    """Return the rate nearest to ``rate`` (steps/s) whose period is a whole number of timer ticks."""
    if rate == 0.0:
        return 0.0
    ticks = max(1, round(1e6 / (abs(rate) * TICK_US)))
    return (1.0 if rate > 0 else -1.0) * 1e6 / (ticks * TICK_US)


def emulated(setup: EmulatorSetup) -> StepperEmulator:
    """Create the controller for all driven shafts of a simulated robot, with the real line speed."""
    setup.port.device.baud = STEPPERS_BAUD
    steps = {} if setup.settings is None else {"steps_per_turn": setup.settings.steps_per_turn}
    return StepperEmulator(setup.clock, setup.physics.motors[:MOTORS], **steps)
