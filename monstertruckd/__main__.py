"""The command ``monstertruckd``, also as ``python -m monstertruckd``."""

import os
import signal
import sys


def main() -> None:
    """Run the command line; ``run`` ends with 0 by SIGTERM or Ctrl-C from its first moment, while modules are loaded.

    At once, and not by an exception: one that is raised in a callback of an import, or by one more import, is lost.
    """
    if sys.argv[1:2] == ["run"]:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: os._exit(0))
    from monstertruckd.tools.cli.main import main as command_line  # noqa: PLC0415 - takes half a second

    command_line()


if __name__ == "__main__":
    main()
