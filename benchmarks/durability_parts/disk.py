"""A disk after a power cut: possible remaining content, from a trace of writes, names and syncs.

``trace.c`` is compiled to a library that records the changes of a process below one folder. ``Disk`` replays such a
trace up to any point. Synced data remains. Of the rest a part remains: of the changes of names a first part (a journal
keeps their order; syncing a folder keeps all until then), and of each file's writes a first part, whose last pages may
contain zeros, because a file gets its new length before its data.
"""

import os
import random
import struct
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

SOURCE: Final = Path(__file__).with_name("trace.c")
PAGE: Final = 4096
ACKNOWLEDGED: Final = "acknowledged.txt"
"""File in the writer's folder: a line for every acknowledged change."""
_HEAD: Final = struct.Struct("<BQQII")


class Event(NamedTuple):
    """One recorded operation of the process."""

    kind: str
    inode: int
    offset: int
    first: bytes
    second: bytes


def compiled(folder: Path) -> Path:
    """Compile the tracing library into ``folder``.

    Raises:
        FileNotFoundError: there is no C compiler.
    """
    library = folder / "trace.so"
    subprocess.run(
        ["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl", "-lpthread"],
        check=True,
    )
    return library


def traced(library: Path, root: Path, trace: Path) -> dict[str, str]:
    """Return the environment of a process whose changes below ``root`` are appended to ``trace``."""
    return os.environ | {
        "LD_PRELOAD": str(library),
        "DURABILITY_ROOT": str(root.resolve()),
        "DURABILITY_TRACE": str(trace.resolve()),
    }


def events(trace: bytes) -> Iterator[Event]:
    """Yield the events of a trace; a truncated one is left out."""
    at = 0
    while at + _HEAD.size <= len(trace):
        kind, inode, offset, first, second = _HEAD.unpack_from(trace, at)
        at += _HEAD.size
        if at + first + second > len(trace):
            return
        yield Event(chr(kind), inode, offset, trace[at : at + first], trace[at + first : at + first + second])
        at += first + second


@dataclass(eq=False)
class _File:
    """A file: its content on the disk, and the writes since."""

    synced: bytes = b""
    pending: list[Event] = field(default_factory=list)

    def after(self, count: int) -> bytes:
        """Return the content with the first ``count`` pending writes."""
        data = bytearray(self.synced)
        for event in self.pending[:count]:
            if event.kind == "T":
                del data[event.offset :]
                data += bytes(event.offset - len(data))
            else:
                data += bytes(max(event.offset - len(data), 0))
                data[event.offset : event.offset + len(event.second)] = event.second
        return bytes(data)

    def sync(self) -> None:
        self.synced, self.pending = self.after(len(self.pending)), []

    def left(self, rng: random.Random) -> bytes:
        """Return a possible content after a power cut."""
        count = rng.randint(0, len(self.pending))
        data = bytearray(self.after(count))
        if count and (last := self.pending[count - 1]).kind == "W" and rng.random() < 0.5:
            for begin in range(last.offset // PAGE * PAGE, last.offset + len(last.second), PAGE):
                if rng.random() < 0.5:
                    low, high = max(begin, last.offset), min(begin + PAGE, last.offset + len(last.second))
                    data[low:high] = bytes(high - low)
        return bytes(data)


class Names(dict[str, "_File | bytes | None"]):
    """Target of each path: a file, the target of a link, or a folder (None)."""

    def apply(self, event: tuple[str, str, str, "_File | bytes | None"]) -> None:
        """Apply a change of names: kind, two paths, and the target of a new name."""
        kind, first, second, what = event
        match kind:
            case "O" | "M" | "Y":
                self[first] = what
            case "U" | "X":
                self.pop(first, None)
            case "L":
                self[second] = what
            case "E":
                self._exchange(first, second)
            case "R":
                self._drop(second)
                for path in [path for path in self if path == first or path.startswith(first + "/")]:
                    self[second + path[len(first) :]] = self.pop(path)

    def _exchange(self, first: str, second: str) -> None:
        aside = {path: self[path] for path in self if path == first or path.startswith(first + "/")}
        self._drop(first)
        self.apply(("R", second, first, None))
        self |= {second + path[len(first) :]: what for path, what in aside.items()}

    def _drop(self, place: str) -> None:
        for path in [path for path in self if path == place or path.startswith(place + "/")]:
            del self[path]


class Disk:
    """Replays a trace.

    Args:
        root: traced folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = str(root.resolve())
        self._names, self._synced = Names(), Names()
        """Names as the process sees them, and as the disk has them for certain."""
        self._pending: list[tuple[str, str, str, _File | bytes | None]] = []
        """Changes of names since a folder was synced."""
        self._files: dict[int, _File] = {}
        """By inode, which another file gets once it is free."""
        self.acknowledged = b""

    def play(self, event: Event) -> None:
        """Apply an event."""
        first, second = event.first.decode(), event.second.decode() if event.kind in "RLEY" else ""
        match event.kind:
            case "O":
                self._open(event, first)
            case "W" | "T":
                self._write(event)
            case "S":
                if event.inode in self._files:
                    self._files[event.inode].sync()
            case "D":
                for change in self._pending:
                    self._synced.apply(change)
                self._pending = []
            case "Y":
                self._change(("Y", second, "", event.first))
            case "L":
                self._change(("L", first, second, self._names.get(first)))
            case kind:
                self._change((kind, first, second, None))

    def _open(self, event: Event, path: str) -> None:
        if path not in self._names:
            self._files[event.inode] = _File()
            self._change(("O", path, "", self._files[event.inode]))
        elif event.offset:
            self._files[event.inode].pending.append(Event("T", event.inode, 0, b"", b""))

    def _write(self, event: Event) -> None:
        file = self._files[event.inode]
        if file is self._names.get(f"{self._root}/{ACKNOWLEDGED}"):
            self.acknowledged += event.second
        else:
            file.pending.append(event)

    def _change(self, change: tuple[str, str, str, _File | bytes | None]) -> None:
        self._names.apply(change)
        self._pending.append(change)

    def leave(self, folder: Path, rng: random.Random) -> None:
        """Write into ``folder`` a possible content after a power cut now."""
        names = Names(self._synced)
        for change in self._pending[: rng.randint(0, len(self._pending))]:
            names.apply(change)
        written: dict[int, Path] = {}
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(names):
            what, place = names[path], folder / path.removeprefix(self._root + "/")
            if place.name == ACKNOWLEDGED or path == self._root:
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            if what is None:
                place.mkdir(exist_ok=True)
            elif isinstance(what, bytes):
                place.symlink_to(what.decode())
            elif id(what) in written:
                place.hardlink_to(written[id(what)])
            else:
                place.write_bytes(what.left(rng))
                written[id(what)] = place
