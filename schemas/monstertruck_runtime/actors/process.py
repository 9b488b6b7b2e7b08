"""Parent's side of a worker process and of the fork server that starts it; ``server`` is the other side."""

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
"""Seconds and microseconds of a socket timeout, see socket(7)."""
_SINGLE_THREADED = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "NUMBA", "VECLIB")
}
_END_TIMEOUT: Final = 5.0
"""Maximum time for a killed process to end and for its server to report that (s); a slower server is considered
hung.
"""


class ForkServer:
    """Process that forks the workers of this process; the first request starts it (``server``).

    It is a fresh interpreter, never a fork of this process, because forked Zenoh sessions hang. It ends with this
    process.
    """

    def __init__(self) -> None:
        self._sending = threading.Lock()
        """Held while sending a request or using ``_waiting``."""
        self._waiting: list[socket.socket] = []
        """Pending forks, in the order of their requests; removed by ``forget``."""
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
        """Process id."""
        return self._process.pid

    @property
    def lost(self) -> bool:
        """Whether the server has ended."""
        return self._process.poll() is not None

    def fork(self, name: str, target: str, connection: socket.socket) -> socket.socket:
        """Request a worker; return the socket that receives its process id, then its exit code.

        Args:
            name: name shown by ``ps`` and ``top``.
            target: ``module:factory``.
            connection: the worker's end of its connection.

        Raises:
            WorkerError: the server has ended, or does not read its requests.
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
        """Socket of the request in progress, the oldest one without an answer; None if the server is idle."""
        with self._sending:
            return next((end for end in self._waiting if not server.readable(end.fileno())), None)

    def forget(self, end: socket.socket) -> None:
        """Remove an answered or abandoned request, given by its socket; must be called before the socket is closed."""
        with self._sending, suppress(ValueError):
            self._waiting.remove(end)

    def kill(self) -> None:
        """Kill the server and collect its exit status; its workers continue."""
        self._process.kill()
        self._process.wait()
        self._requests.close()


class _Current:
    """The current fork server; replaced after it has ended."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._server: ForkServer | None = None

    def server(self) -> ForkServer:
        """Return the server; start a new one if the last one has ended."""
        with self._lock:
            if self._server is not None and self._server.lost:
                self.kill()
            if self._server is None:
                self._server = ForkServer()
            return self._server

    def kill(self) -> None:
        """Kill the server at the end of this process; it would end by itself only after its imports."""
        if self._server is not None:
            self._server.kill()
            self._server = None


_current = _Current()
atexit.register(_current.kill)


class WorkerProcess:
    """A process that executes steps, forked by the ``ForkServer`` of this process.

    Args:
        name: for error texts.
        target: ``module:factory``; the factory's object has ``step(inputs) -> outputs``.
        stall_timeout: maximum pause within a message, in either direction, s.
    """

    def __init__(self, name: str, target: str, stall_timeout: float = 30.0) -> None:
        self._name = name
        self._killed = False
        self._pid: int | None = None
        self._code: int | None = None
        self._reading = threading.Lock()
        """Held while a thread reads ``_end``."""
        self.used = 0.0
        """Processor time of the last step (s)."""
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
        """Process id; None until the server has forked it."""
        if self._pid is None and not self._killed and self._reading.acquire(blocking=False):
            try:
                self._pid = self._reported(0.0)
            finally:
                self._reading.release()
        return self._pid

    def send(self, inputs: Any) -> None:
        """Submit a step.

        Raises:
            WorkerError: the process has ended or is stopped.
        """
        try:
            self._connection.send(inputs)
        except OSError as error:
            raise WorkerError(self._gone()) from error

    def receive(self, timeout: float | None = None) -> Any:
        """Wait for the outputs of a step, or for the message that the worker is built; sets ``used``.

        Raises:
            WorkerError: the process ended, or its code raised an exception; the text contains the traceback.
            TimeoutError: no data for ``timeout`` seconds, or the process stopped in the middle of its answer.
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
        """Call ``send``, then ``receive``, without timeouts; ends when the process is killed."""
        self.send(inputs)
        return self.receive()

    def kill(self) -> None:
        """Kill the process, and an idle server that does not confirm its end; collect both exit statuses.

        A server may spend longer than that in one library call while it builds.

        The last user closes the connection: a thread may still wait for it.
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
            # The process id of an ended process may be reused.
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
        """Kill the server if it is still starting this process; for a start that took too long.

        A server that builds another kind is not hung: that build has its own timeout.
        """
        if self._server.unanswered() is self._end:
            self._server.kill()

    def _reported(self, timeout: float) -> int | None:
        """Return the next number on ``_end``.

        None if none was received for ``timeout`` seconds, or the server has ended.
        """
        try:
            self._end.settimeout(timeout)
            data = self._end.recv(server.NUMBER.size)
        except OSError:
            return None
        self._server.forget(self._end)
        return server.NUMBER.unpack(data)[0] if data else None

    def _gone(self) -> str:
        """Return an error text that states how the process ended."""
        with self._reading:
            self._pid = self._pid or self._reported(0.0)
            text = f"worker {self._name} (process {self._pid or 'never forked'}) is gone"
            if self._killed:
                return text
            # 1.0: time for a process to end after it has closed its connection (s)
            self._code = self._reported(1.0) if self._code is None else self._code
        code = self._code
        if code is None:
            return f"{text}: it closed its connection"
        if code >= 0:
            return f"{text}: it ended with exit code {code}"
        short = ", as by the out-of-memory killer" if -code == signal.SIGKILL else ""
        return f"{text}: killed by {signal.Signals(-code).name}{short}"
