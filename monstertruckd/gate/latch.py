"""The emergency stop's memory: a file that exists while the stop is latched, whatever happens to the process."""

import os
import threading
from pathlib import Path
from typing import Protocol


class Latch(Protocol):
    """Durable yes or no."""

    def engaged(self) -> bool:
        """Whether the emergency stop is latched."""
        ...

    def store(self, engaged: bool) -> None:
        """Make it so, durably; may block for a file system's time.

        Raises:
            OSError: it could not be stored.
        """
        ...


class MemoryLatch:
    """Latch that lives as long as the object: for runs that leave no trace."""

    def __init__(self, engaged: bool = False) -> None:
        self._engaged = engaged

    def engaged(self) -> bool:
        """Whether the emergency stop is latched."""
        return self._engaged

    def store(self, engaged: bool) -> None:
        """Keep the value."""
        self._engaged = engaged


class EstopLatch:
    """Latch in a file. Existing means latched, so a damaged or empty file stops rather than drives.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._storing = threading.Lock()

    def engaged(self) -> bool:
        """Whether the file is there; a directory that cannot be searched counts as latched."""
        try:
            self._path.lstat()
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def prepare(self) -> None:
        """Make sure that it can be stored later.

        Raises:
            OSError: its directory cannot be made or written.
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
