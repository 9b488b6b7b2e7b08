"""The command ``monstertruckd``, also as ``python -m monstertruckd``."""

import signal
import sys


def main() -> None:
    """Run the command line; ``run`` ends with 0 by SIGTERM from its first moment, while modules are still loaded."""
    if sys.argv[1:2] == ["run"]:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    from monstertruckd.tools.cli.main import main as command_line  # noqa: PLC0415 - takes half a second

    command_line()


if __name__ == "__main__":
    main()
