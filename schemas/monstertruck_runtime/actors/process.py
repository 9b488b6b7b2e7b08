"""The parent's blocking hold on one worker process."""

import os
import socket
import subprocess
import sys
from typing import Any

from monstertruck_runtime.actors import channel
from monstertruck_runtime.errors import WorkerError

_SINGLE_THREADED = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA", "VECLIB")
}


class WorkerProcess:
    """A fresh interpreter, never a fork: forked Zenoh sessions hang.

    Args:
        name: for error texts.
        target: ``module:factory``; what the factory returns has ``step(inputs) -> outputs``.
    """

    def __init__(self, name: str, target: str) -> None:
        self._name = name
        self._end, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and module
                [sys.executable, "-m", "monstertruck_runtime.actors.child", str(theirs.fileno()), target],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,
                env={**os.environ, **_SINGLE_THREADED},
            )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def send(self, inputs: Any, timeout: float | None = None) -> None:
        """Submit a step.

        Raises:
            WorkerError: the process is gone.
            TimeoutError: it took nothing for ``timeout`` seconds.
        """
        self._end.settimeout(timeout)
        try:
            channel.send(self._end, inputs)
        except TimeoutError:
            raise
        except OSError as error:
            raise WorkerError(self._gone()) from error

    def receive(self, timeout: float | None = None) -> Any:
        """Wait for the outputs of a step, or for the news that the worker is built.

        Raises:
            WorkerError: the process is gone or its code raised; the text holds its traceback.
            TimeoutError: nothing came for ``timeout`` seconds.
        """
        self._end.settimeout(timeout)
        try:
            success, value = channel.receive(self._end)
        except TimeoutError:
            raise
        except (EOFError, OSError) as error:
            raise WorkerError(self._gone()) from error
        if not success:
            msg = f"worker {self._name} raised\n{value}"
            raise WorkerError(msg)
        return value

    def exchange(self, inputs: Any) -> Any:
        """``send``, then ``receive``, without time-outs; ends when the process is killed."""
        self.send(inputs)
        return self.receive()

    def kill(self) -> None:
        """End the process at once, whatever it does, and leave no zombie."""
        self._process.kill()
        self._process.wait()
        self._end.close()

    def _gone(self) -> str:
        return f"worker {self._name} (process {self._process.pid}) is gone"
