"""Line protocol of a microcontroller with up to four stepper motors (codec only, no I/O).

115200 baud, 8N1. A line is ``:BODY*CCCC`` and LF, at most 160 bytes: BODY consists of words of printable ASCII
separated by one space, and CCCC is the CRC-16/CCITT-FALSE of BODY (polynomial 0x1021, initial value 0xFFFF) in capital
hex digits. The controller answers every complete line from the host once, with the request's sequence number (0 to
255), and sends nothing else. The first word of a request is a capital letter; the answer starts with the same letter in
lower case:

======================= =================================================== ==========================================
request                 meaning                                             answer
======================= =================================================== ==========================================
``I SEQ``               identify                                            ``i SEQ NAME VERSION MOTORS STEPS PERIOD``
``C SEQ ACC QUICK WD``  ramps (steps/s^2), watchdog (ms); only at rest      ``c SEQ ACC QUICK WD``
``R SEQ RATE...``       run at rates (1/1000 step/s); resets the watchdog   a status
``Q SEQ``               quick stop, then hold                               a status
``D SEQ``               coils off                                           a status
``S SEQ``               read the status without resetting the watchdog      a status
======================= =================================================== ==========================================

NAME is STEP4, VERSION 1; step periods are multiples of PERIOD us. The watchdog is 50 to 2000 ms. After power-up the
motors are off at position 0, with 4000 and 8000 steps/s^2 and 500 ms.

A status is ``s SEQ STATE BAD UPTIME POSITION... RATE...``: state (0 off, 1 running, 2 stopped, 3 by the watchdog),
damaged lines since power-up (0-65535, wraps), uptime in ms (32 bits, wraps), the steps commanded so far (signed 32
bits, wrap) and the current rate of every motor. The answer to a refused request is ``e SEQ CODE``
(1 unknown, 2 invalid arguments, 3 not while a motor turns, 4 watchdog tripped: ``R`` needs a ``Q`` or ``D`` first); a
damaged line gets no answer.
"""

from binascii import crc_hqx
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

NAME: Final = "STEP4"
VERSION: Final = 1
STEPPERS_BAUD: Final = 115_200
MOTORS: Final = 4
MAX_LINE: Final = 160
"""Maximum length of a line (bytes); the controller drops longer ones."""
SEQUENCES: Final = 256
MAX_RATE: Final = 10_000_000
"""Maximum rate of a request (1/1000 step/s)."""

_START, _END = b":", b"\n"
_MASK = 0xFFFF_FFFF


class MotorState(IntEnum):
    """Common state of the motors."""

    OFF = 0
    """Coils off: the motors turn freely, as after power-up."""
    RUN = 1
    """The motors follow the rates of the last ``R``."""
    STOPPED = 2
    """Quick stop, then hold."""
    WATCHDOG = 3
    """Stopped by the watchdog: no ``R`` arrived in time. ``R`` is refused until a ``Q`` or ``D``."""


class RefusalCode(IntEnum):
    """Reason for refusing a request."""

    UNKNOWN = 1
    """Unknown request."""
    ARGUMENTS = 2
    """Wrong number of arguments, or an argument out of range."""
    NOT_NOW = 3
    """Settings can change only while all motors are at rest."""
    TRIPPED = 4
    """The watchdog has stopped the motors: send ``Q`` or ``D`` first."""


class LineError(ValueError):
    """A line that does not conform to the protocol."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line: its letter, sequence number and remaining words."""

    verb: str
    seq: int
    words: tuple[str, ...] = ()

    def __bytes__(self) -> bytes:
        body = " ".join((self.verb, str(self.seq), *self.words)).encode("ascii")
        return b"%b%b*%04X%b" % (_START, body, crc(body), _END)

    def integers(self, count: int | None = None) -> tuple[int, ...]:
        """Return the words as integers.

        Raises:
            LineError: the number of words is wrong, or a word is not a plain decimal number.
        """
        if count is not None and len(self.words) != count:
            raise LineError(f"{self.verb}: {len(self.words)} words, expected {count}")
        if not all(word.removeprefix("-").isdecimal() and len(word) <= 11 for word in self.words):
            raise LineError(f"{self.verb}: {' '.join(self.words)!r}: expected whole numbers")
        return tuple(map(int, self.words))


