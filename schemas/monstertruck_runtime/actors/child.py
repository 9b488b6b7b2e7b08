"""Main program of a worker process: ``python -m monstertruck_runtime.actors.child FD MODULE:FACTORY``.

Builds the worker and answers steps until the parent is gone, however busy it is then. Signals meant for the
daemon's whole group are ignored: the parent decides when its workers end.
"""

import importlib
import os
import queue
import signal
import socket
import sys
import threading
import traceback
from typing import Any

from monstertruck_runtime.actors.channel import receive, send

NICE = 5


def main() -> int:
    """Serve one parent; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(NICE)
    end = socket.socket(fileno=int(sys.argv[1]))
    steps: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(end, steps), daemon=True).start()
    try:
        module, _, factory = sys.argv[2].partition(":")
        worker = getattr(importlib.import_module(module), factory)()
        send(end, (True, None))
        while True:
            send(end, (True, worker.step(steps.get())))
    except Exception:  # noqa: BLE001  # reported to the parent, which decides
        send(end, (False, traceback.format_exc()))
        return 1


def _read(end: socket.socket, steps: "queue.SimpleQueue[Any]") -> None:
    try:
        while True:
            steps.put(receive(end))
    except (EOFError, OSError):
        os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
