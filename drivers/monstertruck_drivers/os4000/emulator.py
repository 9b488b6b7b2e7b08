"""Emulated OS4000, byte for byte."""

import asyncio
import math
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import AttitudeSource, EmulatorSetup, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.os4000.protocol import (
    BAUDS,
    ESC,
    FACTORY_BAUD,
    FORMAT_TAGGED,
    RATE_MAX,
    RATE_MIN,
    Fields,
    Key,
    Sentence,
    Xyz,
    build,
    frame,
)
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

VERSION: Final = b"OS4000-T Ver 2.1\r\n"


@dataclass(slots=True)
class Settings:
    """Non-volatile memory."""

    rate: int
    fields: int
    format: int = FORMAT_TAGGED
    baud: int = BAUDS.index(FACTORY_BAUD)
    mounting: int = 1
    temperature_offset: int = 0

    def store(self, key: Key, number: int) -> bool:
        """Write one setting; return False if the value is refused."""
        match key:
            case Key.RATE if RATE_MIN <= number <= RATE_MAX:
                self.rate = number
            case Key.FIELDS if 0 < number < 512:
                self.fields = number
            case Key.FORMAT if number in (1, 2, 4, 8):
                self.format = number
            case Key.FACTORY_BAUD if 0 <= number < len(BAUDS):
                self.baud = number
            case Key.MOUNTING if 1 <= number <= 6:
                self.mounting = number
            case Key.TEMPERATURE_OFFSET:
                self.temperature_offset = number
            case _:
                return False
        return True


VALUE_KEYS: Final = (Key.RATE, Key.FIELDS, Key.FORMAT, Key.FACTORY_BAUD, Key.MOUNTING, Key.TEMPERATURE_OFFSET)
REPORTED: Final = (
    *("heading", "pitch", "roll", "temperature"),
    *("field_x", "field_y", "field_z", "acceleration_x", "acceleration_y", "acceleration_z"),
)
"""Numbers in a sentence."""
CALIBRATION_KEYS: Final = (Key.CALIBRATE_LEVEL, Key.CALIBRATE_VERTICAL)


