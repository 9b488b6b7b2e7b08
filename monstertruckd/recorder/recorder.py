"""Recorder: accepts encoded messages on the event loop; its thread writes and rotates files and enforces the quota."""

import asyncio
import hashlib
import logging
import queue
import struct
import subprocess
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import disk_reason
from monstertruck_schemas.health import RecorderHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import TOPICS, Topic
from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.log_file import DAMAGED_NAME, LogEntry, LogFile, LogFolder, log_offset
from monstertruckd.recorder.repair import in_use, repairs, start_repair

_DIGEST_FRAME = struct.Struct("<qII")


class LogDigest:
    """SHA-256 over (key, stamp, payload) of every logged message, in order."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def update(self, key: str, stamp: int, payload: bytes) -> None:
        """Add a message; the digest includes lengths, so shifted message borders change it."""
        name = key.encode()
        self._hash.update(_DIGEST_FRAME.pack(stamp, len(name), len(payload)) + name + payload)

    def hexdigest(self) -> str:
        """Return the digest of all messages so far, as 64 hexadecimal digits."""
        return self._hash.hexdigest()


log = logging.getLogger(__name__)


_STEP: Final = SECOND
"""Difference between the dates of a file and of the computer that shows a clock step, not drift (ns)."""


class LogWriter:
    """Writes entries to numbered files; a context manager that finishes the last file.

    All log times in a file use one offset; when the computer's clock is set, a new file begins. A new file also begins
    if the file was removed, which is detected at the next sync.

    Args:
        config: sizes, durations and folder.
        attachments: JSON-serialisable values attached to every file, by name.
        metadata: text about the run, in every file.
        start: daemon time at the start of the first file (ns).
        real_offset: real (UNIX) time minus daemon time (ns).

    Raises:
        OSError: from every method: the disk is full or fails.
    """

    def __init__(
        self,
        config: RecorderConfig,
        attachments: Mapping[str, Any],
        metadata: Mapping[str, str],
        start: int,
        real_offset: int = 0,
    ) -> None:
        self._config = config
        self._attachments = attachments
        self._metadata = metadata
        self.real_offset = real_offset
        """Real (UNIX) minus daemon time (ns); updated by the owner."""
        self._folder = LogFolder(Path(config.directory))
        self._reported: set[Path] = set()
        """Files that could not be removed."""
        self._retained: dict[str, LogEntry] = {}
        """Latest message of every retained topic; written first to the next file, so each file is self-contained."""
        self._removed = False
        """Whether the current file was removed."""
        self._file = self._open(start)
        self._synced = start

    @property
    def path(self) -> Path:
        """Path of the file being written."""
        return self._file.path

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            self._file.finish()
        else:
            self._file.abandon()

    def write(self, entry: LogEntry) -> None:
        """Add a message; close the chunk and the file when due."""
        self.tick(entry.log_time)
        if self._is_complete(entry.log_time):
            self._file.finish()
            self._file = self._open(entry.log_time)
            self._synced = entry.log_time
            for kept in self._retained.values():
                self._file.add(kept._replace(log_time=entry.log_time))
        if entry.topic.retained:
            self._retained[entry.topic.name] = entry
        self._file.add(entry)

    def tick(self, now: int) -> None:
        """Close the chunk, sync the file and enforce the quota if due at log time ``now``."""
        since = self._file.open_since
        if since is not None and now - since >= self._config.chunk_seconds * SECOND:
            self._file.flush()
        if now - self._synced >= self._config.fsync_seconds * SECOND:
            self._file.sync()
            self._synced = now
            self._keep_quota()
            if self._file.removed and not self._removed:
                self._removed = True
                log.warning("%s was removed while it was being written: its content is lost", self.path)

    def _is_complete(self, now: int) -> bool:
        """Return whether a new file is due because of removal, size or age, or because the computer's clock was set."""
        age = now - self._file.start
        if self._removed or self._file.size >= self._config.rotate_bytes or age >= self._config.rotate_seconds * SECOND:
            return True
        # 10 * SECOND: minimum age of a file before a clock step ends it, so that a clock set repeatedly does not
        # cause a flood of files
        return age >= 10 * SECOND and abs(log_offset(now, self.real_offset) - self._file.offset) > _STEP

    def _open(self, start: int) -> LogFile:
        while True:
            path = self._folder.next_path()
            try:
                file = LogFile(
                    path,
                    self._config.compression,
                    self._config.chunk_size,
                    self._attachments,
                    self._metadata,
                    start,
                    log_offset(start, self.real_offset),
                )
            except FileExistsError:
                self._folder.next_run()
                continue
            log.info("recording to %s", path)
            self._others = self._folder.finished(path)
            self._file, self._removed = file, False
            self._keep_quota()
            return file

    def _keep_quota(self) -> None:
        """Remove the oldest files beyond the quota, except files being written or repaired.

        A file that cannot be removed stays in the total and is reported once; the recording continues.
        """
        excess = self._file.size + sum(self._others.values()) - self._config.quota_bytes
        for path, size in list(self._others.items()):
            if excess <= 0:
                return
            try:
                if in_use(path):
                    continue
                path.unlink()
            except FileNotFoundError:
                pass
            except OSError as error:
                if path not in self._reported:
                    self._reported.add(path)
                    log.warning("%s cannot be removed although logs exceed the quota: %s", path, error.strerror)
                continue
            else:
                what = "the damaged original of a repaired log" if DAMAGED_NAME.search(path.name) else "the oldest log"
                log.warning("removed %s, %s: logs exceed %d bytes", path, what, self._config.quota_bytes)
            del self._others[path]
            excess -= size


