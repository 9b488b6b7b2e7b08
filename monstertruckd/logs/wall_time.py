"""From the log's daemon time to the calendar.

Logs keep the daemon's monotonic time, because a robot without a real-time clock learns the date late and is stepped
by hours. What the log last knew of the offset dates all of it, its first messages too.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import CLOCK
from monstertruckd.logs.reader import DAMAGE, LogReader, index_is_sound

_PLAUSIBLE: Final = 946_684_800 * SECOND
"""2000-01-01: earlier dates come from a virtual clock, or from a computer that never learned the time."""


def real_offset(reader: LogReader) -> int:
    """Real (UNIX) minus daemon time, ns, as the log last knew it; 0 if it never did."""
    try:
        newest = _newest_by_index(reader.path)
    except DAMAGE:
        newest = _newest_readable(reader)
    if newest is not None:
        return wire.decode(CLOCK, newest).offset
    return first_offset(reader.metadata().get("run", {}))


def first_offset(metadata: Mapping[str, str]) -> int:
    """Real minus daemon time, ns, when the run began; 0 if that is not in its metadata, or no number."""
    try:
        return int(metadata.get("real_offset_ns", 0))
    except ValueError:
        return 0


def _newest_by_index(path: Path) -> bytes | None:
    if not index_is_sound(path):
        raise McapError
    with path.open("rb") as file:
        last = next(make_reader(file, validate_crcs=True).iter_messages(topics=CLOCK.name, reverse=True), None)
    return None if last is None else last[2].data


def _newest_readable(reader: LogReader) -> bytes | None:
    newest: bytes | None = None
    for message in reader:
        newest = message.payload if message.topic == CLOCK.name else newest
    return newest


def is_plausible(real: int) -> bool:
    """Whether a real time, ns, can be the date of a run."""
    return real >= _PLAUSIBLE


def utc(real: int) -> str:
    """A real time, ns, as ``YYYY-MM-DD hh:mm:ss`` UTC."""
    return str(np.datetime64(real // SECOND, "s")).replace("T", " ")
