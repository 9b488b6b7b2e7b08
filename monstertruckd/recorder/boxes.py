"""The folder of black boxes: names, listing, quota."""

import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_schemas.reasons import Reason

log = logging.getLogger(__name__)

PART: Final = ".part"
"""Ends the name of a file that is being written."""

_NAME: Final = re.compile(r"blackbox-(\d{6,})-([a-z_]+)\.mcap")


@dataclass(frozen=True, slots=True)
class Box:
    """One black box."""

    path: Path
    number: int
    """Counts the folder's boxes over all runs."""
    reason: str
    """What tripped the gate."""
    size: int
    """Bytes."""


def black_boxes(directory: Path) -> list[Box]:
    """The finished black boxes of a folder, oldest first; none if it is not there.

    Raises:
        OSError: the folder cannot be read.
    """
    if not directory.exists():
        return []
    named = ((path, _NAME.fullmatch(path.name)) for path in directory.iterdir())
    boxes = [Box(path, int(name[1]), name[2], path.stat().st_size) for path, name in named if name is not None]
    return sorted(boxes, key=lambda box: box.number)


class BoxFolder:
    """Names boxes and keeps their sum within a quota. Its methods that touch the disk raise ``OSError``.

    Args:
        directory: made when missing.
        quota: bytes; the newest box of each reason stays even beyond them.
    """

    def __init__(self, directory: Path, quota: int) -> None:
        self.directory = directory
        self._quota = quota
        self._number = 0

    def look(self) -> None:
        """Go on with the numbers of earlier runs, and remove what they left unfinished."""
        self.directory.mkdir(parents=True, exist_ok=True)
        for path in self.directory.glob(f"*{PART}"):
            path.unlink(missing_ok=True)
        self._number = max((box.number for box in black_boxes(self.directory)), default=0)

    def next_name(self, reason: Reason) -> str:
        """Name of the next box; touches nothing."""
        self._number += 1
        return f"blackbox-{self._number:06d}-{reason.value}.mcap"

    def begin(self, name: str) -> Path:
        """Where to write the box until it is complete."""
        self.directory.mkdir(parents=True, exist_ok=True)
        part = self.directory / (name + PART)
        part.unlink(missing_ok=True)
        return part

    def finish(self, name: str) -> Path:
        """Give the complete box its name, durably, and remove old ones beyond the quota."""
        path = self.directory / name
        (self.directory / (name + PART)).replace(path)
        folder = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
        self._keep_quota()
        return path

    def _keep_quota(self) -> None:
        boxes = black_boxes(self.directory)
        newest = {box.reason: box.number for box in boxes}
        excess = sum(box.size for box in boxes) - self._quota
        for box in boxes:
            if excess > 0 and newest[box.reason] != box.number:
                box.path.unlink(missing_ok=True)
                log.info("removed %s: black boxes exceed %d bytes", box.path, self._quota)
                excess -= box.size
