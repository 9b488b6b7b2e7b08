"""From the log's daemon time to the calendar.

Logs keep the daemon's monotonic time, because a robot without a real-time clock learns the date late and is stepped
by hours. What the log last knew of the offset dates all of it, its first messages too.
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np
from mcap.reader import make_reader

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.topics import CLOCK
from monstertruckd.recorder.reader import DAMAGE, LogReader, index_is_sound

_PLAUSIBLE: Final = 946_684_800 * SECOND
"""2000-01-01: earlier dates come from a virtual clock, or from a computer that never learned the time."""


def real_offset(reader: LogReader) -> int:
    """Real (UNIX) minus daemon time, ns, as the log last knew it; 0 if it never did.

    Raises:
        InputError: what the log says of it is no number.
    """
    newest = _newest_clock(reader)
    if newest is not None:
        return wire.decode(CLOCK, newest).offset
    return first_offset(reader.path, reader.metadata().get("run", {}))


def first_offset(log: Path, metadata: Mapping[str, str]) -> int:
    """Real minus daemon time, ns, when a run began, by its metadata; 0 if that does not say.

    Raises:
        InputError: it says something else than a number.
    """
    text = metadata.get("real_offset_ns", "0")
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{log}: metadata run: real_offset_ns is {text!r}, expected a whole number") from None


def _newest_clock(reader: LogReader) -> bytes | None:
    """Payload of the last clock message: by the index, or by reading through where there is none to rely on."""
    with reader.path.open("rb") as file, suppress(*DAMAGE):
        sound = index_is_sound(file)
        file.seek(0)
        log = make_reader(file, validate_crcs=True)
        if sound and (summary := log.get_summary()) is not None and summary.chunk_indexes:
            last = next(log.iter_messages(topics=CLOCK.name, reverse=True), None)
            return None if last is None else last[2].data
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
