"""Logging that never blocks the control loop: a bounded queue passes records to a thread that writes them."""

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

PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
"""Syslog levels, which journald reads from the start of a line."""

LONGEST_RECORD: Final = 16_384
"""Maximum length of a record (characters); longer ones are truncated."""

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
"""Patterns of secrets that no log may show: private keys, credentials in addresses, values named like a secret.

Each has hint words; every match contains at least one of them in lower case. Every pattern reads each character a
bounded number of times, so no record can block the process.
"""


def redacted(text: str) -> str:
    """Return ``text`` without passwords, tokens and keys."""
    lower = text.lower()
    for hints, pattern, instead in _SECRETS:
        if any(hint in lower for hint in hints):
            text = pattern.sub(instead, text)
    return text


def shown(text: str) -> str:
    """Return ``text`` of a record without secrets, truncated to ``LONGEST_RECORD`` characters."""
    margin = 1024  # characters beyond the limit that are also searched, so that no secret is cut in half and missed
    safe = redacted(text[: LONGEST_RECORD + margin])
    beyond = len(safe) - LONGEST_RECORD + max(0, len(text) - LONGEST_RECORD - margin)
    return f"{safe[:LONGEST_RECORD]} ... {beyond} characters more" if beyond > 0 else safe


class LossyQueueHandler(logging.handlers.QueueHandler):
    """Queue handler; counts records that do not fit instead of waiting or raising."""

    def __init__(self) -> None:
        # Maximum number of records waiting for a stuck terminal or journal; further ones are lost and counted.
        self.records: queue.Queue[logging.LogRecord | None] = queue.Queue(1000)
        super().__init__(self.records)
        self.lost = 0

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue the record, or count it as lost."""
        try:
            self.records.put_nowait(record)
        except queue.Full:
            self.lost += 1


class LogOutputThread:
    """Thread that writes log records; a stuck output never keeps the process from exiting.

    Args:
        handler: source of the records.
        output: handler that writes them.
    """

    def __init__(self, handler: LossyQueueHandler, output: logging.Handler) -> None:
        self._handler = handler
        self._output = output
        self._reported = 0
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Write the remaining records, as far as the output accepts them within 1 s."""
        output_timeout = 1.0  # seconds the exiting process waits for a stuck output
        try:
            self._handler.records.put(None, timeout=output_timeout)
        except queue.Full:
            return
        self._thread.join(output_timeout)

    def _run(self) -> None:
        while (record := self._handler.records.get()) is not None:
            self._output.handle(record)
            if (lost := self._handler.lost) > self._reported:
                text = f"{lost - self._reported} records lost: this output was blocked"
                self._reported = lost
                self._output.handle(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))


class PlainFormatter(logging.Formatter):
    """Formats a record as one line without secrets, with a journald priority prefix if the journal reads it.

    Args:
        journal: whether the journal reads the output.
        terminal: whether the output is a terminal: then the attribute ``brief`` of a record (a text, or None) replaces
            its message.
    """

    def __init__(self, *, journal: bool, terminal: bool = False) -> None:
        super().__init__("%(levelname)-7s %(name)s: %(message)s")
        self._journal = journal
        self._terminal = terminal

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record; every line of a traceback gets the priority."""
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
    """Whether systemd's journal reads ``stream``: JOURNAL_STREAM holds its device and inode (systemd.exec(5)).

    The variable alone is not proof: processes with redirected output inherit it.
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
    """Send all logging to ``stream`` from a thread; ``stop()`` of the result writes the remaining records."""
    output = logging.StreamHandler(stream)
    output.setFormatter(PlainFormatter(journal=read_by_journal(stream), terminal=stream.isatty()))
    handler = LossyQueueHandler()
    root = logging.getLogger()
    root.setLevel(logging.DEBUG if verbose else logging.INFO)
    root.addHandler(handler)
    return LogOutputThread(handler, output)
