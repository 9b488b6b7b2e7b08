"""Small files: files in /proc and /sys, which may be missing, and files that are replaced atomically."""

import errno
import fcntl
import itertools
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

MEGABYTE: Final = 1_000_000
SCRATCH: Final = ".new~"
"""Suffix of files being written; killed writers leave such files behind."""

DAMAGED: Final = ".damaged"
"""Suffix of a damaged file that is kept for inspection."""


def text_of(file: Path) -> str | None:
    """Content without surrounding white space; None if the file is missing or cannot be read."""
    try:
        return file.read_text(encoding="utf-8", errors="backslashreplace").strip()
    except OSError:
        return None


def number_of(file: Path) -> int | None:
    """Content as a decimal number; None if ``text_of`` returns None or no number."""
    text = text_of(file)
    try:
        return None if text is None else int(text)
    except ValueError:
        return None


def require_file(path: Path, most: int | None = None) -> None:
    """Reject a file that would block or use too much memory when read.

    Args:
        path: file to read.
        most: maximum size, bytes; None: unlimited.

    Raises:
        OSError: the file is missing, is a folder, a pipe or a device, or is larger than ``most``.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    if most is not None and status.st_size > most:
        raise OSError(errno.EFBIG, f"{status.st_size} bytes, expected at most {most}", str(path))


def require_place(path: Path) -> None:
    """Reject an output file that cannot be written, before the work for its content.

    Raises:
        OSError: its folder is missing or not writable, or it is a folder itself.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def replace_file(path: Path, content: str | bytes, mode: int = 0o644, *, follow_links: bool = True) -> None:
    """Replace the ``content`` of a file atomically; an existing file keeps its mode.

    File and folder are synced: when this returns, the content survives a power cut.

    Args:
        path: the file, or a link to it.
        content: new content; text becomes UTF-8.
        mode: mode of a new file.
        follow_links: whether to keep a link and write its target; otherwise the file replaces the link.

    Raises:
        OSError: it could not be written, or is a folder, a device or the like; the file has either the old or the new
            content.
    """
    place = Path(os.path.realpath(path)) if follow_links else path
    before = place.lstat().st_mode if os.path.lexists(place) else None
    if before is not None and not stat.S_ISREG(before):
        if follow_links or not stat.S_ISLNK(before):
            raise OSError(errno.EINVAL, "Not a regular file", str(place))
        before = None
    with _scratch(place) as (handle, scratch):
        with os.fdopen(handle, "wb", closefd=False) as file:
            file.write(content.encode() if isinstance(content, str) else content)
        os.fchmod(handle, mode if before is None else stat.S_IMODE(before))
        os.fsync(handle)
        scratch.replace(place)
    sync_folder(place.parent)


def remove_file(path: Path) -> None:
    """Remove a file if it exists; when this returns, the removal survives a power cut.

    Raises:
        OSError: it could not be removed; it may reappear after the next power cut.
    """
    path.unlink(missing_ok=True)
    if path.parent.exists():
        sync_folder(path.parent)


def damaged_names(path: Path) -> Iterator[Path]:
    """Names for damaged files of this name: NAME.damaged, NAME.damaged-2 and so on."""
    for number in itertools.count(1):
        yield path.with_name(path.name + DAMAGED + (f"-{number}" if number > 1 else ""))


def put_aside(path: Path) -> str:
    """Rename a damaged file to the first free one of ``damaged_names``; return a text with its new name."""
    try:
        kept = next(name for name in damaged_names(path) if not os.path.lexists(name))
        path.rename(kept)
        sync_folder(path.parent)
    except OSError as error:
        return f"the file cannot be renamed: {error.strerror}"
    return f"the file is kept as {kept.name}"


def make_folder(path: Path, mode: int = 0o777) -> None:
    """Create a folder of this ``mode`` and its missing parents, and sync the new names.

    Raises:
        OSError: one could not be created.
    """
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(mode, parents=True, exist_ok=True)
    for folder in missing:
        sync_folder(folder.parent)


def sync_folder(folder: Path) -> None:
    """Sync a folder: only then is a new or renamed file in it safe.

    Raises:
        OSError: the disk failed.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # file systems without folders, such as some network file systems
            raise
    finally:
        os.close(handle)


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove leftovers of killed writers from a folder; files being written are kept.

    Returns:
        The files that were removed.

    Raises:
        OSError: the folder cannot be read, or a file cannot be removed.
    """
    removed = []
    for path in sorted(folder.glob(f"*{SCRATCH}")) if folder.is_dir() else ():
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.ELOOP):
                continue
            raise
        try:
            if stat.S_ISREG(os.fstat(handle).st_mode):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink(missing_ok=True)
                removed.append(path)
        except BlockingIOError:
            pass
        finally:
            os.close(handle)
    return removed


@contextmanager
def _scratch(place: Path) -> Iterator[tuple[int, Path]]:
    """Yield a new, locked file next to ``place`` and its path; unless renamed, it is removed at the end."""
    while True:
        handle, name = tempfile.mkstemp(dir=place.parent, prefix=f"{place.name}.", suffix=SCRATCH)
        scratch = Path(name)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            if os.fstat(handle).st_nlink == 0:  # removed as a leftover before it was locked
                continue
            yield handle, scratch
        except BaseException:
            scratch.unlink(missing_ok=True)
            raise
        finally:
            os.close(handle)
        return


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path for writing a file of any size: its name with ``.part``, renamed when the context ends.

    If the body fails, its output is removed, and an existing file of that name is kept. File and folder are synced. A
    system error without a file name, such as for a full disk, gets this name.

    Raises:
        OSError: ``path`` is a folder, a device or the like, or cannot be replaced.
    """
    place = Path(os.path.realpath(path))
    if os.path.lexists(place):
        require_file(place)
    part = place.with_name(place.name + ".part")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(place)
    except BaseException as error:
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    sync_folder(place.parent)
