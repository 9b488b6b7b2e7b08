"""Lines of the MB7360 (datasheet, "Pin 5 output"): R, four digits in millimetres, carriage return; no commands."""

BAUD = 9600
PERIOD = 0.134
"""Time between lines (s)."""
NEAREST, FARTHEST = 300, 5000
"""Smallest reading, and the reading for no echo (mm)."""
LONGEST = 64
"""Maximum length of an incomplete line in the buffer (bytes)."""


def parse(line: bytes) -> int:
    """Return the distance (mm) of a line without its carriage return.

    Raises:
        ValueError: The line does not have the format of this device.
    """
    if len(line) != 5 or line[:1] != b"R" or not line[1:].isdigit():
        raise ValueError(f"expected R and four digits, got {line!r}")
    return int(line[1:])


class Parser:
    """Incremental parser; counts the lines that it refuses."""

    def __init__(self) -> None:
        self.refused = 0
        self._buffer = b""

    def feed(self, data: bytes) -> list[int]:
        """Return the distances (mm) of the lines completed by ``data``."""
        *lines, rest = (self._buffer + data).split(b"\r")
        self._buffer = rest[-LONGEST:]
        readings = []
        for line in lines:
            try:
                readings.append(parse(line))
            except ValueError:
                self.refused += 1
        return readings
