"""Black boxes: files that cover the minute around a gate trip, with names, a listing and a quota."""

import asyncio
import errno
import logging
import os
import re
import stat
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Self

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import disk_reason
from monstertruck_runtime.ports import EventSink
from monstertruck_runtime.small_files import make_folder, sync_folder
from monstertruck_runtime.stop_text import causes_text
from monstertruck_runtime.threads import Offload, in_daemon_thread
from monstertruck_schemas.event import Severity, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import TOPICS, Topic
from monstertruckd.recorder.config import BlackBoxConfig, Compression
from monstertruckd.recorder.log_file import RUN_LOG, LogEntry, LogFile, log_offset
from monstertruckd.recorder.repair import in_use
from monstertruckd.recorder.ring import Retention, Ring, RingSnapshot

BATCH: Final = 8
"""Number of messages written without a pause: they delay the control loop by a fraction of a millisecond."""
LAST_SECONDS: Final = 5.0
"""Maximum time for writing after the end of the context (s)."""
log = logging.getLogger(__name__)

PART: Final = ".part"
"""Name suffix of a file that is being written."""

_NAME: Final = re.compile(r"blackbox-(\d{6,})-([a-z_]+)\.mcap")


@dataclass(frozen=True, slots=True)
class BlackBoxFile:
    """One black box."""

    path: Path
    number: int
    """Number of the box, counted over all runs in the folder."""
    reason: str
    """Reason of the trip."""
    size: int
    """File size (bytes)."""


def black_boxes(directory: Path) -> list[BlackBoxFile]:
    """Return the finished black boxes in a folder, oldest first; empty if the folder is missing.

    Raises:
        OSError: the folder cannot be read.
    """
    if not directory.exists():
        return []
    boxes = []
    for path in directory.iterdir():
        name = _NAME.fullmatch(path.name)
        if name is None:
            continue
        with suppress(FileNotFoundError):  # removed meanwhile
            status = path.lstat()
            if stat.S_ISREG(status.st_mode):
                boxes.append(BlackBoxFile(path, int(name[1]), name[2], status.st_size))
    return sorted(boxes, key=lambda box: box.number)


class BlackBoxFolder:
    """Names boxes and keeps their total size within a quota. Methods that access the disk raise ``OSError``.

    Args:
        directory: folder; created if missing.
        quota: maximum total size (bytes); the latest box of each reason is always kept.
    """

    def __init__(self, directory: Path, quota: int) -> None:
        self.directory = directory
        self._quota = quota
        self._number = 0

    def scan(self) -> None:
        """Continue the numbering from earlier runs, and remove their unfinished boxes."""
        make_folder(self.directory)
        self._number = max(self._number, *(box.number for box in black_boxes(self.directory)), 0)
        for path in self.directory.glob(f"*{PART}"):
            try:
                if not in_use(path):
                    path.unlink(missing_ok=True)
            except OSError as error:
                log.warning("%s, which an earlier run left, cannot be removed: %s", path, error.strerror)

    def next_name(self, reason: Reason) -> str:
        """Return the name of the next box, without disk access."""
        self._number += 1
        return f"blackbox-{self._number:06d}-{reason.value}.mcap"

    def begin(self, name: str) -> str:
        """Return the final name of a box: ``name`` or, if it is taken, a name with the next number.

        The name may be taken if the folder could not be read at the start, or if another daemon writes there.
        """
        make_folder(self.directory)
        while self._is_taken(name):
            _, number, reason = name.removesuffix(".mcap").split("-")
            self._number = max(self._number, int(number), *(box.number for box in black_boxes(self.directory))) + 1
            name = f"blackbox-{self._number:06d}-{reason}.mcap"
        return name

    def part(self, name: str) -> Path:
        """Path of the box ``name`` until it is complete."""
        return self.directory / (name + PART)

    def finish(self, name: str) -> None:
        """Rename the complete box to its final name, synced to disk, and remove old boxes beyond the quota."""
        self.part(name).replace(self.directory / name)
        sync_folder(self.directory)
        self._keep_quota()

    def _is_taken(self, name: str) -> bool:
        return any(os.path.lexists(path) for path in (self.directory / name, self.part(name)))

    def _keep_quota(self) -> None:
        boxes = black_boxes(self.directory)
        newest = {box.reason: box.number for box in boxes}
        excess = sum(box.size for box in boxes) - self._quota
        for box in boxes:
            if excess > 0 and newest[box.reason] != box.number:
                try:
                    box.path.unlink(missing_ok=True)
                except OSError as error:
                    log.warning(
                        "%s cannot be removed although black boxes exceed their quota: %s", box.path, error.strerror
                    )
                    continue
                log.info("removed %s: black boxes exceed %d bytes", box.path, self._quota)
                excess -= box.size


