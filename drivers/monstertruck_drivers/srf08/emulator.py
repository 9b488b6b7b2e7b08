"""Emulated SRF08 sonars behind a USB-ISS, byte for byte."""

from dataclasses import dataclass
from math import inf
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, ReceivedBytes, SonarSource
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_drivers.srf08.protocol import (
    ABSENT,
    ACK,
    I2C_AD1,
    ISS,
    MODULE,
    RANGE_IN_MICROSECONDS,
    Srf08Register,
    ranging_time,
)
from monstertruck_runtime.clock import MILLISECOND, SECOND, Clock

ANSWER: Final = MILLISECOND
"""Duration of a command on USB and I2C (ns)."""
SOUND: Final = 343.0


@dataclass(slots=True)
class Module:
    """One sonar; it loses its gain and range at power-off."""

    name: str
    gain: int = 31
    range: int = 255
    busy_until: int = 0
    light: int = 120
    microseconds: int = 0
    pending: bool = False
    stuck: int | None = None
    dead: bool = False
    ghost: int | None = None


class Srf08Emulator(FaultyDevice):
    """A USB-ISS with one SRF08 for each sonar in the settings.

    Faults (`inject`): ``silent on|off`` (the USB-ISS), ``dead NAME on|off`` (off the bus), ``stuck NAME on|off`` (the
    same flight time forever), ``ghost NAME METRES|off`` (a false echo), ``brownout NAME`` (loses gain and
    range), ``extra`` (an unrequested byte).

    Args:
        clock: time.
        source: physics to measure.
        settings: names and addresses.
        seed: seed for the timer jitter.
    """

    def __init__(
        self, clock: Clock, source: SonarSource, settings: Srf08Config | None = None, *, seed: int = 0
    ) -> None:
        self.name = "srf08"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self.modules = {sonar.address: Module(name) for name, sonar in (settings or Srf08Config()).sonars.items()}
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        names = [module.name for module in self.modules.values()]
        kinds = dict.fromkeys([f"echo_{name}" for name in names], SignalKind.NUMBER)
        kinds |= dict.fromkeys([f"{order}_{name}" for order in ("gain", "range") for name in names], SignalKind.ORDER)
        kinds |= dict.fromkeys([f"ping_{name}" for name in names], SignalKind.SWITCH)
        self.signals = Signals(clock.now, kinds, self._rng)
        known = "|".join(names)
        self.faults = FaultTable(
            self.name,
            {
                "silent on|off": False,
                f"dead {known} on|off": self._kill,
                f"stuck {known} on|off": self._stick,
                f"ghost {known} METRES|off": self._haunt,
                f"brownout {known}": self._brown_out,
                "extra": self._send_extra,
            },
        )
        self._i2c = False
        self._end: DeviceEnd | None = None

    async def run(self, end: DeviceEnd) -> None:
        """Answer until cancelled."""
        self._end = end
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is the supply of all
        buffer, last = b"", 0
        while True:
            data = await end.read()
            now = self._clock.now()
            self.received.extend(data)
            # 0.02: seconds after which the USB-ISS drops an incomplete command
            buffer = data if now - last > 0.02 * SECOND else buffer + data
            last = now
            while (size := _size(buffer)) is not None and size <= len(buffer):
                command, buffer = buffer[:size], buffer[size:]
                await self._clock.sleep_until(self._clock.now() + ANSWER)
                answer = self._answer(command)
                if not self.faults["silent"]:
                    end.write(answer)

    def power_cycle(self) -> None:
        """Switch the supply off and on."""
        self._i2c = False
        for module in self.modules.values():
            module.gain, module.range, module.busy_until, module.pending = 31, 255, 0, False

    def _module(self, name: str) -> Module:
        return {module.name: module for module in self.modules.values()}[name]

    def _kill(self, name: str, dead: bool) -> None:
        self._module(name).dead = dead

    def _stick(self, name: str, stuck: bool) -> None:
        module = self._module(name)
        module.stuck = module.microseconds if stuck else None

    def _haunt(self, name: str, metres: str) -> None:
        self._module(name).ghost = None if metres == "off" else round(float(metres) * 2e6 / SOUND)

    def _brown_out(self, name: str) -> None:
        module = self._module(name)
        module.gain, module.range = 31, 255

    def _send_extra(self) -> None:
        if self._end is None:
            raise ValueError("no host")
        self._end.write(b"\x00")

    def _answer(self, command: bytes) -> bytes:
        if command[0] == ISS:
            if command[1] == 0x01:
                return bytes((MODULE, 8, 0x60 if self._i2c else 0x00))  # firmware of the USB-ISS
            self._i2c = command[1] == 0x02 and 0x20 <= command[2] <= 0x80
            return bytes((ACK, 0)) if self._i2c else b"\x00\x05"
        if command[0] != I2C_AD1:
            return b"\x00"
        address, first, count = command[1], command[2], command[3]
        module = self.modules.get(address & 0xFE)
        if module is not None and (module.dead or not self._i2c or self._clock.now() < module.busy_until):
            module = None
        if address & 1:
            return bytes(ABSENT for _ in range(count)) if module is None else self._read(module)[first : first + count]
        if module is None:
            return b"\x00"
        for register, value in enumerate(command[4:], first):
            self._write(module, register, value)
        return b"\x01"

    def _write(self, module: Module, register: int, value: int) -> None:
        def set_gain(given: int) -> None:
            module.gain = min(max(given, 0), 31)

        def set_range(given: int) -> None:
            module.range = min(max(given, 0), 255)

        def ping(_: None) -> None:
            now = self._clock.now()
            self._source.fire(module.name, now)
            module.busy_until = now + round(ranging_time(module.range) * SECOND)
            module.pending = True

        if register == Srf08Register.GAIN:
            self.signals.order(f"gain_{module.name}", value, set_gain)
        elif register == Srf08Register.RANGE:
            self.signals.order(f"range_{module.name}", value, set_range)
        elif register == Srf08Register.COMMAND and value == RANGE_IN_MICROSECONDS:
            self.signals.order(f"ping_{module.name}", None, ping)

    def _read(self, module: Module) -> bytes:
        jitter = 3.0  # standard deviation of a flight time, us
        if module.pending:
            module.pending = False
            distance = self._source.range(module.name)
            module.microseconds = 0
            if distance < inf:
                flight = 2e6 * distance / SOUND + jitter * float(self._rng.standard_normal())
                if flight < ranging_time(module.range) * 1e6:
                    module.microseconds = max(1, round(flight))
            if module.ghost is not None:
                module.microseconds = module.ghost + round(jitter * float(self._rng.standard_normal()))
        echo = module.microseconds if module.stuck is None else module.stuck
        echo = min(max(self.signals.report(f"echo_{module.name}", echo), 0), 0xFFFF)
        return bytes((10, module.light, echo >> 8 & 0xFF, echo & 0xFF)) + bytes(32)  # software of the sonars


def _size(buffer: bytes) -> int | None:
    """Return the length of the command at the start of ``buffer``; None if it is not yet known."""
    if not buffer:
        return None
    if buffer[0] == ISS:
        return None if len(buffer) < 2 else {0x02: 4}.get(buffer[1], 2)
    if buffer[0] == I2C_AD1:
        return None if len(buffer) < 4 else 4 if buffer[1] & 1 else 4 + buffer[3]
    return 1


def emulated(setup: EmulatorSetup) -> Srf08Emulator:
    """Create a simulated robot's sonars."""
    return Srf08Emulator(setup.clock, setup.physics.sonars, setup.settings, seed=setup.seed)
