"""A terminal is itself again after driving."""

import fcntl
import os
import pty
import sys
import termios
from collections.abc import Iterator
from typing import IO

import pytest

from monstertruckd.cli.terminal import REPORT_OFF, REPORT_ON, every_key, forget_input


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
