"""Main program of the fork server, and of the workers that it forks.

``python -m monstertruck_runtime.actors.server FD`` forks a worker per request until its parent ends, even during a
build. It has one thread, so its forks are safe. It builds a worker of each kind once and discards it, so that forks
share the imported modules and the compiled kernels. Builds and workers are niced, so that the daemon's loop has
priority. Signals to the daemon's process group are ignored: the parent decides when its workers end. This module
imports little, because every worker shares the imports.
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
"""Number sent on the socket of a worker's end: its process id, then its exit code (negative: the signal)."""
_LONGEST: Final = 1 << 20
"""Maximum size of a request, including the environment (bytes)."""


@dataclass(frozen=True)
class ForkRequest:
    """Request to fork a worker.

    It is sent together with file descriptors: the worker's connection, the socket of its end, the current folder.
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
        """File descriptor for a worker's exit code, by process id."""

    def run(self) -> None:
        """Serve until the parent ends."""
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
        """Load everything that the workers of a target share; the worker itself reports failures."""
        if request.target in self._built:
            return
        sys.path[:] = request.path
        with suppress(Exception, SystemExit):
            _made(request.target)
            self._built.add(request.target)
        gc.collect()
        gc.freeze()  # a garbage collection in a fork would copy the shared pages

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
        for process in tuple(self._ends):  # not any child: a build may wait for a subprocess
            try:
                ended, status = os.waitpid(process, os.WNOHANG)
            except ChildProcessError:  # the next signal arrived within this function and was handled
                continue
            if not ended:
                continue
            end = self._ends.pop(process)
            with suppress(OSError):  # the parent may have closed it
                os.write(end, NUMBER.pack(os.waitstatus_to_exitcode(status)))
            os.close(end)

    def _end_with_parent(self, *_: object) -> None:
        """End at once when the parent has ended; the kernel also sends SIGIO for a request."""
        if closed(self._requests.fileno()):
            os._exit(0)


def readable(connection: int) -> bool:
    """Whether data can be read or the peer has closed a connection, given by its file descriptor."""
    poll = select.poll()
    poll.register(connection, select.POLLIN)
    return bool(poll.poll(0))


def closed(connection: int) -> bool:
    """Whether the peer has closed a connection, given by its file descriptor."""
    poll = select.poll()
    poll.register(connection, select.POLLHUP)
    return bool(poll.poll(0))


def main() -> int:
    """Serve one parent; return the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(5)
    _Server(socket.socket(fileno=int(sys.argv[1]))).run()
    return 0


def _made(target: str) -> Any:
    module, _, factory = target.partition(":")
    return getattr(importlib.import_module(module), factory)()


def _become(request: ForkRequest) -> None:
    """Make a fork of the server equivalent to a fresh process of the parent."""
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
    """Build the worker and execute steps until the parent ends, even if it ends during a step; return the exit code."""
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
    """Processor time of this thread (s); the clock module would make every worker import asyncio."""
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