def crc(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF, no reflection."""
    return crc_hqx(data, 0xFFFF)


def decode(line: bytes) -> Line:
    """Decode one complete line, with or without its LF.

    Raises:
        LineError: the line is damaged or belongs to another protocol.
    """
    text = line.removesuffix(_END)
    body, star, check = text[1:].rpartition(b"*")
    if not text.startswith(_START) or not star or len(text) >= MAX_LINE:
        raise LineError(f"{line[:40]!r}: not a line of this protocol")
    if check != b"%04X" % crc(body):
        raise LineError(f"{line[:40]!r}: check is {check!r}, expected {crc(body):04X}")
    if not body.isascii() or not body.decode().isprintable():
        raise LineError(f"{line[:40]!r}: expected printable ASCII")
    verb, *words = body.decode().split(" ")
    if not (len(verb) == 1 and verb.isalpha() and words and words[0].isdecimal() and all(words)):
        raise LineError(f"{line[:40]!r}: expected a letter and a sequence number")
    seq = int(words[0]) if len(words[0]) <= len(str(SEQUENCES)) else SEQUENCES
    if seq >= SEQUENCES:
        raise LineError(f"{line[:40]!r}: sequence number {words[0]}, expected 0 to {SEQUENCES - 1}")
    return Line(verb, seq, tuple(words[1:]))


class Splitter:
    """Splits a stream of bytes into lines; counts and drops everything outside the protocol."""

    def __init__(self) -> None:
        self.bad = 0
        """Number of dropped lines."""
        self.strange = b""
        """Start of the latest dropped bytes."""
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[Line]:
        """Return the lines completed by ``data``."""
        self._rest += data
        *whole, rest = self._rest.split(_END)
        self._rest = rest if len(rest) < MAX_LINE else bytearray()
        if len(rest) >= MAX_LINE:
            self._drop(bytes(rest))
        lines = []
        for raw in whole:
            # A line without its end is followed directly by the next one.
            text = raw[max(raw.rfind(_START), 0) :]
            try:
                lines.append(decode(bytes(text)))
            except LineError:
                self._drop(bytes(raw))
            else:
                if len(text) < len(raw):
                    self._drop(bytes(raw[: -len(text)]))
        return lines

    def _drop(self, raw: bytes) -> None:
        self.bad += 1
        self.strange = raw[:20]


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of the controller."""

    name: str
    version: int
    motors: int
    steps_per_turn: int
    tick_us: int
    """Timer period (us); the time between two steps is a multiple of it."""

    @classmethod
    def of(cls, line: Line) -> "Identity":
        """Parse an answer to ``I``.

        Raises:
            LineError: the line is not an identity.
        """
        if line.verb != "i" or len(line.words) != 5:
            raise LineError(f"answer {line.verb!r}: expected an identity")
        name, *rest = line.words
        return cls(name, *Line(line.verb, line.seq, tuple(rest)).integers(4))

    def line(self, seq: int) -> Line:
        """Encode the identity as an answer."""
        numbers = (self.version, self.motors, self.steps_per_turn, self.tick_us)
        return Line("i", seq, (self.name, *map(str, numbers)))


@dataclass(frozen=True, slots=True)
class Status:
    """Status of the controller."""

    state: MotorState
    bad_lines: int
    uptime_ms: int
    positions: tuple[int, ...]
    """Commanded steps, signed 32 bits."""
    rates: tuple[int, ...]
    """Rates (1/1000 step/s)."""

    @classmethod
    def of(cls, line: Line, motors: int) -> "Status":
        """Parse an answer from a controller with ``motors`` motors.

        Raises:
            LineError: the line is not a status.
        """
        if line.verb != "s":
            raise LineError(f"answer {line.verb!r}: expected a status")
        state, bad, uptime, *rest = line.integers(3 + 2 * motors)
        if state not in list(MotorState):
            raise LineError(f"state {state}: expected 0 to {max(MotorState)}")
        return cls(MotorState(state), bad, uptime, tuple(rest[:motors]), tuple(rest[motors:]))

    def line(self, seq: int) -> Line:
        """Encode the status as an answer."""
        numbers = (int(self.state), self.bad_lines, self.uptime_ms, *self.positions, *self.rates)
        return Line("s", seq, tuple(map(str, numbers)))


def wrapped(steps: int) -> int:
    """Wrap a number of steps to the controller's signed 32-bit counter."""
    return (steps + (1 << 31) & _MASK) - (1 << 31)


def step_of(before: int, now: int) -> int:
    """Steps between two positions, across the wrap of the counter."""
    return wrapped(now - before)