class Os4000Emulator(FaultyDevice):
    """OS4000-T that streams from power-up.

    Faults (``inject``): ``frozen on|off`` (repeats one sentence), ``silent on|off``, ``bad_checksum N``, ``empty_field
    TAG`` and ``nan_field TAG`` (TAG ``none`` ends it), ``half_sentence``, ``prompt`` (stray text), ``pending [DIGITS]``
    (an unfinished command, with DIGITS of its value), ``rate N`` and ``format N`` (stored settings changed externally),
    ``disturbance DEGREES`` (added to the heading), ``drift SHARE`` (fraction of the sentence rate), ``host_baud N``
    (the host's rate; if it differs from the unit's rate, both sides see noise).

    Args:
        clock: time.
        source: physics to measure.
        seed: seed for the sensors' fine noise and for garbled bytes.
        rate: stored rate.
        fields: stored field mask.
        terminators: bytes that the firmware accepts as the end of a value.
        settle: pause in the stream after a setting is written (s).
        pace: whether to pace bytes at the unit's baud rate.
    """

    def __init__(
        self,
        clock: Clock,
        source: AttitudeSource,
        *,
        seed: int = 0,
        rate: int = 20,
        fields: int = 335,
        terminators: bytes = b" \r",
        settle: float = 0.8,
        pace: bool = True,
    ) -> None:
        self.name = "os4000"
        self.settings = Settings(rate, fields)
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self.host_baud: int | None = None
        """Rate the host uses; None: the same as the unit."""
        self._clock = clock
        self._source = source
        self._rng = np.random.default_rng(seed)
        kinds = dict.fromkeys(REPORTED, SignalKind.NUMBER)
        self.signals = Signals(clock.now, kinds | {key.name.lower(): SignalKind.ORDER for key in VALUE_KEYS}, self._rng)
        self._terminators = terminators
        self._settle = round(settle * SECOND)
        self._pace = pace
        self.faults = FaultTable(
            self.name,
            {
                "frozen|silent on|off": False,
                "bad_checksum N": 0,
                "empty_field TAG|none": lambda tag: self._spoil_field(tag, ""),
                "nan_field TAG|none": lambda tag: self._spoil_field(tag, "NaN"),
                "half_sentence": 0,
                "prompt": self._prompt,
                "pending [DIGITS]": self._begin_command,
                "rate N": lambda number: self._change(Key.RATE, number),
                "format N": lambda number: self._change(Key.FORMAT, number),
                "disturbance DEGREES": 0.0,
                "drift SHARE": 0.0,
                "host_baud N": self._set_host_baud,
            },
        )
        self._spoiled: tuple[str, str] | None = None
        self._stray = b""
        self._last = b""
        self._end: DeviceEnd | None = None
        self._boot()

    def _boot(self) -> None:
        self._baud = BAUDS[self.settings.baud]
        self._escaped = False
        self._command: Key | None = None
        self._digits = b""
        self.faults["half_sentence"] = 1
        self._resume_at = self._clock.now() + 200_000_000  # nanoseconds from power-up to the first sentence
        self._line_free = self._clock.now()
        if self._end is not None and self._pace:
            self._end.baud = self._baud

    def power_cycle(self) -> None:
        """Switch the supply off and on: an unfinished command is dropped, and the stored baud rate becomes active."""
        self._boot()

    async def run(self, end: DeviceEnd) -> None:
        """Stream, and execute commands."""
        self._end = end
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self._boot()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._stream(end))
            while True:
                data = await end.read()
                self.received.extend(data)
                for byte in data:
                    if self.host_baud in (None, self._baud):
                        self._take(end, byte)

    def _spoil_field(self, tag: str, value: str) -> None:
        self._spoiled = None if tag == "none" else (tag, value)

    def _prompt(self) -> None:
        self._stray = _prompt(Key.MOUNTING)

    def _begin_command(self, digits: str = "") -> None:
        self._command, self._digits = Key.RATE, digits.encode("ascii")

    def _change(self, key: Key, number: str) -> None:
        if not self.settings.store(key, int(number)):
            raise ValueError("out of range")

    def _set_host_baud(self, baud: str) -> None:
        self.host_baud = int(baud)

    # Commands

    def _take(self, end: DeviceEnd, byte: int) -> None:
        if self._escaped:
            self._escaped = False
            self._open(end, byte)
        elif self._command is not None:
            self._value(end, byte)
        elif byte == ESC:
            self._escaped = True

    def _open(self, end: DeviceEnd, byte: int) -> None:
        if byte in VALUE_KEYS or byte in CALIBRATION_KEYS:
            self._command, self._digits = Key(byte), b""
            end.write(_prompt(self._command))
        elif byte == Key.VERSION:
            end.write(VERSION)
        elif byte == Key.CONFIGURATION:
            stored = self.settings
            end.write(
                b"Rate %d Fields %d Format %d Baud %d Mounting %d\r\n"
                % (stored.rate, stored.fields, stored.format, BAUDS[stored.baud], stored.mounting)
            )

    def _value(self, end: DeviceEnd, byte: int) -> None:
        assert self._command is not None
        if byte == ESC:
            self._command = None
        elif byte in self._terminators:
            command, self._command = self._command, None
            if command in VALUE_KEYS and not self._store(command):
                end.write(b"Invalid\r\n")
            self._resume_at = self._clock.now() + self._settle
        elif byte in b"-0123456789" and len(self._digits) < 8:
            self._digits += bytes((byte,))

    def _store(self, command: Key) -> bool:
        try:
            number = int(self._digits)
            return self.signals.order(command.name.lower(), number, partial(self.settings.store, command)) is not False
        except ValueError:
            return False

    # Stream

    async def _stream(self, end: DeviceEnd) -> None:
        last = self._clock.now()
        while True:
            now = self._clock.now()
            period = self._period()
            if period is not None and now >= last + period:
                self._emit(end, now)
                last = max(last + period, now - period)
                continue
            look = 50_000_000  # interval at which a paused stream checks whether it may continue (ns)
            await self._clock.sleep_until(now + look if period is None else min(now + look, last + period))

    def _period(self) -> int | None:
        rate = self.settings.rate
        if rate == 0:
            return None
        seconds = 1 / rate if rate > 0 else float(-rate)
        return round(seconds / (1 + self.faults["drift"]) * SECOND)

    def _emit(self, end: DeviceEnd, now: int) -> None:
        busy = self._escaped or self._command is not None or now < self._resume_at or now < self._line_free
        if busy or self.faults["silent"]:
            return
        line = self._last if self.faults["frozen"] and self._last else self._sentence(now)
        self._last = line
        line = self._spoil(line)
        if self._pace:
            self._line_free = now + len(line) * 10 * SECOND // self._baud
        if self.host_baud not in (None, self._baud):
            line = self._rng.integers(0x80, 0x100, len(line), np.uint8).tobytes()
        end.write(line)

    def _spoil(self, line: bytes) -> bytes:
        if self.faults.strikes("half_sentence"):
            return line[len(line) // 2 :]
        if self.faults.strikes("bad_checksum"):
            return line.replace(b"P", b"p", 1)
        stray, self._stray = self._stray, b""
        return stray + line

    def _sentence(self, now: int) -> bytes:
        reading, report = self._source.compass(now), self.signals.report
        heading = round(report("heading", reading.heading_deg + self.faults["disturbance"]) * 10) % 3600 / 10
        pitch = round(report("pitch", reading.pitch_deg), 1) + 0.0
        roll = round(report("roll", reading.roll_deg), 1) + 0.0
        form = self.settings.format
        if form == 2:
            return frame(f"OHPR,{heading:.1f},{pitch:.1f},{roll:.1f}")
        if form == 4:
            return frame(f"HCHDT,{heading:.1f},T")
        if form == 8:
            return b"%.1f,%.1f,%.1f\r\n" % (heading, pitch, roll)
        x, y, z = self._reported("field", self._noisy(reading.field, 0.3))
        ax, ay, az = self._reported("acceleration", self._noisy(reading.acceleration, 0.001))
        sentence = Sentence(
            heading=heading,
            pitch=pitch,
            roll=roll,
            temperature=report("temperature", reading.temperature_c) + self.settings.temperature_offset,
            field_length=math.hypot(x, y, z),
            field=(x, y, z),
            acceleration_length=math.hypot(ax, ay, az),
            acceleration=(ax, ay, az),
        )
        line = build(sentence, mask=Fields(self.settings.fields))
        return _replace_field(line, *self._spoiled) if self._spoiled is not None else line

    def _reported(self, name: str, vector: Xyz) -> Xyz:
        x, y, z = (self.signals.report(f"{name}_{axis}", value) for axis, value in zip("xyz", vector, strict=True))
        return x, y, z

    def _noisy(self, vector: Xyz, sigma: float) -> Xyz:
        dx, dy, dz = self._rng.standard_normal(3).tolist()
        return vector[0] + sigma * dx, vector[1] + sigma * dy, vector[2] + sigma * dz


def _prompt(command: Key) -> bytes:
    return b"CMD %c\r\nValue and Enter or Esc\r\n" % command


def _replace_field(line: bytes, tag: str, text: str) -> bytes:
    """Replace a field's number by ``text``, with a correct checksum."""
    body = line[1 : line.index(b"*")].decode("ascii")
    start = body.find(tag)
    if start < 0:
        return line
    start += len(tag)
    stop = start
    while stop < len(body) and body[stop] in "+-.0123456789":
        stop += 1
    return frame(body[:start] + text + body[stop:])


def emulated(setup: EmulatorSetup) -> Os4000Emulator:
    """Create a simulated truck's compass."""
    return Os4000Emulator(setup.clock, setup.physics.compass, seed=setup.seed)
