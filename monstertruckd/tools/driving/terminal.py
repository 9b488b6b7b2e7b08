"""A terminal that hands over every key at once, and is itself again afterwards, whatever happens."""

import os
import termios
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import IO, Any, Final

REPORT_ON: Final = b"\x1b[?1004h\x1b[?2004h"
"""Report focus, mark what is pasted (xterm; terminals that cannot do it ignore it)."""
REPORT_OFF: Final = b"\x1b[?1004l\x1b[?2004l"

_LOCAL, _INPUT, _CHARACTERS = 3, 0, 6


@contextmanager
def every_key(keyboard: IO[Any], screen: IO[Any]) -> Iterator[None]:
    """Keys come one by one and unechoed; Ctrl-C still interrupts, Ctrl-Z and Ctrl-S neither suspend nor freeze.

    Args:
        keyboard: terminal to read from.
        screen: terminal to write to.
    """
    before = termios.tcgetattr(keyboard)
    changed = termios.tcgetattr(keyboard)
    changed[_LOCAL] &= ~(termios.ICANON | termios.ECHO)
    changed[_INPUT] &= ~termios.IXON
    changed[_CHARACTERS][termios.VSUSP] = b"\x00"
    termios.tcsetattr(keyboard, termios.TCSADRAIN, changed)
    try:
        os.write(screen.fileno(), REPORT_ON)
        yield
    finally:
        _restore(keyboard, screen, before)


def _restore(keyboard: IO[Any], screen: IO[Any], before: list[Any]) -> None:
    with suppress(OSError):  # a terminal that is gone took its settings along
        os.write(screen.fileno(), REPORT_OFF)
    with suppress(termios.error):
        # Keys that were held are not for the shell.
        termios.tcsetattr(keyboard, termios.TCSAFLUSH, before)


def forget_input(keyboard: IO[Any]) -> None:
    """Throw away what was typed but not read yet."""
    with suppress(termios.error):
        termios.tcflush(keyboard, termios.TCIFLUSH)
