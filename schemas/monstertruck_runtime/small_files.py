"""Small files: such of /proc and /sys, made up by the kernel and often not there, and such that are replaced whole."""

import os
import tempfile
from pathlib import Path


def text_of(file: Path) -> str | None:
    """Content without the white space around it; None if it is not there or the kernel refuses to tell."""
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def number_of(file: Path) -> int | None:
    """Content as a decimal number; None where ``text_of`` gives none or something else."""
    text = text_of(file)
    try:
        return None if text is None else int(text)
    except ValueError:
        return None


def replace_file(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    """Give the file its ``content``, as a whole or not at all; one that was there keeps its mode.

    Args:
        path: the file, or a link to it, which stays a link.
        content: new content; text becomes UTF-8.
        mode: of a new file.

    Raises:
        OSError: it could not be written; nothing has changed then.
    """
    place = path.resolve()
    handle, scratch = tempfile.mkstemp(dir=place.parent, prefix=place.name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(handle)
        Path(scratch).chmod(place.stat().st_mode if place.exists() else mode)
        Path(scratch).replace(place)
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise
