"""Device side of ROSArduinoBridge: text lines, a speed controller in whole counts, and the auto-stop timer.

Like the real board, it restarts when its port is opened, ignores input for 1.5 s, and then counts from 0. It executes
damaged commands, because there is no checksum. Its speed controller works in whole counts per period. It stops the
motors when no set-point has arrived for two seconds (published firmware).
"""

import asyncio
from functools import partial
from typing import Final

import numpy as np

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.protocol import BOARD_BAUD, OK, REFUSED, BoardLines
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.disobedience import USAGE, DisobedientMotor
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ReceivedBytes
from monstertruck_drivers.epos.firmware import FreeMotor
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice, LateAnswers
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock

TO_RPM: Final = 60.0


class ArduinoBridgeEmulator(FaultyDevice):
    """Board with two motors.

    Faults (``inject``): ``silent on|off`` (no answers), ``late SECONDS [COUNT]`` (late answers), ``noise COUNT`` (COUNT
    answers contain a wrong byte), ``reset``, ``runaway`` (both motors disobey, see ``DisobedientMotor``).

    Args:
        clock: time.
        plants: motor loads; missing entries are replaced by unloaded motors.
        settings: counts, auto-stop.
    """

    def __init__(
        self, clock: Clock, plants: tuple[MotorPlant, ...] = (), settings: ArduinoBridgeConfig | None = None
    ) -> None:
        self.name = "arduino_bridge"
        self.received = ReceivedBytes()
        """Latest bytes from the host."""
        kinds = dict.fromkeys(("left", "right"), SignalKind.NUMBER)
        kinds |= dict.fromkeys(("run_left", "run_right"), SignalKind.ORDER)
        self.signals = Signals(clock.now, kinds, np.random.default_rng(0))
        self._clock = clock
        self._config = settings or ArduinoBridgeConfig()
        self._plants = [*plants, *(FreeMotor() for _ in range(2 - len(plants)))][:2]
        self._late = LateAnswers()
        self.faults = FaultTable(
            self.name,
            {
                "silent on|off": False,
                "late SECONDS [COUNT]": self._late.start,
                "noise COUNT": 0,
                "reset": self.power_cycle,
                f"runaway {USAGE}": self._run_away,
            },
        )
        self._runaway: DisobedientMotor | None = None
        self._restart()

    def _restart(self, boot: int = 0) -> None:
        now = self._clock.now()
        self._lines = BoardLines(b"\r")
        self._awake_at = now + boot
        self._origin = [plant.reading(now).turns for plant in self._plants]
        self._fed = now
        self._targets: list[float | None] = [None, None]
        self._drive()

    def power_cycle(self) -> None:
        """Switch the supply off and on, or reset the board as opening its port does."""
        boot = 1500 * MILLISECOND  # from a restart to the first answer: the boot loader waits for a new program
        self._restart(boot)

    def _run_away(self, *words: str) -> None:
        self._runaway = DisobedientMotor.parse(*words)
        self._drive()

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch())
            while True:
                data = await end.read()
                self.received.extend(data)
                if self._clock.now() < self._awake_at:
                    continue
                for line in self._lines.feed(data):
                    self._answer(end, self._obey(line))

    async def _watch(self) -> None:
        """Stop the motors when set-points cease to arrive."""
        while True:
            await self._clock.sleep(0.01)  # seconds between two checks of the auto-stop
            if any(self._targets) and self._clock.now() - self._fed > self._config.auto_stop * SECOND:
                self._targets = [0.0, 0.0]
                self._drive()

    def _obey(self, line: bytes) -> bytes:
        verb, *words = line.split(b" ")
        numbers = [_atoi(word) for word in words] + [0, 0]
        match verb:
            case b"m":
                for i, name in enumerate(("run_left", "run_right")):
                    counts = numbers[i] * self._config.pid_rate
                    self.signals.order(name, counts / self._config.counts_per_turn * TO_RPM, partial(self._turn, i))
                self._fed = self._clock.now()
            case b"o":
                full_pwm = 255
                free_rpm = 200.0  # speed of a motor at full PWM, rpm
                left, right = (number / full_pwm * free_rpm if number else None for number in numbers[:2])
                self._targets, self._fed = [left, right], self._clock.now()
                self._drive()
            case b"e":
                return b"%d %d" % self._counts()
            case b"r":
                self._origin = [plant.reading(self._clock.now()).turns for plant in self._plants]
            case b"b":
                return b"%d" % BOARD_BAUD
            case b"u":
                pass  # the emulated controller needs no gains
            case _:
                return REFUSED
        return OK

    def _turn(self, i: int, rpm: float) -> None:
        self._targets[i] = rpm
        self._drive()

    def _drive(self) -> None:
        """Apply the target speeds to the motors."""
        now = self._clock.now()
        for plant, target in zip(self._plants, self._targets, strict=True):
            wanted = target
            if self._runaway is not None:
                wanted = self._runaway.target(target, plant.reading(now).rpm)
            braking = self._config.quick_deceleration if not wanted else self._config.deceleration
            plant.command(now, wanted, braking * TO_RPM / (2 * np.pi))

    def _counts(self) -> tuple[int, int]:
        now, scale = self._clock.now(), self._config.counts_per_turn
        left, right = (
            self.signals.report(name, int((plant.reading(now).turns - origin) * scale // 1))
            for name, plant, origin in zip(("left", "right"), self._plants, self._origin, strict=True)
        )
        return left, right

    def _answer(self, end: DeviceEnd, line: bytes) -> None:
        if self.faults["silent"]:
            return
        if self.faults.strikes("noise"):
            line = bytes((line[0] ^ 0x40,)) + line[1:]
        thinking = 0.001  # seconds from the end of a command to its answer
        end.write(line + b"\r\n", self._late.take(thinking))


def _atoi(word: bytes) -> int:
    """Parse an integer like C's ``atoi``: 0 if there is none."""
    sign, digits = (-1, word[1:]) if word.startswith(b"-") else (1, word)
    end = next((i for i, byte in enumerate(digits) if not 48 <= byte <= 57), len(digits))
    return sign * int(digits[: min(end, 9)] or b"0")


def emulated(setup: EmulatorSetup) -> ArduinoBridgeEmulator:
    """Create the board for a simulated robot's first two shafts, with a realistic line speed."""
    setup.port.device.baud = BOARD_BAUD
    return ArduinoBridgeEmulator(setup.clock, setup.physics.motors[:2], setup.settings)
