"""Main program of the fork server, and of the workers that it forks.

``python -m monstertruck_runtime.actors.server FD`` forks a worker per request until its parent is gone, in the middle
of a build too. It has one thread, hence its forks are safe. It builds a worker of each kind once and discards it: forks
then share the imported modules and the compiled kernels. Builds and workers go behind the daemon's loop: both are
niced. Signals to the daemon's whole group are ignored: the parent decides when its workers end. Imports stay few, for
every worker shares them.
"""

import fcntl
import gc
import importlib
import json
import os
import queue
import resource
import select
import signal
import socket
import struct
import sys
import threading
import traceback
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, Self

NUMBER: Final = struct.Struct("@i")
"""A process number, then its exit code (negative: the signal), on a worker's socket of its end."""
_LONGEST: Final = 1 << 20
"""Maximum length of a request, environment included (bytes)."""


@dataclass(frozen=True)
class ForkRequest:
    """A worker to be forked.

    Its file descriptors travel beside it: the worker's connection, the socket of its end, the current folder.
    """

    name: str
    target: str
    """``module:factory``."""
    path: list[str]
    """``sys.path`` of the parent."""
    environment: dict[str, str]

    def encode(self) -> bytes:
        """Return the bytes of one packet."""
        return json.dumps(vars(self)).encode()

    @classmethod
    def decode(cls, packet: bytes) -> Self:
        """Inverse of ``encode``."""
        return cls(**json.loads(packet))


class _Server:
    """Forks workers and reports their ends."""

    def __init__(self, requests: socket.socket) -> None:
        self._requests = requests
        self._built: set[str] = set()
        self._ends: dict[int, int] = {}
        """File descriptor that takes a worker's exit code, by process number."""

    def run(self) -> None:
        """Serve until the parent is gone."""
        signal.signal(signal.SIGCHLD, self._reap)
        signal.signal(signal.SIGIO, self._end_with_parent)
        fcntl.fcntl(self._requests, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(self._requests, fcntl.F_SETFL, fcntl.fcntl(self._requests, fcntl.F_GETFL) | os.O_ASYNC)
        while True:
            packet, descriptors, _, _ = socket.recv_fds(self._requests, _LONGEST, 3)
            if not packet:
                return
            if not closed(descriptors[0]):
                request = ForkRequest.decode(packet)
                self._build(request)
                if not closed(descriptors[0]):
                    self._fork(request, *descriptors)
                    continue
            for descriptor in descriptors:
                os.close(descriptor)

    def _build(self, request: ForkRequest) -> None:
        """Load what all workers of a target share; the worker itself reports what fails here."""
        if request.target in self._built:
            return
        sys.path[:] = request.path
        with suppress(Exception, SystemExit):
            _made(request.target)
            self._built.add(request.target)
        gc.collect()
        gc.freeze()  # a collection in a fork would copy the shared pages

    def _fork(self, request: ForkRequest, connection: int, end: int, folder: int) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGCHLD,))
        process = os.fork()
        if process == 0:
            code = 1
            try:
                self._requests.close()
                for other in self._ends.values():
                    os.close(other)
                os.write(end, NUMBER.pack(os.getpid()))
                os.close(end)
                os.fchdir(folder)
                os.close(folder)
                _become(request)
                code = _work(Connection(connection), request.target)
            finally:
                os._exit(code)
        self._ends[process] = end
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGCHLD,))
        os.close(connection)
        os.close(folder)

    def _reap(self, *_: object) -> None:
        for process in tuple(self._ends):  # not any child: a build may wait for a program of its own
            try:
                ended, status = os.waitpid(process, os.WNOHANG)
            except ChildProcessError:  # the next signal came in this function, and has seen to it
                continue
            if not ended:
                continue
            end = self._ends.pop(process)
            with suppress(OSError):  # the parent may no longer care
                os.write(end, NUMBER.pack(os.waitstatus_to_exitcode(status)))
            os.close(end)

    def _end_with_parent(self, *_: object) -> None:
        """End at once when the parent is gone; the kernel sends SIGIO for a request, too."""
        if closed(self._requests.fileno()):
            os._exit(0)


def readable(connection: int) -> bool:
    """Whether something waits to be read, or the other side has closed a connection, given by its file descriptor."""
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(0))


def closed(connection: int) -> bool:
    """Whether the other side has closed a connection, given by its file descriptor."""
    poll = select.poll()
    poll.register(connection, select.POLLHUP)
    return bool(poll.poll(0))


def main() -> int:
    """Serve one parent; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(5)
    _Server(socket.socket(fileno=int(sys.argv[1]))).run()
    return 0


def _made(target: str) -> Any:
    module, _, factory = target.partition(":")
    return getattr(importlib.import_module(module), factory)()


def _become(request: ForkRequest) -> None:
    """Turn a fork of the server into what a fresh process of the parent would be."""
    for number in (signal.SIGCHLD, signal.SIGIO):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGCHLD,))
    with suppress(OSError):  # only ps and top show it
        Path("/proc/self/comm").write_text(request.name[:15], encoding="utf-8")  # 15: the kernel's limit
    os.environ.clear()
    os.environ.update(request.environment)
    sys.path[:] = request.path
    importlib.invalidate_caches()


def _work(connection: Connection, target: str) -> int:
    """Build the worker and answer steps until the parent is gone, however busy it is then; returns the exit code."""
    steps: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(connection, steps), daemon=True).start()
    try:
        worker = _made(target)
        connection.send((True, None, 0.0))
        while True:
            inputs = steps.get()
            begin = _processor_time()
            outputs = worker.step(inputs)
            connection.send((True, outputs, _processor_time() - begin))
    except (Exception, SystemExit):  # noqa: BLE001  # reported to the parent, which decides
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
