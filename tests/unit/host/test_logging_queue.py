"""Logging never waits for whoever reads it."""

import io
import logging
import os
import threading
import time
from pathlib import Path

import pytest

from monstertruckd.host import logging_queue
from monstertruckd.host.logging_queue import (
    LONGEST_RECORD,
    LossyQueueHandler,
    PlainFormatter,
    read_by_journal,
    redacted,
    shown,
    start_logging,
)

LOG_QUEUE = 1000


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
    for number in range(LOG_QUEUE + 500):
        logging.getLogger("x").warning("%d", number)
    (handler,) = (h for h in clean_root.handlers if isinstance(h, LossyQueueHandler))
    assert handler.lost >= 490
    listener.stop()
    assert stream.getvalue() == "", "the end does not wait for it either"
    stream.released.set()
    listener.stop()
    assert "WARNING x: 0\n" in stream.getvalue()
    assert f": {LOG_QUEUE + 499}\n" not in stream.getvalue()
    assert f"{handler.lost} records lost: this output was blocked\n" in stream.getvalue()


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


def test_a_terminal_gets_the_brief_form_of_a_long_record():
    record = logging.makeLogRecord({"levelname": "ERROR", "name": "x", "msg": "%s\n%s", "args": ("late", "stacks")})
    assert PlainFormatter(journal=False, terminal=True).format(record) == "ERROR   x: late\nstacks"
    record.brief = "late; stacks are in a file"
    assert PlainFormatter(journal=False, terminal=True).format(record) == "ERROR   x: late; stacks are in a file"
    assert PlainFormatter(journal=False).format(record) == "ERROR   x: late\nstacks", "a file gets all of it"


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
        ("tcp/user:hunter2@host:7447", "tcp/***@host:7447"),
        ("tcp/[::1]:7447 and tls/host:7447", "tcp/[::1]:7447 and tls/host:7447"),
        ("http://user:pass@er2/x", "http://***@er2/x"),
        ("http://user:pass@er2@host/x", "http://***@host/x"),
        ("http://hunter2@host/x", "http://***@host/x"),
        ("Authorization: Bearer hunter2", "Authorization: Bearer ***"),
        ("{'Authorization': 'Basic hunter2'}", "{'Authorization': '***'}"),
        ("authorization failed for ann", "authorization failed for ann"),
        ("passphrase: hunter2", "passphrase: ***"),
        ("psk=hunter2", "psk=***"),
        ("dhcp --password hunter2 -v", "dhcp --password *** -v"),
        ("--wifi-psk 'hunter 2' -v", "--wifi-psk '***' -v"),
        ("--token-file x", "--token-file x"),
        ('password = "two words" x', 'password = "***" x'),
        (r'"{\"token\": \"hunter2\"}"', r'"{\"token\": \"***"}"'),
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


REPEATED = ("a-", "--", "--a", "/", "/a:", "/a:@", "://", "password", "password='", "api_", "-----BEGIN ", "\\")


@pytest.mark.parametrize("text", REPEATED)
def test_no_text_takes_more_than_time_in_proportion_to_its_length(text: str):
    def seconds(length: int) -> float:
        spent = []
        for _ in range(3):
            begin = time.thread_time()
            redacted((text * length)[:length])
            spent.append(time.thread_time() - begin)
        return min(spent)

    assert seconds(64_000) < 16 * seconds(16_000) + 0.05, "quadratic: seconds already at 8000"


def test_what_is_long_is_cut_before_it_is_searched(monkeypatch: pytest.MonkeyPatch):
    searched = []
    monkeypatch.setattr(logging_queue, "redacted", lambda text: searched.append(len(text)) or text)
    text = shown("x" * 10_000_000)
    assert searched[0] < 2 * LONGEST_RECORD
    assert text == f"{'x' * LONGEST_RECORD} ... {10_000_000 - LONGEST_RECORD} characters more"
    record = logging.LogRecord("x", logging.ERROR, "f", 1, "x" * 10_000_000, None, None)
    assert len(PlainFormatter(journal=False).format(record)) < 2 * LONGEST_RECORD


def test_a_cut_leaves_no_half_of_a_secret():
    text = "x" * (LONGEST_RECORD - 20) + " http://user:hunter2hunter2hunter2@host"
    assert "hunter" not in shown(text)


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
