"""Persistent latch of the emergency stop: a file that exists while the stop is latched, preceded by a mark in memory.

Writing a file so that it survives a loss of power takes time. Meanwhile the mark holds the stop: one byte of a file on
a tmpfs, which survives the process but not a restart of the computer.
"""

import hashlib
import os
import stat
import threading
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, Protocol

from monstertruck_runtime.small_files import make_folder, remove_file, replace_file, require_place

FREE: Final = b"0"
MARKED: Final = b"1"


class Latch(Protocol):
    """Persistent flag."""

    def engaged(self) -> bool:
        """Whether the emergency stop is latched, by the file or by the mark."""

    def stored(self) -> bool | None:
        """Whether the file, which survives a loss of power, exists; None if that cannot be read."""

    def mark(self, engaged: bool) -> None:
        """Set or clear the mark; never blocks.

        Raises:
            OSError: it could not be written.
        """

    def store(self, engaged: bool) -> None:
        """Set the flag and sync it to the disk; may block.

        Raises:
            OSError: it could not be stored.
        """

    def close(self) -> None:
        """Remove the mark: the disk holds the final state."""


class MemoryLatch:
    """Latch in memory, for runs that leave no files."""

    def __init__(self, engaged: bool = False) -> None:
        self._engaged = engaged

    def engaged(self) -> bool:
        """Whether the emergency stop is latched."""
        return self._engaged

    def stored(self) -> bool:
        """Whether the emergency stop is latched; equal to ``engaged``, because there is no disk."""
        return self._engaged

    def mark(self, engaged: bool) -> None:
        """Do nothing: memory needs no mark."""

    def store(self, engaged: bool) -> None:
        """Set the flag."""
        self._engaged = engaged

    def close(self) -> None:
        """Do nothing: there is no mark to remove."""


class Mark:
    """One byte of an open file: writing it needs no file name, no free space and no disk.

    Args:
        path: the file, on a tmpfs; damaged contents mean marked.

    Raises:
        OSError: the file cannot be opened, or is not a regular file of this user alone.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        status = os.fstat(self._file)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid() or status.st_nlink != 1:
            os.close(self._file)
            raise PermissionError(f"{path} is not a file owned by this user alone")
        if status.st_size == 0:
            self.set(marked=False)  # reserves space for the byte

    def engaged(self) -> bool:
        """Whether the mark is set."""
        return os.pread(self._file, 2, 0) != FREE

    def set(self, *, marked: bool) -> None:
        """Write the mark.

        Raises:
            OSError: it could not be written.
        """
        os.pwrite(self._file, MARKED if marked else FREE, 0)

    def close(self) -> None:
        """Remove the file."""
        self._path.unlink(missing_ok=True)
        os.close(self._file)


class EstopLatch:
    """Latch in a file; an existing file means latched, even if damaged or empty.

    Args:
        path: the file.
        marks: folder of the mark, on a tmpfs; the name of the mark is derived from ``path``.
    """

    def __init__(self, path: Path, marks: Path) -> None:
        self._path = path
        self._storing = threading.Lock()
        self._mark: Mark | None = None
        name = hashlib.blake2s(os.fsencode(os.path.realpath(path)), digest_size=8).hexdigest()
        self._mark_path = marks / f"monstertruckd-estop-{name}"

    def prepare(self) -> None:
        """Check that the latch can be stored later, and open the mark.

        Raises:
            OSError: the file cannot be created, or the mark cannot be opened.
        """
        make_folder(self._path.parent)
        require_place(self._path)
        self._mark = Mark(self._mark_path)

    def engaged(self) -> bool:
        """Whether the file exists or cannot be read, or the mark is set."""
        return self.stored() is not False or (self._mark is not None and self._mark.engaged())

    def stored(self) -> bool | None:
        """Whether the file exists; None if its folder cannot be searched."""
        try:
            self._path.lstat()
        except FileNotFoundError:
            return False
        except OSError:
            return None
        return True

    def mark(self, engaged: bool) -> None:
        """Set or clear the mark if it is open.

        Raises:
            OSError: it could not be written.
        """
        if self._mark is not None:
            self._mark.set(marked=engaged)

    def store(self, engaged: bool) -> None:
        """Create or remove the file, atomically and synced to the disk.

        Raises:
            OSError: it could not be stored. The file may still have changed: check ``stored``.
        """
        with self._storing:
            if engaged:
                make_folder(self._path.parent)
                replace_file(self._path, "emergency stop latched\n", follow_links=False)
            else:
                remove_file(self._path)

    def close(self) -> None:
        """Remove the mark."""
        mark, self._mark = self._mark, None
        if mark is not None:
            mark.close()


def marks_folder(configured: Path | None, environment: Mapping[str, str], system: Path = Path("/")) -> Path:
    """Folder for marks: configured folder, or the first usable runtime folder of systemd, the user and the computer.

    Args:
        configured: ``runtime_directory`` of the configuration.
        environment: variables, with ``RUNTIME_DIRECTORY`` in a systemd service.
        system: root of the file system.
    """
    if configured is not None:
        return configured
    given = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    usual: Iterable[Path] = (system / f"run/user/{os.geteuid()}", system / "run")
    return next((folder for folder in usual if os.access(folder, os.W_OK | os.X_OK)), system / "dev/shm")
