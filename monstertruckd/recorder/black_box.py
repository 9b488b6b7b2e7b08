"""The black box: the minute before every trip of the gate, and a few seconds after it, as one MCAP file."""

import asyncio
import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import EventSink
from monstertruck_runtime.stops import sentence
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import TOPICS, Topic
from monstertruckd.gate.stops import Trip
from monstertruckd.recorder.boxes import BoxFolder
from monstertruckd.recorder.config import BlackBoxConfig, Compression
from monstertruckd.recorder.file import Entry, LogFile, disk_reason
from monstertruckd.recorder.ring import Ring, Snapshot, Span

log = logging.getLogger(__name__)

BATCH: Final = 8
"""Messages written without a pause: a fraction of a millisecond in which the control loop would have to wait."""
PAUSE: Final = 0.001
"""Seconds between two batches, for the control loop."""
CHUNK: Final = 64 * 1024
"""Bytes compressed at once; more takes longer."""


@dataclass(slots=True)
class _Pending:
    """A box that will be written once its time has come."""

    name: str
    due: int
    trips: list[Trip] = field(default_factory=list)


class BlackBox:
    """Keeps the newest messages in memory and writes them when the gate trips; runs while its ``async with`` body does.

    A box that is due when the body ends is written before the context is left. A disk that is full or refuses costs
    the box, is told, and nothing else happens.

    Args:
        config: spans and limits.
        directory: where the boxes go.
        clock: daemon time.
        events: told of every box that was saved or lost.
        attachments: JSON-able values in every box, as ``<name>.json``.
        metadata: text about the run, in every box.
        offload: where boxes are written.
    """

    name = "blackbox"

    def __init__(
        self,
        config: BlackBoxConfig,
        directory: Path,
        clock: Clock,
        events: EventSink,
        *,
        attachments: Mapping[str, Any],
        metadata: Mapping[str, str],
        offload: Offload = in_thread,
    ) -> None:
        self._config = config
        self._clock = clock
        self._events = events
        self._attachments = attachments
        self._metadata = metadata
        self._offload = offload
        self._folder = BoxFolder(directory, config.quota_bytes)
        window = config.before + config.after
        self.ring = Ring(
            Span(window, max(window, config.journal), config.pictures + config.after, config.picture_period),
            config.memory_bytes,
        )
        self._sequences = {topic.name: 0 for topic in TOPICS}
        self._written: dict[Reason, int] = {}
        """When the gate last tripped for a box of this reason."""
        self._pending: _Pending | None = None
        self._wake = asyncio.Event()
        self._closing = asyncio.Event()
        self._hurry = threading.Event()

    async def __aenter__(self) -> Self:
        try:
            await self._offload(self._folder.look)
        except OSError as error:
            self._failed(error, "no black boxes yet")
        self._serving = asyncio.create_task(self._serve(), name=self.name)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closing.set()
        self._wake.set()
        self._hurry.set()
        await asyncio.shield(self._serving)

    def record(self, topic: Topic[Any], stamp: int, payload: bytes) -> None:
        """Remember one encoded message.

        Args:
            topic: its row of the table.
            stamp: the message's own stamp, ns.
            payload: its bytes on the wire.
        """
        sequence = self._sequences[topic.name]
        self._sequences[topic.name] = sequence + 1
        self.ring.add(Entry(topic, self._clock.now(), stamp, sequence, payload))

    def trip(self, trip: Trip) -> str | None:
        """Note a trip of the gate.

        Returns:
            The name its box will have, which a trip shares with one shortly before it; None if there will be none:
            for this reason boxes are not wanted, or there was one a moment ago.
        """
        if trip.reason in self._config.unless:
            return None
        if self._pending is None:
            last = self._written.get(trip.reason)
            if last is not None and trip.at - last < self._config.interval * SECOND:
                return None
            self._pending = _Pending(self._folder.next_name(trip.reason), trip.at + round(self._config.after * SECOND))
        self._written[trip.reason] = trip.at
        self._pending.trips.append(trip)
        self._wake.set()
        return self._pending.name

    async def _serve(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            if self._pending is not None:
                await self._until(self._pending.due)
                due, self._pending = self._pending, None
                await self._save(due)
            if self._closing.is_set():
                return

    async def _until(self, due: int) -> None:
        """Wait for that instant, or for the end."""
        try:
            async with self._clock.deadline(max(0, due - self._clock.now()) / SECOND):
                await self._closing.wait()
        except TimeoutError:
            return

    async def _save(self, pending: _Pending) -> None:
        entries = self.ring.snapshot()
        first = pending.trips[0]
        metadata = {
            **self._metadata,
            "real_offset_ns": str(self._clock.real_offset()),
            "stops": ",".join(str(trip.number) for trip in pending.trips),
            "stopped_at_ns": str(first.at),
            "reason": first.reason.value,
            "text": "; ".join(sentence(trip.causes, trip.at) for trip in pending.trips),
            "lost": str(self.ring.lost),
        }
        try:
            await self._offload(partial(self._write, pending.name, entries, metadata))
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
                f"the minute before stop {first.number} is in {pending.name}",
                file=pending.name,
                stop=first.number,
                messages=len(entries),
            )

    def _failed(self, error: OSError, what: str) -> None:
        self._events(disk_reason(error), Severity.WARNING, self.name, f"{what}: {error.strerror or error}")

    def _write(self, name: str, entries: Snapshot, metadata: Mapping[str, str]) -> None:
        """In a thread, with pauses for the control loop, unless the daemon waits for it to end."""
        part = self._folder.begin(name)
        start = next((entry.log_time for entry in entries), 0)
        try:
            file = LogFile(part, Compression.ZSTD, CHUNK, self._attachments, metadata, start)
            try:
                for count, entry in enumerate(entries):
                    if count % BATCH == 0:
                        self._hurry.wait(PAUSE)
                    file.add(entry)
                file.finish()
            except BaseException:
                file.abandon()
                raise
            self._folder.finish(name)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
