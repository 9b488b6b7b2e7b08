"""Made-up files of /proc and /sys, for emulators of what the kernel shows there."""

import shutil
from pathlib import Path


class FileTree:
    """Files below a folder; each changes at once and whole, and only if its text does.

    Args:
        root: folder that stands for /, or for a part of it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._texts: dict[str, str] = {}

    def put(self, path: str, text: str) -> None:
        """Make the file say ``text``, with a line end if it has none."""
        if self._texts.get(path) == text:
            return
        self._texts[path] = text
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        scratch = file.with_name(f".{file.name}")
        scratch.write_text(text if text.endswith("\n") else text + "\n")
        scratch.replace(file)

    def remove(self, path: str) -> None:
        """Take away a file or a folder with all its files."""
        target = self.root / path
        if target.is_dir():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)
        self._texts = {
            known: text for known, text in self._texts.items() if known != path and not known.startswith(f"{path}/")
        }
