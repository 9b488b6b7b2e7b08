"""From the log's daemon time to the calendar.

Logs keep the daemon's monotonic time, because a robot without a real-time clock learns the date late and is stepped
by hours. What the log last knew of the offset dates all of it, its first messages too.
"""

from typing import Final

import numpy as np
from mcap.reader import make_reader

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import CLOCK
from monstertruckd.logs.reader import LogReader
from monstertruckd.logs.recover import is_finished

_PLAUSIBLE: Final = 946_684_800 * SECOND
"""2000-01-01: earlier dates come from a virtual clock, or from a computer that never learned the time."""


def real_offset(reader: LogReader) -> int:
    """Real (UNIX) minus daemon time, ns, as the log last knew it; 0 if it never did."""
    newest: bytes | None = None
    if is_finished(reader.path):
        with reader.path.open("rb") as file:
            last = next(make_reader(file).iter_messages(topics=CLOCK.name, reverse=True), None)
            newest = None if last is None else last[2].data
    else:
        for message in reader:
            newest = message.payload if message.topic == CLOCK.name else newest
    if newest is not None:
        return wire.decode(CLOCK, newest).offset
    return int(reader.metadata().get("run", {}).get("real_offset_ns", 0))


def is_plausible(real: int) -> bool:
    """Whether a real time, ns, can be the date of a run."""
    return real >= _PLAUSIBLE


def utc(real: int) -> str:
    """A real time, ns, as ``YYYY-MM-DD hh:mm:ss`` UTC."""
    return str(np.datetime64(real // SECOND, "s")).replace("T", " ")
