"""Logging that never blocks the control loop: records go through a bounded queue to a thread that writes them."""

import io
import logging
import logging.handlers
import os
import queue
import re
import sys
import threading
from collections.abc import Mapping
from copy import copy
from typing import Final, TextIO

LOG_QUEUE: Final = 1000
"""Records waiting for a stuck terminal or journal; beyond that they are lost and counted."""
PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
"""Levels of syslog, which journald reads from a line's head."""

LONGEST_RECORD: Final = 16_384
"""Characters of one record; what is beyond is cut off."""

_KEYS: Final = r"(?:password|passwd|passphrase|secret|token|authorization|(?<![a-z])psk|api[_-]?key)"
_NAMES: Final = ("passw", "passphrase", "secret", "token", "authorization", "psk", "api")
_VALUE: Final = r"(?:(?P<quote>[\"'])(?:(?!(?P=quote))[^\n])*|[^\s'\",;&]+)"
_ASSIGNED: Final = r"[\\'\"]{0,2}\s{0,8}[=:]\s{0,8}\\?(?:(?:basic|bearer|digest)\s{1,8})?"
_INSTEAD: Final = r"\g<head>\g<quote>***"
_SECRETS: Final = (
    (
        ("-----begin",),
        re.compile(r"-----BEGIN ([A-Z ]{0,40}PRIVATE KEY)-----.*?(-----END \1-----|\Z)", re.DOTALL),
        "<private key>",
    ),
    (("@",), re.compile(r"(?<=/)(?:(?<=://)[^\s/'\"<>]+|[^\s/@'\"<>:]*:[^\s/'\"<>]+)(?=@)"), "***"),
    (_NAMES, re.compile(rf"(?i)(?P<head>{_KEYS}{_ASSIGNED}){_VALUE}"), _INSTEAD),
    (("--",), re.compile(rf"(?i)(?P<head>(?<![\w-])--[a-z-]{{0,40}}?{_KEYS}\s{{1,8}}){_VALUE}"), _INSTEAD),
)
"""What no log may show: private keys, credentials in addresses, values named like a secret.

Each with words one of which, in lower case, is in whatever it matches. Every pattern looks at each character a bounded
number of times: no record can hold up the process.
"""


def redacted(text: str) -> str:
    """``text`` without passwords, tokens and keys."""
    lower = text.lower()
    for hints, pattern, instead in _SECRETS:
        if any(hint in lower for hint in hints):
            text = pattern.sub(instead, text)
    return text


def shown(text: str) -> str:
    """What of a record's ``text`` is shown: no secrets, and ``LONGEST_RECORD`` characters at most."""
    margin = 1024  # characters beyond the cut that are searched as well, so that no secret is cut in half and missed
    safe = redacted(text[: LONGEST_RECORD + margin])
    beyond = len(safe) - LONGEST_RECORD + max(0, len(text) - LONGEST_RECORD - margin)
    return f"{safe[:LONGEST_RECORD]} ... {beyond} characters more" if beyond > 0 else safe


class LossyQueueHandler(logging.handlers.QueueHandler):
    """Counts what does not fit instead of waiting or complaining."""

    def __init__(self) -> None:
        self.records: queue.Queue[logging.LogRecord | None] = queue.Queue(LOG_QUEUE)
        super().__init__(self.records)
        self.lost = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Put the record into the queue, or lose it."""
        try:
            self.records.put_nowait(record)
        except queue.Full:
            self.lost += 1


class LogOutputThread:
    """The thread that writes; a stuck output never keeps the process from ending.

    Args:
        handler: where the records come from.
        output: where they go.
    """

    def __init__(self, handler: LossyQueueHandler, output: logging.Handler) -> None:
        self._handler = handler
        self._output = output
        self._reported = 0
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write what still waits, as far as the output takes it within 1 s."""
        output_timeout = 1.0  # seconds the end of the process waits for a stuck output
        try:
            self._handler.records.put(None, timeout=output_timeout)
        except queue.Full:
            return
        self._thread.join(output_timeout)

    def _run(self) -> None:
        while (record := self._handler.records.get()) is not None:
            self._output.handle(record)
            if (lost := self._handler.lost) > self._reported:
                text = f"{lost - self._reported} records lost: this output was stuck"
                self._reported = lost
                self._output.handle(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))


class PlainFormatter(logging.Formatter):
    """One line a record, without secrets, with journald's priority in front where the journal reads.

    Args:
        journal: whether that reads.
        terminal: whether somebody looks on: of a record with an attribute ``brief`` (a text; None = without) that is
            shown instead of its message.
    """

    def __init__(self, *, journal: bool, terminal: bool = False) -> None:
        super().__init__("%(levelname)-7s %(name)s: %(message)s")
        self._journal = journal
        self._terminal = terminal

    def format(self, record: logging.LogRecord) -> str:
        """The record's text; every line of a traceback keeps the priority."""
        brief = getattr(record, "brief", None) if self._terminal else None
        if brief is not None:
            record = copy(record)
            record.msg, record.args = brief, None
        text = shown(super().format(record))
        if not self._journal:
            return text
        head = f"<{PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(head + line for line in text.splitlines())


def read_by_journal(stream: TextIO, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether systemd's journal reads ``stream``: JOURNAL_STREAM names its device and inode (systemd.exec(5)).

    The variable alone is no proof: processes whose output goes elsewhere inherit it.
    """
    named = environment.get("JOURNAL_STREAM")
    if named is None:
        return False
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError, io.UnsupportedOperation):
        return False
    return named == f"{status.st_dev}:{status.st_ino}"


def start_logging(*, verbose: bool, stream: TextIO = sys.stderr) -> LogOutputThread:
    """Send all logging to ``stream`` from a thread; ``stop()`` of what is returned writes what still waits."""
    output = logging.StreamHandler(stream)
    output.setFormatter(PlainFormatter(journal=read_by_journal(stream), terminal=stream.isatty()))
    handler = LossyQueueHandler()
    root = logging.getLogger()
    root.setLevel(logging.DEBUG if verbose else logging.INFO)
    root.addHandler(handler)
    return LogOutputThread(handler, output)
