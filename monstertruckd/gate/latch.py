"""Persistent latch of the emergency stop: a file that exists while the stop is latched."""

import os
import threading
from pathlib import Path
from typing import Protocol


class Latch(Protocol):
    """Persistent flag."""

    def engaged(self) -> bool:
        """Whether the emergency stop is latched."""
        ...

    def store(self, engaged: bool) -> None:
        """Set the flag and sync it to the disk; may block.

        Raises:
            OSError: it could not be stored.
        """
        ...


class MemoryLatch:
    """Latch in memory, for runs that leave no files."""

    def __init__(self, engaged: bool = False) -> None:
        self._engaged = engaged

    def engaged(self) -> bool:
        """Whether the emergency stop is latched."""
        return self._engaged

    def store(self, engaged: bool) -> None:
        """Set the flag."""
        self._engaged = engaged


class EstopLatch:
    """Latch in a file. An existing file means latched, so a damaged or empty one counts as latched.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._storing = threading.Lock()

    def engaged(self) -> bool:
        """Whether the file exists; a directory that cannot be searched counts as latched."""
        try:
            self._path.lstat()
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def prepare(self) -> None:
        """Check that the latch can be stored later.

        Raises:
            OSError: its directory cannot be created or written.
        """
        self._path.parent.mkdir(parents=True, exist_ok=True)
        draft = self._path.with_name(self._path.name + ".new")
        draft.write_bytes(b"")
        draft.unlink()

    def store(self, engaged: bool) -> None:
        """Create or remove the file, atomically and synced to the disk.

        Raises:
            OSError: it could not be stored.
        """
        with self._storing:
            if engaged:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                draft = self._path.with_name(self._path.name + ".new")
                with draft.open("w") as file:
                    file.write("emergency stop latched\n")
                    file.flush()
                    os.fsync(file.fileno())
                draft.replace(self._path)
            else:
                self._path.unlink(missing_ok=True)
            if self._path.parent.exists():
                self._sync_directory()

    def _sync_directory(self) -> None:
        directory = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)
