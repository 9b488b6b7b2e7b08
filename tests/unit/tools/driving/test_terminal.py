"""A terminal is itself again after driving."""

import asyncio
import fcntl
import os
import pty
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from monstertruck_runtime.readable import when_readable
from monstertruckd.tools.driving.session import REPORT_OFF, REPORT_ON, every_key, forget_input


@pytest.fixture
def terminal() -> Iterator[tuple[int, IO[bytes]]]:
    user, program = pty.openpty()
    with os.fdopen(program, "r+b", buffering=0) as stream:
        yield user, stream
    os.close(user)


def waiting(stream: IO[bytes]) -> int:
    """Bytes that could be read now."""
    return int.from_bytes(fcntl.ioctl(stream, termios.FIONREAD, bytes(4)), sys.byteorder)


def test_keys_come_at_once_and_the_terminal_is_restored_after_a_bug(terminal: tuple[int, IO[bytes]]):
    user, stream = terminal
    before = termios.tcgetattr(stream)

    def drive() -> None:
        with every_key(stream, stream):
            os.write(user, b"w\x1a\x13")
            assert os.read(stream.fileno(), 10) == b"w\x1a\x13", "no line is waited for, Ctrl-Z and Ctrl-S are keys"
            assert os.read(user, 100) == REPORT_ON, "nothing is echoed"
            os.write(user, b"wwww")
            while waiting(stream) < 4:
                pass  # the kernel hands them over in its own time
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        drive()
    assert termios.tcgetattr(stream) == before
    assert os.read(user, 100) == REPORT_OFF
    os.set_blocking(stream.fileno(), False)
    assert stream.read(10) is None, "held keys are not left for the shell"


def test_a_terminal_that_vanishes_is_no_failure():
    user, program = pty.openpty()
    with os.fdopen(program, "r+b", buffering=0) as stream:
        with every_key(stream, stream):
            os.close(user)
        forget_input(stream)


async def test_a_watched_terminal_keeps_its_mode_which_the_screen_shares(terminal: tuple[int, IO[bytes]]):
    user, stream = terminal
    news = asyncio.Event()
    when_readable(stream.fileno(), news.set)
    assert os.get_blocking(stream.fileno())
    os.write(user, b"w\n")
    await asyncio.wait_for(news.wait(), 5)
    asyncio.get_running_loop().remove_reader(stream.fileno())
    assert os.get_blocking(stream.fileno())


async def test_a_file_is_not_watched_and_keeps_its_mode():
    with Path(os.devnull).open("rb") as nothing:
        with pytest.raises(PermissionError):
            when_readable(nothing.fileno(), lambda: None)
        assert os.get_blocking(nothing.fileno())
