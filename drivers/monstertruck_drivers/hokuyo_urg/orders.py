"""Scan orders as the sensor reads them, and what it makes of a revolution for them. Pure, no I/O."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.hokuyo_urg.protocol import RANGE_WIDTH, encode, encode_array, line_sum, wrap_lines

LAST_STEP: Final = 768
LEAST_MM: Final = 20


@dataclass(frozen=True, slots=True)
class Order:
    """A scan somebody asked for."""

    command: str
    """MD, MS, GD, GS or G."""
    start: int
    end: int
    cluster: int = 1
    skip: int = 0
    left: int | None = None
    """Scans still to send; None = endless."""
    prefix: str = ""
    """Request without remaining count and tag."""
    tag: str = ""

    @property
    def echo(self) -> str:
        """First line of the next scan block."""
        return f"{self.prefix}{self.left or 0:02d}" + (f";{self.tag}" if self.tag else "")


def parse_order(text: str, tag: str = "") -> Order | str:
    """Parse MD, MS, GD or GS; a refusal is its two-character status."""
    command, digits = text[:2], text[2:]
    multi = command[0] == "M"
    wanted = 13 if multi else 10
    if len(digits) != wanted:
        return "0C" if len(digits) < wanted else "0D"
    parts = [digits[0:4], digits[4:8], digits[8:10], digits[10:11] or "0", digits[11:13] or "0"]
    for part, status in zip(parts, ("01", "02", "03", "06", "07"), strict=True):
        if not part.isdigit():
            return status
    start, end, cluster, skip, count = (int(part) for part in parts)
    if end > LAST_STEP:
        return "04"
    if end < start:
        return "05"
    return Order(command, start, end, max(cluster, 1), skip, count or None, text[:13], tag)


def parse_scip1_order(text: str) -> Order | None:
    """Parse G of SCIP 1.1; None if it is refused."""
    digits = text[1:]
    if text[:1] != "G" or len(digits) != 8 or not digits.isdigit():
        return None
    start, end, cluster = int(digits[:3]), int(digits[3:6]), int(digits[6:])
    return Order("G", start, end, max(cluster, 1)) if start <= end <= LAST_STEP else None


def scan_lines(order: Order, counter: int, revolution: NDArray[np.int32]) -> list[bytes]:
    """Lines of a scan after its status: time line (not in SCIP 1.1) and data.

    Args:
        order: what was asked for.
        counter: milliseconds at step 0, 24 bits.
        revolution: shape (769,), mm or error codes.
    """
    values = _clustered(revolution[order.start : order.end + 1], order.cluster)
    width = RANGE_WIDTH[order.command]
    payload = encode_array(np.minimum(values, (1 << 6 * width) - 1), width)
    if order.command == "G":
        return wrap_lines(payload, sums=False)
    return [counter_line(counter), *wrap_lines(payload)]


def counter_line(counter: int) -> bytes:
    """Time line with its checksum."""
    text = encode(counter, 4)
    return text + bytes((line_sum(text),))


def _clustered(values: NDArray[np.int32], cluster: int) -> NDArray[np.int32]:
    """Least valid value of each group of neighbours, or the first one's code if none is valid."""
    if cluster == 1:
        return values
    groups = np.pad(values, (0, -len(values) % cluster)).reshape(-1, cluster)
    huge = np.iinfo(np.int32).max
    least = np.where(groups >= LEAST_MM, groups, huge).min(axis=1)
    return np.where(least < huge, least, groups[:, 0]).astype(np.int32)
