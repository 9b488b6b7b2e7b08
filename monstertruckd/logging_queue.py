"""Logging that never blocks the control loop: records go through a bounded queue to a thread that writes them."""

import logging
import logging.handlers
import os
import queue
import sys
import threading
from typing import Final, TextIO

DEPTH: Final = 1000
"""Records waiting for a stuck terminal or journal; beyond that they are lost and counted."""
PATIENCE: Final = 1.0
"""Seconds the end of the process waits for a stuck output."""
PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
"""Levels of syslog, which journald reads from a line's head."""


class LossyQueueHandler(logging.handlers.QueueHandler):
    """Counts what does not fit instead of waiting or complaining."""

    lost = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Put the record into the queue, or lose it."""
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self.lost += 1


class LogWriter:
    """The thread that writes; a stuck output never keeps the process from ending."""

    def __init__(self, records: "queue.Queue[logging.LogRecord | None]", output: logging.Handler) -> None:
        self._records = records
        self._output = output
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write what still waits, as far as the output takes it within ``PATIENCE``."""
        try:
            self._records.put(None, timeout=PATIENCE)
        except queue.Full:
            return
        self._thread.join(PATIENCE)

    def _run(self) -> None:
        while (record := self._records.get()) is not None:
            self._output.handle(record)


class PlainFormatter(logging.Formatter):
    """One line a record, with journald's priority in front where the journal reads."""

    def __init__(self, *, journal: bool) -> None:
        super().__init__("%(levelname)-7s %(name)s: %(message)s")
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """The record's text; every line of a traceback keeps the priority."""
        text = super().format(record)
        if not self._journal:
            return text
        head = f"<{PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(head + line for line in text.splitlines())


def start_logging(*, verbose: bool, stream: TextIO = sys.stderr) -> LogWriter:
    """Send all logging to ``stream`` from a thread; ``stop()`` of what is returned writes what still waits."""
    output = logging.StreamHandler(stream)
    output.setFormatter(PlainFormatter(journal="JOURNAL_STREAM" in os.environ))
    records: queue.Queue[logging.LogRecord | None] = queue.Queue(DEPTH)
    root = logging.getLogger()
    root.setLevel(logging.DEBUG if verbose else logging.INFO)
    root.addHandler(LossyQueueHandler(records))
    return LogWriter(records, output)
