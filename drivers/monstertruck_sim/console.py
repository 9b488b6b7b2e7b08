"""Console commands for emulated devices, from the standard input of an emulator process, from tests or from drills."""

import asyncio
import os
import signal
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, TextIO

from monstertruck_drivers.cable import EmulatedPort, LineFaults
from monstertruck_drivers.emulation import Emulator, FileEmulator, signals_of
from monstertruck_drivers.signals import HELP
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.readable import when_readable

CABLE = (
    "Cable faults: plug, unplug, power-cycle, line stalled|deaf on|off, line delay SECONDS, line chunk "
    "BYTES|off, line flip_rate|drop_rate|lose_rate|double_rate PROBABILITY, line garbage HEX, line "
    "short_writes COUNT"
)


class Commanded(Protocol):
    """Target of console commands."""

    def command(self, words: list[str]) -> None:
        """Execute one command.

        Raises:
            InputError: the command is unknown; the message lists the known commands.
        """


@dataclass(frozen=True, slots=True)
class Emulated:
    """An emulator and the port it is connected to."""

    emulator: Emulator
    port: EmulatedPort

    def command(self, words: list[str]) -> None:
        """Execute one command.

        Raises:
            InputError: the command is unknown; the message lists the known commands.
        """
        match words:
            case ["plug"]:
                self.port.plug()
            case ["unplug"]:
                self.port.unplug()
            case ["power-cycle"]:
                self.emulator.power_cycle()
            case ["line", name, value]:
                set_line_fault(self.port.device.faults, name, value)
            case ["line", *_]:
                raise InputError(CABLE)
            case ["signal", *rest]:
                set_signal_fault(self.emulator, rest)
            case _:
                fault, *values = words or ["help"]
                try:
                    self.emulator.inject(fault, *values)
                except InputError as error:
                    raise InputError(f"{error}; {CABLE}; {HELP}") from None


@dataclass(frozen=True, slots=True)
class EmulatedFiles:
    """Part of the emulated computer; its only commands are its faults."""

    emulator: FileEmulator

    def command(self, words: list[str]) -> None:
        """Execute one command.

        Raises:
            InputError: the command is unknown; the message lists the known commands.
        """
        match words or ["help"]:
            case ["signal", *rest]:
                set_signal_fault(self.emulator, rest)
            case [fault, *values]:
                self.emulator.inject(fault, *values)


def set_signal_fault(emulator: object, words: list[str]) -> None:
    """Falsify an emulator's signal as given by the words NAME FAULT [VALUE].

    Raises:
        InputError: the emulator declares no signals, or the signal or fault is unknown.
    """
    signals = signals_of(emulator)
    if signals is None:
        raise InputError("the emulator of this device names no signals")
    if len(words) < 2:
        raise InputError(f"{HELP}; names: {', '.join(signals.kinds)}")
    signals.inject(*words)


def set_line_fault(faults: LineFaults, name: str, value: str) -> None:
    """Set one cable fault from text.

    Raises:
        InputError: the fault is unknown or its value is invalid.
    """
    try:
        match name:
            case "stalled" | "deaf":
                setattr(faults, name, {"on": True, "off": False}[value])
            case "delay" | "flip_rate" | "drop_rate" | "lose_rate" | "double_rate":
                setattr(faults, name, float(value))
            case "chunk":
                faults.chunk = None if value == "off" else int(value)
            case "short_writes":
                faults.short_writes = int(value)
            case "garbage":
                faults.garbage = bytes.fromhex(value)
            case _:
                raise InputError(CABLE)
    except (KeyError, ValueError) as error:
        raise InputError(f"line {name}: cannot read {value!r}; {CABLE}") from error


@dataclass(frozen=True, slots=True)
class CommandedGroup:
    """Group of targets that a command addresses by name; the name is optional if there is only one."""

    kind: str
    """Noun for the targets, for messages."""
    members: Mapping[str, Commanded]

    def command(self, words: list[str]) -> None:
        """Execute one command.

        Raises:
            InputError: the target or the command is unknown.
        """
        if words and words[0] in self.members:
            self.members[words[0]].command(words[1:])
        elif len(self.members) == 1:
            next(iter(self.members.values())).command(words)
        else:
            first = next(iter(self.members), "")
            raise InputError(
                f"start the line with a {self.kind}: {', '.join(self.members)}; `{first} help` lists its commands"
            )


class FaultConsole:
    """Reads commands line by line."""

    def __init__(self, target: Commanded, source: TextIO, say: Callable[[str], None]) -> None:
        self._target = target
        self._source = source
        self._say = say

    async def run(self) -> None:
        """Execute lines until cancelled; the end of the input ends the commands, not the devices.

        A background process on a terminal receives no lines: its reads fail instead of stopping the process.
        """
        if not _pollable(self._source):
            await asyncio.Event().wait()
        signal.signal(signal.SIGTTIN, signal.SIG_IGN)
        source, news, rest = self._source.fileno(), asyncio.Event(), b""
        when_readable(source, news.set)
        try:
            while True:
                await news.wait()
                news.clear()
                if not (data := _read(source)):
                    break
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self.execute(line.decode(errors="replace"))
            self.execute(rest.decode(errors="replace"))
        finally:
            asyncio.get_running_loop().remove_reader(source)
        await asyncio.Event().wait()

    def execute(self, line: str) -> None:
        """Execute one line; print ``ok`` or an error, or the list of commands if the last word is ``help``."""
        words = line.split()
        if not words:
            return
        try:
            self._target.command(words)
        except InputError as error:
            self._say(str(error) if words[-1] == "help" else f"error: {error}")
        else:
            self._say("ok")


def _read(source: int) -> bytes:
    """Return the text written since the last call, at least one line; empty if there is no terminal to read from."""
    try:
        return os.read(source, 65536)
    except OSError:
        return b""


def _pollable(source: TextIO) -> bool:
    """Whether ``source`` can be polled, as pipes, sockets and terminals can, but not files or /dev/null."""
    try:
        mode = os.fstat(source.fileno()).st_mode
    except (OSError, ValueError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode) or source.isatty()
