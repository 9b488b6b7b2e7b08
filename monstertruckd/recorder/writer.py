"""What the recorder's thread does: chunks, rotation, quota. Synchronous; driven by log times alone."""

import logging
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from monstertruck_runtime.clock import SECOND
from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.file import Entry, LogFile, LogFolder
from monstertruckd.recorder.recover import in_use

log = logging.getLogger(__name__)


class LogWriter:
    """Writes entries into numbered files; a context manager that finishes the last one.

    Args:
        config: sizes, durations and folder.
        attachments: JSON-able values attached to every file, by name.
        metadata: text about the run, in every file.
        start: log time the first file starts at, ns.

    Raises:
        OSError: from every method: the disk is full or refuses.
    """

    def __init__(
        self, config: RecorderConfig, attachments: Mapping[str, Any], metadata: Mapping[str, str], start: int
    ) -> None:
        self._config = config
        self._attachments = attachments
        self._metadata = metadata
        self._folder = LogFolder(Path(config.directory))
        self._retained: dict[str, Entry] = {}
        """Newest of every retained topic: the head of the next file, so that each file stands alone."""
        self._file = self._open(start)
        self._synced = start

    @property
    def path(self) -> Path:
        """The file being written."""
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

    def write(self, entry: Entry) -> None:
        """Add one message; closes chunk and file when they are due."""
        self.tick(entry.log_time)
        age = entry.log_time - self._file.start
        if self._file.size >= self._config.rotate_bytes or age >= self._config.rotate_seconds * SECOND:
            self._file.finish()
            self._file = self._open(entry.log_time)
            self._synced = entry.log_time
            for kept in self._retained.values():
                self._file.add(kept._replace(log_time=entry.log_time))
        if entry.topic.retained:
            self._retained[entry.topic.name] = entry
        self._file.add(entry)

    def tick(self, now: int) -> None:
        """Close the chunk, sync the file and keep the quota if that is due at log time ``now``."""
        since = self._file.open_since
        if since is not None and now - since >= self._config.chunk_seconds * SECOND:
            self._file.flush()
        if now - self._synced >= self._config.fsync_seconds * SECOND:
            self._file.sync()
            self._synced = now
            self._keep_quota()

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
                )
            except FileExistsError:
                self._folder.next_run()
                continue
            log.info("recording to %s", path)
            self._others = self._folder.finished(path)
            self._file = file
            self._keep_quota()
            return file

    def _keep_quota(self) -> None:
        """Remove the oldest files that exceed the quota; never one that somebody is writing or repairing."""
        excess = self._file.size + sum(self._others.values()) - self._config.quota_bytes
        for path, size in list(self._others.items()):
            if excess <= 0:
                return
            if path.exists() and in_use(path):
                continue
            path.unlink(missing_ok=True)
            log.info("removed %s: logs exceed %d bytes", path, self._config.quota_bytes)
            del self._others[path]
            excess -= size
