"""ROSArduinoBridge text protocol; uses only the standard library because the stop script imports it.

Source: Patrick Goebel and James Nugen, ``commands.h`` and ``ROSArduinoBridge.ino``. The host sends a letter and its
arguments, separated by spaces, and a carriage return. The board answers every command with one line that ends with CR
and LF, and sends nothing else. There is no checksum and no sequence number.

============== =========================================================== =================
command        meaning                                                     answer
============== =========================================================== =================
``m L R``      speed in encoder counts per controller period               ``OK``
``o L R``      raw PWM, -255 to 255, without the controller                ``OK``
``e``          counts of both encoders since power-up or reset             ``L R``
``r``          reset both counters                                         ``OK``
``u P:D:I:O``  gains of the controller                                     ``OK``
``b``          baud rate                                                   a number
============== =========================================================== =================

The board answers any other input with ``Invalid Command``. Without ``m`` or ``o`` for ``AUTO_STOP_INTERVAL``, 2000 ms
as published, the board stops both motors. The interval is compiled in.
"""

import re
from typing import Final

BOARD_BAUD: Final = 57_600
PID_RATE: Final = 30.0
"""Rate of the controller as published (Hz)."""
AUTO_STOP: Final = 2.0
"""Auto-stop interval as published (s)."""
LONGEST_LINE: Final = 64
OK: Final = b"OK"
REFUSED: Final = b"Invalid Command"
_COUNTS: Final = re.compile(rb"(-?\d{1,10}) (-?\d{1,10})")
_NUMBER: Final = re.compile(rb"\d{4,7}")


def speeds(left: int, right: int) -> bytes:
    """Return the command that sets wheel speeds (counts per controller period)."""
    return b"m %d %d\r" % (left, right)


def pwm(left: int, right: int) -> bytes:
    """Return the command that sets raw PWM."""
    return b"o %d %d\r" % (left, right)


ENCODERS: Final = b"e\r"
BAUD_RATE: Final = b"b\r"
END: Final = b"\r"
"""Terminates a partial command left by a host that died."""


def counts_of(line: bytes) -> tuple[int, int] | None:
    """Parse the counts of an answer to ``e``; None if it is invalid."""
    match = _COUNTS.fullmatch(line)
    return None if match is None else (int(match[1]), int(match[2]))


def is_number(line: bytes) -> bool:
    """Whether a line is a valid answer to ``b``."""
    return _NUMBER.fullmatch(line) is not None


class BoardLines:
    """Splits a stream of bytes into lines."""

    def __init__(self, end: bytes = b"\n") -> None:
        self._end = end
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the completed lines without line endings; an overlong line is dropped."""
        self._rest += data
        *lines, rest = bytes(self._rest).split(self._end)
        self._rest = bytearray(rest if len(rest) <= LONGEST_LINE else b"")
        return [line.strip(b"\r\n") for line in lines]
