"""A program that acts as a device: its output is the device's data, and the device is lost when the program exits."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from monstertruck_drivers.link import STREAM_LIMIT, Link
from monstertruck_runtime.errors import DeviceLostError


class CommandPort:
    """Starts a program, without a shell, each time the port is opened, and ends it when the link closes.

    Args:
        command: program and arguments.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self.name = Path(command[0]).name
        self._command = tuple(command)

    async def open(self) -> Link:
        """Start the program.

        Raises:
            DeviceLostError: it cannot be started.
        """
        try:
            _, protocol = await asyncio.get_running_loop().subprocess_exec(
                lambda: _ProgramOutput(self.name), *self._command, stdin=asyncio.subprocess.DEVNULL
            )
        except OSError as error:
            raise DeviceLostError(f"{self._command[0]}: cannot be started: {error.strerror}") from error
        return protocol.link


class _ProgramOutput(asyncio.SubprocessProtocol):
    """Feeds a ``Link`` from a program.

    Args:
        name: name for error messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._said = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The program has started."""
        self._program = cast("asyncio.SubprocessTransport", transport)
        self.link = Link(self._name, lambda _: None, self._end, limit=STREAM_LIMIT)

    def pipe_data_received(self, fd: int, data: bytes | str) -> None:
        """Output or error output was received."""
        assert isinstance(data, bytes)
        if fd == 1:
            self.link.feed(data)
        else:
            self._said = (self._said + data)[-400:]  # bytes

    def process_exited(self) -> None:
        """The program ended by itself, or after SIGTERM."""
        said = self._said.decode(errors="backslashreplace").strip().rpartition("\n")[2]
        self.link.lose(f"ended with exit code {self._program.get_returncode()}{f': {said}' if said else ''}")
        self._program.close()

    def _end(self) -> None:
        self._program.terminate()
        asyncio.get_running_loop().call_later(1.0, self._program.close)  # seconds to end after SIGTERM