@dataclass(slots=True)
class _Pending:
    """Black box to be written at the time ``due``."""

    name: str
    reason: Reason
    due: int
    trips: list[Stop] = field(default_factory=list)

    @property
    def what(self) -> str:
        """Description of the content."""
        if len(self.trips) == 1:
            return f"the minute before stop {self.trips[0].number} is"
        return f"stops {', '.join(str(trip.number) for trip in self.trips)} are"


class BlackBox:
    """Keeps the latest messages in memory and writes them when the gate trips; active within its ``async with`` body.

    Every trip is in a box: a new one, the box of a trip shortly before, or, within ``interval`` of a box for the same
    reason, a later one. When the body ends, pending boxes are written before the context exits, unless that takes
    longer than ``LAST_SECONDS``. If the disk is full, fails or is too slow, the box is lost; the loss is reported and
    has no other effect.

    Args:
        config: time spans and limits.
        directory: folder for the boxes.
        clock: daemon clock.
        events: receives events for saved and lost boxes.
        attachments: JSON-serialisable values in every box, as ``<name>.json``.
        metadata: text about the run, in every box.
        offload: runs the writing of boxes.
        log: current log file of the run, named in every box.
    """

    name = ServiceName.BLACKBOX.value

    def __init__(
        self,
        config: BlackBoxConfig,
        directory: Path,
        clock: Clock,
        events: EventSink,
        *,
        attachments: Mapping[str, Any],
        metadata: Mapping[str, str],
        offload: Offload = in_daemon_thread,
        log: Callable[[], Path | None] = lambda: None,
    ) -> None:
        self._log = log
        self._config = config
        self._clock = clock
        self._events = events
        self._attachments = attachments
        self._metadata = metadata
        self._offload = offload
        self._folder = BlackBoxFolder(directory, config.quota_bytes)
        window = config.before + config.after
        self.ring = Ring(
            Retention(window, max(window, config.journal), config.pictures + config.after, config.picture_period),
            config.memory_bytes,
        )
        self._sequences = {topic.name: 0 for topic in TOPICS}
        self._last: dict[Reason, int] = {}
        """Time when the latest box with a trip of this reason is due."""
        self._pending: list[_Pending] = []
        self._frozen: list[tuple[_Pending, RingSnapshot]] = []
        self._taken: asyncio.Queue[tuple[_Pending, RingSnapshot] | None] = asyncio.Queue()
        self._wake = asyncio.Event()
        self._closing = False
        self._hurry = threading.Event()
        self._given_up = threading.Event()
        self._loop_thread: int | None = None

    async def __aenter__(self) -> Self:
        self._loop_thread = threading.get_ident()
        try:
            await self._offload(self._folder.scan)
        except OSError as error:
            self._failed(error, "no black boxes yet")
        self._taking = asyncio.create_task(self._take(), name=f"{self.name} taking")
        self._saving = asyncio.create_task(self._save_all(), name=f"{self.name} saving")
        return self

    async def __aexit__(self, *_: object) -> None:
        self.freeze()
        for frozen in self._frozen:
            self._taken.put_nowait(frozen)
        self._closing = True
        self._wake.set()
        self._hurry.set()
        try:
            async with self._clock.deadline(LAST_SECONDS):
                await asyncio.shield(self._saving)
        except TimeoutError:
            log.error("black box: the last box is lost because its disk took longer than %g s", LAST_SECONDS)
        finally:
            self._given_up.set()
            for task in (self._taking, self._saving):
                task.cancel()
            await asyncio.wait((self._taking, self._saving))

    def freeze(self) -> None:
        """Capture the content of the pending boxes before they are due; they are written when the context exits."""
        self._frozen += [(pending, self.ring.snapshot()) for pending in self._pending]
        self._pending.clear()
        self._wake.set()

    def record(self, topic: Topic[Any], stamp: int, payload: bytes, at: int | None = None) -> None:
        """Store one encoded message.

        Args:
            topic: entry of the topic table.
            stamp: stamp of the message (ns).
            payload: encoded message.
            at: time of publication (ns); None for now.
        """
        sequence = self._sequences[topic.name]
        self._sequences[topic.name] = sequence + 1
        self.ring.add(LogEntry(topic, self._clock.now() if at is None else at, stamp, sequence, payload))

    def trip(self, trip: Stop) -> str | None:
        """Register a trip of the gate.

        Returns:
            Name of the future box, which may contain other trips; None if this reason writes no box.
        """
        if trip.reason in self._config.unless:
            return None
        soon = trip.stamp + round(self._config.after * SECOND)
        pending = next((it for it in self._pending if it.reason is trip.reason or it.due <= soon), None)
        if pending is None:
            pending = _Pending(self._folder.next_name(trip.reason), trip.reason, max(soon, self._allowed(trip)))
            self._pending.append(pending)
        self._last[trip.reason] = pending.due
        pending.trips.append(trip)
        self._wake.set()
        return pending.name

    def _allowed(self, trip: Stop) -> int:
        """Return the earliest time for another box with this reason that would still contain the trip."""
        last = self._last.get(trip.reason)
        if last is None:
            return trip.stamp
        interval, before = (round(it * SECOND) for it in (self._config.interval, self._config.before))
        return min(last + interval, trip.stamp + before)

    async def _take(self) -> None:
        """Capture the content of each box when it is due, whatever the state of the disk."""
        while not self._closing:
            pending = min(self._pending, key=attrgetter("due"), default=None)
            if not await self._is_due(pending) or pending not in self._pending:
                continue
            self._pending.remove(pending)
            if self._taken.qsize() < 2:  # maximum number of boxes waiting for a slow disk, because they take memory
                self._taken.put_nowait((pending, self.ring.snapshot()))
            else:
                slow = TimeoutError(errno.ETIMEDOUT, "the disk is too slow")
                self._failed(slow, f"{pending.name} is lost")
        self._taken.put_nowait(None)

    async def _is_due(self, pending: _Pending | None) -> bool:
        """Wait until ``pending`` is due (True), or another trip arrives (False)."""
        self._wake.clear()
        if pending is None:
            return not await self._wake.wait()
        try:
            async with self._clock.deadline(max(0, pending.due - self._clock.now()) / SECOND):
                await self._wake.wait()
        except TimeoutError:
            return True
        return False

    async def _save_all(self) -> None:
        while (taken := await self._taken.get()) is not None:
            await self._save(*taken)

    async def _save(self, pending: _Pending, entries: RingSnapshot) -> None:
        first = pending.trips[0]
        offset = self._clock.real_offset()
        metadata = {
            **self._metadata,
            "real_offset_ns": str(offset),
            "stops": ",".join(str(trip.number) for trip in pending.trips),
            "stopped_at_ns": str(first.stamp),
            "reason": first.reason.value,
            "text": "; ".join(causes_text(trip.causes, trip.stamp) for trip in pending.trips),
            "lost": str(self.ring.lost),
        }
        if (run_log := self._log()) is not None:
            metadata[RUN_LOG] = str(run_log.absolute())
        try:
            dated = log_offset(first.stamp, offset)
            name = await self._offload(partial(self._write, pending.name, entries, metadata, dated))
        except OSError as error:
            self._failed(error, f"{pending.name} is lost")
        except Exception:
            log.exception("black box: bug")
            self._events(Reason.INTERNAL, Severity.ERROR, self.name, f"{pending.name} is lost: a bug, see the log")
        else:
            self._events(
                Reason.BLACK_BOX_SAVED,
                Severity.INFO,
                self.name,
                f"{pending.what} in {name}",
                file=name,
                stop=first.number,
                messages=len(entries),
            )

    def _failed(self, error: OSError, what: str) -> None:
        self._events(disk_reason(error), Severity.WARNING, self.name, f"{what}: {error.strerror or error}")

    def _write(self, name: str, entries: RingSnapshot, metadata: Mapping[str, str], offset: int) -> str:
        """Write a box in a thread, with pauses for the control loop unless the daemon ends; return its name."""
        offloaded = threading.get_ident() != self._loop_thread
        name = self._folder.begin(name)
        part = self._folder.part(name)
        start = next((entry.log_time for entry in entries), 0)
        try:
            # 64 * 1024: maximum number of bytes compressed at once
            file = LogFile(part, Compression.ZSTD, 64 * 1024, self._attachments, metadata, start, offset)
            try:
                for count, entry in enumerate(entries):
                    if self._given_up.is_set():
                        raise TimeoutError(errno.ETIMEDOUT, "given up")
                    if offloaded and count % BATCH == 0:
                        self._hurry.wait(0.001)  # seconds between two batches, for the control loop
                    file.add(entry)
                file.finish()
            except BaseException:
                file.abandon()
                raise
            self._folder.finish(name)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
        return name
