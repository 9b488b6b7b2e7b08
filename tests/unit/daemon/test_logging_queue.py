"""Logging never waits for whoever reads it."""

import io
import logging
import threading

import pytest

from monstertruckd.logging_queue import DEPTH, LossyQueueHandler, PlainFormatter, start_logging


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
