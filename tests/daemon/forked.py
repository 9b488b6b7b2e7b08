"""Commands of the program as forks of a process that has imported it.

Every command imports for one to four seconds of processor time, and the wall-clock tests start more than a hundred. The
daemon, and what is started by itself in a test, is a process of its own from its first instruction.
"""

import asyncio
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from multiprocessing.context import ForkServerProcess
from multiprocessing.reduction import DupFd
from pathlib import Path

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["tests.daemon.preloaded"])


def run(*arguments: str, folder: Path, timeout: float) -> subprocess.CompletedProcess[str]:
    """Run one command to its end, without input."""
    with Path(os.devnull).open() as nothing, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        process = _start(arguments, folder, (nothing.fileno(), out.fileno(), errors.fileno()))
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(arguments, timeout)
        texts = [os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode() for file in (out, errors)]
        return subprocess.CompletedProcess(arguments, process.exitcode, *texts)


class Input:
    """What a command is given; little enough for its pipe."""

    def __init__(self, pipe: int) -> None:
        self._file = os.fdopen(pipe, "wb", buffering=0)

    def write(self, data: bytes) -> None:
        self._file.write(data)

    async def drain(self) -> None:
        """Nothing waits."""

    def close(self) -> None:
        self._file.close()


class Output:
    """What a command prints."""

    def __init__(self, pipe: int) -> None:
        self._file = os.fdopen(pipe, "rb")

    async def readline(self) -> bytes:
        return await asyncio.to_thread(self._file.readline)

    async def read(self) -> bytes:
        """All until its end."""
        with self._file:
            return await asyncio.to_thread(self._file.read)


class Forked:
    """A running command: what is used of ``asyncio.subprocess.Process``."""

    def __init__(self, process: ForkServerProcess, stdin: Input, stdout: Output) -> None:
        self._process, self.stdin, self.stdout = process, stdin, stdout

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    async def communicate(self) -> None:
        """Wait for the end."""
        self.stdin.close()
        await self.stdout.read()
        while self.returncode is None:
            await asyncio.sleep(0.01)


async def started(*arguments: str, folder: Path, errors: Path) -> Forked:
    """Start a command with pipes to and from it."""
    (its_in, our_out), (our_in, its_out) = os.pipe(), os.pipe()
    with errors.open("ab") as stderr, os.fdopen(its_in), os.fdopen(its_out):
        process = await asyncio.to_thread(_start, arguments, folder, (its_in, its_out, stderr.fileno()))
    return Forked(process, Input(our_out), Output(our_in))


def _start(arguments: tuple[str, ...], folder: Path, streams: tuple[int, int, int]) -> ForkServerProcess:
    process = CONTEXT.Process(target=_Command(arguments, folder, streams, dict(os.environ)))
    process.start()
    return process


class _Command:
    """What the fork does."""

    def __init__(
        self, arguments: tuple[str, ...], folder: Path, streams: tuple[int, int, int], environment: dict[str, str]
    ) -> None:
        self._arguments, self._folder, self._streams, self._environment = arguments, folder, streams, environment

    def __getstate__(self) -> tuple[object, ...]:
        return self._arguments, self._folder, tuple(map(DupFd, self._streams)), self._environment

    def __setstate__(self, state: tuple[object, ...]) -> None:
        self._arguments, self._folder, self._streams, self._environment = state

    def __call__(self) -> None:
        for number, stream in enumerate(self._streams):
            received = stream.detach()
            os.dup2(received, number)
            os.close(received)
        sys.stdin, sys.stdout = open(0, closefd=False), open(1, "w", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", closefd=False)  # noqa: SIM115
        os.environ.clear()
        os.environ.update(self._environment)
        os.chdir(self._folder)
        sys.argv[1:] = self._arguments
        runpy.run_module("monstertruckd", run_name="__main__", alter_sys=True)
