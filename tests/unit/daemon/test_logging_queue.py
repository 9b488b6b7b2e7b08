"""Logging never waits for whoever reads it."""

import io
import logging
import os
import threading
from pathlib import Path

import pytest

from monstertruckd.logging_queue import (
    DEPTH,
    LossyQueueHandler,
    PlainFormatter,
    read_by_journal,
    redacted,
    start_logging,
)


class StuckStream(io.StringIO):
    """A terminal nobody reads, until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.released = threading.Event()

    def write(self, text: str) -> int:
        self.released.wait()
        return super().write(text)


@pytest.fixture
def clean_root():
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    yield root
    for handler in root.handlers[:]:
        if handler not in before:
            root.removeHandler(handler)
    root.setLevel(level)


def test_a_stuck_reader_costs_records_not_time(clean_root: logging.Logger):
    stream = StuckStream()
    listener = start_logging(verbose=False, stream=stream)
    for number in range(DEPTH + 500):
        logging.getLogger("x").warning("%d", number)
    (handler,) = (h for h in clean_root.handlers if isinstance(h, LossyQueueHandler))
    assert handler.lost >= 490
    listener.stop()
    assert stream.getvalue() == "", "the end does not wait for it either"
    stream.released.set()
    listener.stop()
    assert "WARNING x: 0\n" in stream.getvalue()
    assert f": {DEPTH + 499}\n" not in stream.getvalue()
    assert f"{handler.lost} records lost: this output was stuck\n" in stream.getvalue()


def test_levels(clean_root: logging.Logger):
    stream = io.StringIO()
    listener = start_logging(verbose=False, stream=stream)
    logging.getLogger("x").debug("hidden")
    logging.getLogger("x").info("shown")
    listener.stop()
    assert stream.getvalue() == "INFO    x: shown\n"


def test_the_journal_gets_priorities_on_every_line():
    record = logging.LogRecord("x", logging.ERROR, "f", 1, "a\nb", None, None)
    assert PlainFormatter(journal=True).format(record) == "<3>ERROR   x: a\n<3>b"


def test_the_journal_is_recognised_by_the_stream_it_named(tmp_path: Path):
    with (tmp_path / "journal").open("w") as stream, (tmp_path / "elsewhere").open("w") as other:
        status = os.fstat(stream.fileno())
        environment = {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"}
        assert read_by_journal(stream, environment)
        assert not read_by_journal(other, environment), "redirected by somebody who inherited the variable"
        assert not read_by_journal(stream, {})
        assert not read_by_journal(io.StringIO(), environment)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("tls/user:hunter2@host:7447", "tls/user:hunter2@host:7447"),
        ("https://user:hunter2@host/x", "https://***@host/x"),
        ("password=hunter2, retry", "password=***, retry"),
        ('{"api_key": "hunter2", "user": "ann"}', '{"api_key": "***", "user": "ann"}'),
        ("link_token: hunter2", "link_token: ***"),
        ("the token ring is fine", "the token ring is fine"),
        ("-----BEGIN RSA PRIVATE KEY-----\nhunter2\n-----END RSA PRIVATE KEY----- ok", "<private key> ok"),
        ("-----BEGIN PRIVATE KEY-----\nhunter2", "<private key>"),
        ("lidar: key 3 of 4", "lidar: key 3 of 4"),
    ],
)
def test_secrets_are_not_shown(text: str, shown: str):
    assert redacted(text) == shown


def test_secrets_in_tracebacks_are_not_shown_either(clean_root: logging.Logger):
    stream = io.StringIO()
    listener = start_logging(verbose=False, stream=stream)
    try:
        raise ValueError("secret=hunter2")
    except ValueError:
        logging.getLogger("x").exception("failed with password: %s", "hunter2")
    listener.stop()
    assert "hunter2" not in stream.getvalue()
    assert "ValueError: secret=***" in stream.getvalue()
