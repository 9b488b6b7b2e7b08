"""Remote calls for the recordings on the robot: list, read in chunks, delete.

Downloads must not disturb the robot: chunks are small, each answer is delayed to limit the rate, a thread reads the
files, and only one source downloads at a time. Names are matched against the existing files, so a path is never
accepted.
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

TURN: Final = 5.0
"""Time without a chunk until another source may download (s)."""
NAME: Final = re.compile(r"[A-Za-z0-9_.-]{1,120}\.mcap(\.damaged(-\d{1,3})?)?")
DAMAGED_KIND: Final = "damaged"


@dataclass(frozen=True, slots=True)
class Recording:
    """Recording file."""

    name: str
    bytes: int
    modified: float
    """Real time of the last change (s since 1970)."""
    kind: str
    """``run``, ``blackbox`` (the minute before a stop), or ``damaged``: the original of a log that was repaired."""
    open: bool
    """Whether it is being written by this daemon, or locked by another daemon or a repair."""


class Recordings:
    """Recordings of a robot.

    Args:
        folders: folders of the recordings, by kind.
        current: returns the file being written, or None.
        clock: time source.
        events: sink for deletions, with the source of each request.
        offload: runs the reading of files.
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
        """Source that is downloading."""
        self._until = 0
        """End of its exclusive access (ns)."""
        self._free = 0
        """Earliest time of the next chunk (ns)."""
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
                except FileNotFoundError:  # removed by the log quota or another caller
                    continue
                damaged = DAMAGED_NAME.search(path.name)
                shown = DAMAGED_KIND if damaged else kind
                yield path, Recording(path.name, status.st_size, status.st_mtime, shown, path == current)

    def _find(self, payload: dict[str, Any]) -> tuple[Path, Recording]:
        name = payload.get("name")
        found = next(((path, row) for path, row in self._files() if row.name == name), None)
        if found is None:
            raise NotFoundError(f"recording {str(name)[:120]!r}: no such recording")
        return found

    async def _list(self, _: dict[str, Any]) -> dict[str, Any]:
        rows = await self._offload(lambda: [replace(row, open=_is_open(path, row)) for path, row in self._files()])
        rows.sort(key=lambda row: row.modified, reverse=True)
        most = 500  # maximum number of listed recordings, the latest ones
        return {"recordings": [asdict(row) for row in rows[:most]], "left_out": max(len(rows) - most, 0)}

    async def _read(self, payload: dict[str, Any]) -> dict[str, Any]:
        offset, source = payload.get("offset", 0), str(payload.get("source", ""))
        if not isinstance(offset, int) or offset < 0:
            raise InputError(f"offset: expected a number of bytes, got {offset!r}")
        now = self._clock.now()
        if source != self._reader and now < self._until:
            raise BusyError(f"{self._reader} is downloading a recording: wait until it ends")
        self._reader, self._until = source, now + round(TURN * SECOND)
        async with self._reading:
            await self._clock.sleep(max(self._free - self._clock.now(), 0) / SECOND)

            def read() -> tuple[str, int, Recording]:
                path, row = self._find(payload)
                try:
                    with path.open("rb") as file:
                        file.seek(min(offset, row.bytes))  # empty beyond the end
                        # Maximum data per answer (bytes).
                        data = file.read(65_536)
                except OSError as error:
                    raise InputError(f"recording {row.name}: cannot be read: {error.strerror}") from error
                return base64.b64encode(data).decode(), len(data), row

            text, size, row = await self._offload(read)
            now = self._clock.now()
            # Maximum total download rate (bytes/s).
            self._free = max(self._free, now) + round(size / 1_000_000.0 * SECOND)
            self._until = now + round(TURN * SECOND) if offset + size < row.bytes else now
        return {"data": text, "bytes": row.bytes, "open": row.open}

    async def _delete(self, payload: dict[str, Any]) -> dict[str, Any]:
        by = str(payload.get("source", ""))

        def delete() -> Recording:
            path, row = self._find(payload)
            if _is_open(path, row):
                raise BusyError(f"recording {row.name}: the recorder is writing it")
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
    except OSError:  # removed, or not readable
        return False
