"""``python -m monstertruckd.recorder.repair FOLDER``: repair a folder's unfinished logs, niced.

The recorder starts this as a process of its own: a thread would compete with the control loop for the interpreter.
"""

import logging
import os
import subprocess
import sys
from pathlib import Path

from monstertruckd.recorder.framing import is_finished
from monstertruckd.recorder.recover import in_use, recover_directory

NICENESS = 15


def start_repair(folder: Path) -> "subprocess.Popen[bytes] | None":
    """Start the process if there is anything to repair.

    Raises:
        OSError: the folder cannot be read, or no process can be started.
    """
    if all(is_finished(path) or in_use(path) for path in folder.glob("*.mcap")):
        return None
    command = [sys.executable, "-m", "monstertruckd.recorder.repair", str(folder)]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL)  # noqa: S603  # our own module, no shell


def main(folder: Path) -> None:
    """Repair ``folder``."""
    os.nice(NICENESS)
    logging.basicConfig(level=logging.INFO, format="%(levelname)-7s %(name)s: %(message)s")
    recover_directory(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
