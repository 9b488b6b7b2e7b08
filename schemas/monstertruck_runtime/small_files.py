"""Small files: those of /proc and /sys, which may be missing, and files that are replaced as a whole."""

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def text_of(file: Path) -> str | None:
    """Content without the white space around it; None if it is not there or cannot be read."""
    try:
        return file.read_text(encoding="utf-8", errors="backslashreplace").strip()
    except OSError:
        return None


def number_of(file: Path) -> int | None:
    """Content as a decimal number; None where ``text_of`` gives none or something else."""
    text = text_of(file)
    try:
        return None if text is None else int(text)
    except ValueError:
        return None


def require_file(path: Path, most: int | None = None) -> None:
    """Refuse what would take forever, or too much memory, to read.

    Args:
        path: to be read.
        most: bytes it may have; None = any number.

    Raises:
        OSError: nothing is there, it is a folder, a pipe or a device, or is longer than ``most``.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    if most is not None and status.st_size > most:
        raise OSError(errno.EFBIG, f"{status.st_size} bytes, expected at most {most}", str(path))


def require_place(path: Path) -> None:
    """Refuse a file that cannot be written, before the work whose result it is to hold.

    Raises:
        OSError: its folder is not there or cannot be written to, or it is a folder itself.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    try:
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def replace_file(path: Path, content: str | bytes, mode: int = 0o644, *, follow_links: bool = True) -> None:
    """Give the file its ``content``, as a whole or not at all; one that was there keeps its mode.

    Args:
        path: the file, or a link to it.
        content: new content; text becomes UTF-8.
        mode: of a new file.
        follow_links: a link stays one and its file gets the content; otherwise the file takes the link's place.

    Raises:
        OSError: it could not be written, or is a folder, a device or the like; nothing has changed then.
    """
    place = path.resolve() if follow_links else path
    before = place.lstat().st_mode if os.path.lexists(place) else None
    if before is not None and not stat.S_ISREG(before):
        if follow_links or not stat.S_ISLNK(before):
            raise OSError(errno.EINVAL, "Not a regular file", str(place))
        before = None
    handle, scratch = tempfile.mkstemp(dir=place.parent, prefix=place.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(handle)
        Path(scratch).chmod(mode if before is None else stat.S_IMODE(before))
        Path(scratch).replace(place)
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields where to write a file of any length: ``.part`` behind its name, which it takes once the body ends.

    If the body fails, what it wrote is removed, and a file of that name stays as it was.

    Raises:
        OSError: ``path`` is a folder, a device or the like, or cannot be replaced.
    """
    place = path.resolve()
    if place.exists():
        require_file(place)
    part = place.with_name(place.name + ".part")
    try:
        yield part
        part.replace(place)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
