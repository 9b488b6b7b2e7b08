"""A worker process: the parent's blocking connection to it, and its main program.

``python -m monstertruck_runtime.actors.process FD MODULE:FACTORY`` builds the worker and answers steps until the parent
is gone, however busy it is then. Signals meant for the daemon's whole group are ignored: the parent decides when its
workers end. Imports stay few, for every worker pays for them.
"""

import importlib
import os
import queue
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any

from monstertruck_runtime.errors import WorkerError

_TIMEVAL = struct.Struct("@ll")
"""Seconds and microseconds, see socket(7)."""
_SINGLE_THREADED = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA", "VECLIB")
}


class WorkerProcess:
    """A fresh interpreter, never a fork: forked Zenoh sessions hang.

    Args:
        name: for error texts.
        target: ``module:factory``; the factory's object has ``step(inputs) -> outputs``.
        stall_timeout: maximum pause in the middle of a message, either way, s.
    """

    def __init__(self, name: str, target: str, stall_timeout: float = 30.0) -> None:
        self._name = name
        self._killed = False
        self.used = 0.0
        """Processor time of the latest step (s)."""
        ours, theirs = socket.socketpair()
        limit = _TIMEVAL.pack(*divmod(round(stall_timeout * 1e6), 10**6))
        for direction in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, direction, limit)
        self._connection = Connection(ours.detach())
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and module
                [sys.executable, "-m", __name__, str(theirs.fileno()), target],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,
                env={**os.environ, **_SINGLE_THREADED},
            )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def send(self, inputs: Any) -> None:
        """Submit a step.

        Raises:
            WorkerError: the process is gone, or stopped.
        """
        try:
            self._connection.send(inputs)
        except OSError as error:
            raise WorkerError(self._gone()) from error

    def receive(self, timeout: float | None = None) -> Any:
        """Wait for the outputs of a step, or for the message that the worker is built; sets ``used``.

        Raises:
            WorkerError: the process is gone, or its code raised; the text begins with why, and holds the traceback.
            TimeoutError: nothing came for ``timeout`` seconds, or the process stopped in the middle of its answer.
        """
        try:
            if not self._connection.poll(timeout):
                raise TimeoutError
            success, value, self.used = self._connection.recv()
        except TimeoutError:
            raise
        except BlockingIOError:  # SO_RCVTIMEO has passed
            raise TimeoutError from None
        except (EOFError, OSError) as error:
            raise WorkerError(self._gone()) from error
        if not success:
            why = next((line for line in reversed(value.splitlines()) if line.strip()), "")
            raise WorkerError(f"worker {self._name} raised {why}\n{value}")
        return value

    def exchange(self, inputs: Any) -> Any:
        """``send``, then ``receive``, without time-outs; ends when the process is killed."""
        self.send(inputs)
        return self.receive()

    def kill(self) -> None:
        """Kill the process, and leave no zombie.

        The connection ends with its last user: a thread may still wait for it.
        """
        self._killed = True
        self._process.kill()
        self._process.wait()

    def _gone(self) -> str:
        """That the process is gone, and how it ended."""
        text = f"worker {self._name} (process {self._process.pid}) is gone"
        if self._killed:
            return text
        try:
            code = self._process.wait(1.0)  # seconds that a process may take to end after it has closed its connection
        except subprocess.TimeoutExpired:
            return f"{text}: it closed its connection"
        if code >= 0:
            return f"{text}: it ended with exit code {code}"
        short = ", as by a system that is short of memory" if -code == signal.SIGKILL else ""
        return f"{text}: killed by {signal.Signals(-code).name}{short}"


def main() -> int:
    """Serve one parent; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(5)
    connection = Connection(int(sys.argv[1]))
    steps: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, steps), daemon=True).start()
    try:
        module, _, factory = sys.argv[2].partition(":")
        worker = getattr(importlib.import_module(module), factory)()
        connection.send((True, None, 0.0))
        while True:
            inputs = steps.get()
            begin = _processor_time()
            outputs = worker.step(inputs)
            connection.send((True, outputs, _processor_time() - begin))
    except Exception:  # noqa: BLE001  # reported to the parent, which decides
        connection.send((False, traceback.format_exc(), 0.0))
        return 1


def _processor_time() -> float:
    """Processor time of this thread (s); the clock's module would cost every worker the import of asyncio."""
    usage = resource.getrusage(resource.RUSAGE_THREAD)
    return usage.ru_utime + usage.ru_stime


def _read(connection: Connection, steps: "queue.SimpleQueue[Any]") -> None:
    try:
        while True:
            steps.put(connection.recv())
    except (EOFError, OSError):
        os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
