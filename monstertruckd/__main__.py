"""The command ``monstertruckd``, also as ``python -m monstertruckd``."""

import os
import signal
import sys
from contextlib import AbstractContextManager, nullcontext


def main() -> None:
    """Run the command line; ``run`` ends with 0 by SIGTERM or Ctrl-C from its first moment, while modules are loaded.

    At once, and not by an exception: one that is raised in a callback of an import, or by one more import, is lost.
    """
    if sys.argv[1:2] == ["run"]:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: os._exit(0))
    _occupy_standard_streams()
    with _early(sys.argv[1:]):
        from monstertruckd.tools.cli.entry import main as command_line  # noqa: PLC0415 - takes its time

        command_line()


def _occupy_standard_streams() -> None:
    """Open the null device in place of closed standard streams.

    Otherwise the next file or socket gets the number of a stream: messages would be written to it, and libuv aborts.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number


def _early(arguments: list[str]) -> AbstractContextManager[None]:
    """What must not wait until the command line is loaded."""
    if arguments[:1] != ["estop"]:
        return nullcontext()
    from monstertruckd.early_estop import early_estop  # noqa: PLC0415 - of this command only

    return early_estop(arguments[1:])


if __name__ == "__main__":
    main()
