"""A worker process, and the fork server that starts it, from the parent's side; ``server`` is the other."""

import atexit
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

from monstertruck_runtime.actors import server
from monstertruck_runtime.errors import WorkerError

_TIMEVAL = struct.Struct("@ll")
"""Seconds and microseconds, see socket(7)."""
_SINGLE_THREADED = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA", "VECLIB")
}
_END_TIMEOUT: Final = 5.0
"""Time a killed process may take to end and its server to report that (s); a server that takes longer hangs."""


class ForkServer:
    """The process that forks the workers of this one; started by the first request (``server``).

    It is a fresh interpreter, never a fork of this process: forked Zenoh sessions hang. It ends with this process.
    """

    def __init__(self) -> None:
        self._sending = threading.Lock()
        """Held while a request is sent, or ``_waiting`` is used."""
        self._waiting: list[socket.socket] = []
        """Forks that ``forget`` has not removed, in the order of the requests."""
        self._requests, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and module
                [sys.executable, "-m", server.__name__, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=2,
                env={**os.environ, **_SINGLE_THREADED},
            )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    @property
    def lost(self) -> bool:
        """Whether it has ended."""
        return self._process.poll() is not None

    def fork(self, name: str, target: str, connection: socket.socket) -> socket.socket:
        """Request a worker; returns the socket that receives its process number, then its exit code.

        Args:
            name: shown by ``ps`` and ``top``.
            target: ``module:factory``.
            connection: the worker's end of its connection.

        Raises:
            WorkerError: the server is gone, or does not read its requests.
        """
        environment = {**os.environ, **_SINGLE_THREADED}
        packet = server.ForkRequest(name, target, sys.path, environment).encode()
        folder = os.open(".", os.O_PATH)
        ours, theirs = socket.socketpair()
        try:
            with theirs, self._sending:
                descriptors = [connection.fileno(), theirs.fileno(), folder]
                socket.send_fds(self._requests, [packet], descriptors, socket.MSG_DONTWAIT)
                self._waiting.append(ours)
        except OSError as error:
            ours.close()
            self.kill()
            raise WorkerError(f"worker {name}: the fork server (process {self.pid}) is gone or hangs") from error
        finally:
            os.close(folder)
        return ours

    def unanswered(self) -> socket.socket | None:
        """The request that the server works on: the socket of the oldest one without an answer; None if it idles."""
        with self._sending:
            return next((end for end in self._waiting if not server.readable(end.fileno())), None)

    def forget(self, end: socket.socket) -> None:
        """Note that a request, given by its socket, is answered or given up; call it before the socket is closed."""
        with self._sending, suppress(ValueError):
            self._waiting.remove(end)

    def kill(self) -> None:
        """Kill the server, and leave no zombie; its workers run on."""
        self._process.kill()
        self._process.wait()
        self._requests.close()


class _Current:
    """The fork server that is in use, replaced when it has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._server: ForkServer | None = None

    def server(self) -> ForkServer:
        """Return a server, a new one if the last has ended."""
        with self._lock:
            if self._server is not None and self._server.lost:
                self.kill()
            if self._server is None:
                self._server = ForkServer()
            return self._server

    def kill(self) -> None:
        """Kill the server at the end of this process; it would end by itself, but only after its imports."""
        if self._server is not None:
            self._server.kill()
            self._server = None


_current = _Current()
atexit.register(_current.kill)


class WorkerProcess:
    """A process that takes steps, forked by the process's ``ForkServer``.

    Args:
        name: for error texts.
        target: ``module:factory``; the factory's object has ``step(inputs) -> outputs``.
        stall_timeout: maximum pause in the middle of a message, either way, s.
    """

    def __init__(self, name: str, target: str, stall_timeout: float = 30.0) -> None:
        self._name = name
        self._killed = False
        self._pid: int | None = None
        self._code: int | None = None
        self._reading = threading.Lock()
        """Held while a thread reads ``_end``."""
        self.used = 0.0
        """Processor time of the latest step (s)."""
        ours, theirs = socket.socketpair()
        limit = _TIMEVAL.pack(*divmod(round(stall_timeout * 1e6), 10**6))
        for direction in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, direction, limit)
        self._connection = Connection(ours.detach())
        with theirs:
            self._server = _current.server()
            self._end = self._server.fork(name, target, theirs)

    @property
    def pid(self) -> int | None:
        """Process number; None until the server has forked it."""
        if self._pid is None and not self._killed and self._reading.acquire(blocking=False):
            try:
                self._pid = self._reported(0.0)
            finally:
                self._reading.release()
        return self._pid

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
        """Kill the process, and an idle server that does not confirm its end; neither leaves a zombie.

        A server that builds may be in one call of a library for longer than that.

        The connection ends with its last user: a thread may still wait for it.
        """
        if self._killed:
            return
        self._killed = True
        with socket.socket(fileno=os.dup(self._connection.fileno())) as connection:
            closed = server.closed(connection.fileno())
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)  # the server does not fork for a closed connection
        with self._reading:
            self._pid = self._pid or self._reported(0.0)
            if self._pid is not None and self._code is None:
                self._code = self._reported(0.0)
            # Another process may have the number of one that has ended.
            ended = self._code is not None or (closed and self._server.lost)
            if self._pid is not None and not ended:
                with suppress(ProcessLookupError):
                    os.kill(self._pid, signal.SIGKILL)
                self._code = self._reported(_END_TIMEOUT)
                if self._code is None and self._server.unanswered() is None:
                    self._server.kill()
            self._server.forget(self._end)
            self._end.close()

    def kill_hung_server(self) -> None:
        """Kill the server if it still works on this process; for a start that took too long.

        While it builds another kind it does not hang: that one has a time limit of its own.
        """
        if self._server.unanswered() is self._end:
            self._server.kill()

    def _reported(self, timeout: float) -> int | None:
        """Read the next number on ``_end``; None if none came for ``timeout`` seconds, or the server is gone."""
        try:
            self._end.settimeout(timeout)
            data = self._end.recv(server.NUMBER.size)
        except OSError:
            return None
        self._server.forget(self._end)
        return server.NUMBER.unpack(data)[0] if data else None

    def _gone(self) -> str:
        """That the process is gone, and how it ended."""
        with self._reading:
            self._pid = self._pid or self._reported(0.0)
            text = f"worker {self._name} (process {self._pid or 'never forked'}) is gone"
            if self._killed:
                return text
            # 1.0: time a process may take to end after it has closed its connection (s)
            self._code = self._reported(1.0) if self._code is None else self._code
        code = self._code
        if code is None:
            return f"{text}: it closed its connection"
        if code >= 0:
            return f"{text}: it ended with exit code {code}"
        short = ", as by a system that is short of memory" if -code == signal.SIGKILL else ""
        return f"{text}: killed by {signal.Signals(-code).name}{short}"
