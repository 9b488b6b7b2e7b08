"""Remote calls for the recordings on the robot: list, read in chunks, delete.

A download must not harm the robot: chunks are small, their rate is limited by making the caller wait, files are read
in a thread, and one source downloads at a time. Names are looked up among the files that are there: no path is one.
"""

import asyncio
import base64
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import BusyError, InputError, NotFoundError
from monstertruck_runtime.ports import EventSink
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruckd.bus.rpc import Rpc
from monstertruckd.recorder.log_file import DAMAGED_NAME
from monstertruckd.recorder.repair import in_use

LIST: Final = "recordings"
READ: Final = "recording_read"
DELETE: Final = "recording_delete"

CHUNK: Final = 65_536
"""Bytes of one answer at most."""
DOWNLOAD_RATE: Final = 1_000_000.0
"""Bytes a second that all downloads take together."""
TURN: Final = 5.0
"""Seconds without a chunk after which another source may download."""
NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,120}\.mcap(\.damaged(-\d{1,3})?)?")
DAMAGED_KIND: Final = "damaged"


@dataclass(frozen=True, slots=True)
class Recording:
    """One file."""

    name: str
    bytes: int
    modified: float
    """Real time of the last change, s since 1970."""
    kind: str
    """``run``, ``blackbox`` (the minute before a stop), or ``damaged``: the original of a log that was repaired."""
    open: bool
    """It is being written: by this daemon, or by another one or a repair that has it locked."""


class Recordings:
    """The recordings of one robot.

    Args:
        folders: where they are, by kind.
        current: file that is being written; None = none is.
        clock: time.
        events: gets an event for every deletion, with who requested it.
        offload: where files are read.
    """

    def __init__(
        self,
        folders: dict[str, Path],
        current: Callable[[], Path | None],
        clock: Clock,
        events: EventSink,
        offload: Offload,
    ) -> None:
        self._folders = folders
        self._current = current
        self._clock = clock
        self._events = events
        self._offload = offload
        self._reader = ""
        """Source that downloads."""
        self._until = 0
        """It alone may until then, ns."""
        self._free = 0
        """When the next chunk may leave, ns."""
        self._reading = asyncio.Lock()

    def register(self, rpc: Rpc) -> None:
        """Serve ``recordings``, ``recording_read`` and ``recording_delete``."""
        rpc.register(LIST, self._list, AccessRole.OBSERVER, recorded=False)
        rpc.register(READ, self._read, AccessRole.PILOT, recorded=False)
        rpc.register(DELETE, self._delete, AccessRole.ENGINEER)

    def _files(self) -> Iterable[tuple[Path, Recording]]:
        current = self._current()
        for kind, folder in self._folders.items():
            for path in folder.glob("*.mcap*") if folder.is_dir() else ():
                if path.is_symlink() or not path.is_file() or not NAME.fullmatch(path.name):
                    continue
                try:
                    status = path.stat()
                except FileNotFoundError:  # the quota of the logs, or another caller, took it
                    continue
                damaged = DAMAGED_NAME.search(path.name)
                shown = DAMAGED_KIND if damaged else kind
                yield path, Recording(path.name, status.st_size, status.st_mtime, shown, path == current)

    def _find(self, payload: dict[str, Any]) -> tuple[Path, Recording]:
        name = payload.get("name")
        found = next(((path, row) for path, row in self._files() if row.name == name), None)
        if found is None:
            raise NotFoundError(f"recording {str(name)[:120]!r}: there is none of this name")
        return found

    async def _list(self, _: dict[str, Any]) -> dict[str, Any]:
        rows = await self._offload(lambda: [replace(row, open=_is_open(path, row)) for path, row in self._files()])
        rows.sort(key=lambda row: row.modified, reverse=True)
        most = 500  # recordings listed; the newest
        return {"recordings": [asdict(row) for row in rows[:most]], "left_out": max(len(rows) - most, 0)}

    async def _read(self, payload: dict[str, Any]) -> dict[str, Any]:
        offset, source = payload.get("offset", 0), str(payload.get("source", ""))
        if not isinstance(offset, int) or offset < 0:
            raise InputError(f"offset: expected a number of bytes, got {offset!r}")
        now = self._clock.now()
        if source != self._reader and now < self._until:
            raise BusyError(f"{self._reader} downloads a recording: one at a time")
        self._reader, self._until = source, now + round(TURN * SECOND)
        async with self._reading:
            await self._clock.sleep(max(self._free - self._clock.now(), 0) / SECOND)

            def read() -> tuple[str, int, int]:
                path, row = self._find(payload)
                try:
                    with path.open("rb") as file:
                        file.seek(min(offset, row.bytes))  # behind the end there is nothing
                        data = file.read(CHUNK)
                except OSError as error:
                    raise InputError(f"recording {row.name}: cannot be read: {error.strerror}") from error
                return base64.b64encode(data).decode(), len(data), row.bytes

            text, size, whole = await self._offload(read)
            now = self._clock.now()
            self._free = max(self._free, now) + round(size / DOWNLOAD_RATE * SECOND)
            self._until = now + round(TURN * SECOND) if offset + size < whole else now
        return {"data": text, "bytes": whole}

    async def _delete(self, payload: dict[str, Any]) -> dict[str, Any]:
        by = str(payload.get("source", ""))

        def delete() -> Recording:
            path, row = self._find(payload)
            if _is_open(path, row):
                raise BusyError(f"recording {row.name}: it is being written")
            try:
                path.unlink()
            except OSError as error:
                raise InputError(f"recording {row.name}: cannot be deleted: {error.strerror}") from error
            return row

        row = await self._offload(delete)
        text = f"{row.name} ({row.bytes / 1e6:.1f} MB) deleted by {by}"
        self._events(Reason.RECORDING_DELETED, Severity.INFO, "recorder", text, name=row.name, by=by)
        return {"name": row.name, "bytes": row.bytes}


def _is_open(path: Path, row: Recording) -> bool:
    try:
        return row.open or in_use(path)
    except OSError:  # gone, or not ours to read
        return False
