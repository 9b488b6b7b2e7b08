"""Log records as messages: publishes the daemon's log on ``event/log``, in the log and in the black box."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import Publisher
from monstertruck_runtime.threads import ThreadHop
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruckd.host.logging_queue import shown

JOURNAL_QUEUE: Final = 256
"""Maximum number of records queued for the loop; beyond, the oldest of the lowest level is lost and counted."""

_LEVELS: Final = (
    (logging.CRITICAL, LogLevel.FATAL),
    (logging.ERROR, LogLevel.ERROR),
    (logging.WARNING, LogLevel.WARNING),
    (logging.INFO, LogLevel.INFO),
)


@dataclass(frozen=True, slots=True)
class _Line:
    """Log record at the time of logging."""

    stamp: int
    level: int
    name: str
    text: str
    file: str
    line: int


class Journal(logging.Handler):
    """Accepts records in any thread and publishes them on the loop, one per turn, with the daemon's clock.

    Skips records logged while a record is being published: they may be caused by the publishing and would never end.

    Args:
        clock: time source; must be readable from any thread, as the wall clock is.
        out: publisher of ``event/log``.
        on_loss: called with the number of records that did not fit.
        reproducible: for the virtual clock: accept only records of the loop's thread, as other threads run on real time
    """

    def __init__(
        self, clock: Clock, out: Publisher[LogRecord], on_loss: Callable[[int], None], *, reproducible: bool
    ) -> None:
        super().__init__()
        self._clock = clock
        self._out = out
        self._loop_thread = threading.get_ident()
        self._reproducible = reproducible
        self._publishing = False
        self._hop: ThreadHop[_Line] = ThreadHop(self._publish, JOURNAL_QUEUE, on_loss, rank=lambda line: line.level)

    def emit(self, record: logging.LogRecord) -> None:
        """Queue the record without waiting; handle a wrong log call like every handler."""
        here = threading.get_ident() == self._loop_thread
        if (here and self._publishing) or (self._reproducible and not here):
            return
        try:
            text = shown(self.format(record))
        except Exception:  # noqa: BLE001  # whatever formatting its arguments raises
            self.handleError(record)
            return
        name = Path(record.pathname).name
        self._hop.put(_Line(self._clock.now(), record.levelno, record.name, text, name, record.lineno))

    def end(self) -> None:
        """Discard queued and future records; call on the loop."""
        self._hop.close()

    def _publish(self, line: _Line) -> None:
        self._publishing = True
        try:
            self._out.put(
                LogRecord(
                    stamp=line.stamp,
                    received=self._clock.now(),
                    seq=self._out.next_seq(),
                    level=next((name for level, name in _LEVELS if line.level >= level), LogLevel.DEBUG),
                    name=line.name,
                    text=line.text,
                    file=line.file,
                    line=line.line,
                )
            )
        finally:
            self._publishing = False


@contextmanager
def published(
    clock: Clock, out: Publisher[LogRecord], on_loss: Callable[[int], None], *, reproducible: bool
) -> Iterator[None]:
    """Publish all logging on ``out`` as well during the context; see ``Journal``."""
    journal = Journal(clock, out, on_loss, reproducible=reproducible)
    root = logging.getLogger()
    root.addHandler(journal)
    try:
        yield
    finally:
        root.removeHandler(journal)
        journal.end()
