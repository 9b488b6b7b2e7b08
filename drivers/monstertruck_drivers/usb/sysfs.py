"""Small reads and writes in sysfs."""

from pathlib import Path


class Sysfs:
    """Attributes below ``root``; what cannot be read is absent.

    Some attributes wait for the device (strings, ``authorized``), so nothing of this belongs on the event loop.
    """

    def __init__(self, root: Path = Path("/sys")) -> None:
        self.root = root

    def text(self, path: str) -> str | None:
        """Content of an attribute without surrounding blanks; None if it is not there or cannot be read."""
        try:
            return (self.root / path).read_text(errors="replace").strip()
        except OSError:
            return None

    def number(self, path: str, base: int = 10) -> int | None:
        """Content as an integer; None if it is none."""
        try:
            return int(self.text(path) or "", base)
        except ValueError:
            return None

    def names(self, path: str) -> list[str]:
        """Entries of a folder, sorted; none if it is not there."""
        try:
            return sorted(entry.name for entry in (self.root / path).iterdir())
        except OSError:
            return []

    def write(self, path: str, text: str) -> None:
        """Set an attribute.

        Raises:
            OSError: it is not there, not permitted, or refused.
        """
        with (self.root / path).open("r+") as attribute:  # an attribute is never created
            attribute.write(text)
