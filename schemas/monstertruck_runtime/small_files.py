"""Files of /proc and /sys: small, made up by the kernel as they are read, and often not there."""

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