FailureSink = Callable[[Reason, str], None]
RepairSink = Callable[[str], None]


class Recorder:
    """Records while its ``async with`` body runs; finishes the log at the end.

    If the disk is full or fails, the recording ends: ``on_failure`` is called once and later messages are counted as
    drops. No exception is raised, because driving continues. Meanwhile a separate process repairs the unfinished logs
    in the folder.

    Args:
        config: recorder settings.
        clock: daemon time of the messages.
        on_failure: called on the event loop with the reason and one line of text.
        attachments: JSON-serialisable values attached to every file as ``<name>.json`` (config, calibration, versions).
        metadata: text about the run, in every file.
        digest: updated in the thread with every recorded message.
        deterministic: for the virtual clock: ``record`` waits for the disk instead of dropping, chunks are closed
            by log time only, and ``health`` contains no file name, so that two runs with one seed record the same.
        on_repair: called on the event loop with the outcome of every repair of an unfinished log, as text.
    """

    name = ServiceName.RECORDER.value

    def __init__(
        self,
        config: RecorderConfig,
        clock: Clock,
        on_failure: FailureSink,
        *,
        attachments: Mapping[str, Any] | None = None,
        metadata: Mapping[str, str] | None = None,
        digest: LogDigest | None = None,
        deterministic: bool = False,
        on_repair: RepairSink | None = None,
    ) -> None:
        self._on_repair = on_repair
        self._config = config
        self._clock = clock
        self._on_failure = on_failure
        self._attachments = dict(attachments or {})
        self._metadata = dict(metadata or {})
        self._digest = digest
        self._deterministic = deterministic
        self._batch: list[LogEntry] = []
        self._queue: queue.SimpleQueue[tuple[int, list[LogEntry]] | None] = queue.SimpleQueue()
        """Batches, each with the real-time offset at its hand-over."""
        self._written = 0
        """Number of written messages; modified only by the thread."""
        self._progress = threading.Event()
        self._sequences = {topic.name: 0 for topic in TOPICS}
        self._recording = False
        self._ended = False
        self._refusal: OSError | None = None
        self._reason = Reason.OK
        self._path: Path | None = None
        self._messages = self._bytes = self._drops = 0

    @property
    def path(self) -> Path | None:
        """File being written; None before the first file is open."""
        return self._path

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._done = self._loop.create_future()
        self._recording = True
        now, offset = self._clock.now(), self._clock.real_offset()
        self._metadata.setdefault("real_offset_ns", str(offset))
        threading.Thread(target=self._run, args=(now, offset), name="recorder", daemon=True).start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._recording = False
        self._hand_over()
        self._queue.put(None)
        await asyncio.shield(self._done)

    def record(self, topic: Topic[Any], stamp: int, payload: bytes, at: int | None = None) -> None:
        """Record an encoded message without waiting for the disk, except in deterministic runs.

        Args:
            topic: entry of the topic table; topics that are not logged are ignored.
            stamp: stamp of the message (ns).
            payload: encoded message.
            at: time of publication (ns); None for now.
        """
        if not topic.logged:
            return
        sequence = self._sequences[topic.name]
        self._sequences[topic.name] = sequence + 1
        if self._deterministic and self._full:
            self._wait_for_room()
        if not self._recording or self._full:
            self._drops += 1
            return
        self._messages += 1
        self._bytes += len(payload)
        if not self._batch and not self._deterministic:
            # 0.05: time (s) until a batch is handed over even if it is not full
            self._loop.call_later(0.05, self._hand_over)
        self._batch.append(LogEntry(topic, self._clock.now() if at is None else at, stamp, sequence, payload))
        # 256: messages per hand-over to the thread; each hand-over makes both threads wait for the interpreter
        if len(self._batch) >= 256:
            self._hand_over()

    def refuse(self, error: OSError) -> None:
        """Make every later write fail with ``error``, for fault drills."""
        self._refusal = error

    def health(self, seq: int) -> RecorderHealth:
        """Return the state of the recording; counts are messages and payload bytes passed to the writer."""
        now = self._clock.now()
        return RecorderHealth(
            stamp=now,
            received=now,
            seq=seq,
            recording=self._recording,
            path=None if self._path is None or self._deterministic else str(self._path),
            bytes_written=self._bytes,
            messages=self._messages,
            drops=self._drops,
            reason=self._reason,
        )

    @property
    def _full(self) -> bool:
        return self._messages - self._written >= self._config.queue_size

    def _wait_for_room(self) -> None:
        self._hand_over()
        while True:
            self._progress.clear()
            if not (self._recording and self._full):
                return
            self._progress.wait()

    def _hand_over(self) -> None:
        if self._batch:
            self._queue.put((self._clock.real_offset(), self._batch))
            self._batch = []

    def _run(self, start: int, offset: int) -> None:
        """Write the log; runs in the thread."""
        repair: subprocess.Popen[bytes] | None = None
        try:
            try:
                with LogWriter(self._config, self._attachments, self._metadata, start, offset) as writer:
                    self._path = writer.path
                    repair = self._start_repair()
                    self._write(writer)
            except OSError as error:
                self._fail(disk_reason(error), f"recording stopped: {error}")
            except Exception as error:
                log.exception("recorder: bug")
                self._fail(Reason.INTERNAL, f"recording stopped: {error!r}")
        finally:
            if repair is not None:
                repair.terminate()
                repair.wait()
                self._reporting.join()
            self._loop.call_soon_threadsafe(self._done.set_result, None)

    def _start_repair(self) -> "subprocess.Popen[bytes] | None":
        try:
            process = start_repair(Path(self._config.directory))
        except OSError as error:
            log.warning("unfinished logs are not repaired: %s", error)
            return None
        if process is not None:
            self._reporting = threading.Thread(target=self._report, args=(process,), name="repairs", daemon=True)
            self._reporting.start()
        return process

    def _report(self, process: "subprocess.Popen[bytes]") -> None:
        """Forward the outcomes of a repair to the event loop; runs in a thread."""
        with suppress(RuntimeError):  # the loop has ended
            for outcome in repairs(process):
                if self._on_repair is not None:
                    self._loop.call_soon_threadsafe(self._on_repair, outcome)

    def _write(self, writer: LogWriter) -> None:
        for topic in TOPICS:
            wire.schema(topic)  # cache the schema before the first chunk is due
        wait = None if self._deterministic else self._config.chunk_seconds / 2
        while True:
            try:
                taken = self._queue.get(timeout=wait)
            except queue.Empty:
                writer.tick(self._clock.now())
                continue
            if taken is None:
                self._ended = True
                return
            writer.real_offset, batch = taken
            for entry in batch:
                if self._refusal is not None:
                    raise self._refusal
                if self._digest is not None:
                    self._digest.update(entry.topic.name, entry.stamp, entry.payload)
                writer.write(entry)
            self._written += len(batch)
            self._progress.set()
            self._path = writer.path

    def _fail(self, reason: Reason, text: str) -> None:
        self._recording = False
        self._reason = reason
        self._loop.call_soon_threadsafe(self._on_failure, reason, text)
        self._progress.set()  # no more room will come: wake a waiting record()
        while not self._ended:
            self._ended = self._queue.get() is None
