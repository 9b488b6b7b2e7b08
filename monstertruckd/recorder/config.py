"""Recorder settings."""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason

Seconds = Annotated[float, Field(gt=0)]
Bytes = Annotated[int, Field(gt=0)]


class Compression(StrEnum):
    """Compression of the log's chunks."""

    NONE = "none"
    LZ4 = "lz4"
    ZSTD = "zstd"


class RecorderConfig(Schema):
    """Log files."""

    directory: str = "logs"
    """Folder of the log files; created if missing."""
    compression: Compression = Compression.LZ4
    """Compression of the chunks."""
    chunk_size: Bytes = 256 * 1024
    """Maximum chunk size (bytes)."""
    chunk_seconds: Annotated[float, Field(gt=0, le=0.5)] = 0.5
    """Maximum chunk duration (s); a crash can lose 1.5 times this."""
    rotate_bytes: Bytes = 512 * 1024 * 1024
    """Maximum file size (bytes); beyond, a new file is started."""
    rotate_seconds: Seconds = 1800.0
    """Maximum file duration (s); beyond, a new file is started."""
    quota_bytes: Bytes = 8 * 1024 * 1024 * 1024
    """Maximum total size of the logs in the folder (bytes); beyond, the oldest are removed."""
    fsync_seconds: Seconds = 5.0
    """Fsync interval (s); a power cut can lose this much."""
    queue_size: Annotated[int, Field(gt=0)] = 8192
    """Maximum number of messages waiting for the disk; further ones are dropped and counted."""


class BlackBoxConfig(Schema):
    """Black box: the minute before every gate trip, kept in memory until then."""

    directory: str | None = None
    """Folder of the boxes; null: ``blackbox`` in the recorder's folder, or no boxes without a recorder."""
    before: Seconds = 60.0
    """Recorded time before the trip (s)."""
    after: Seconds = 5.0
    """Recorded time after the trip (s); further trips within it share the box."""
    journal: Seconds = 60.0
    """Retention of events and log records (s), if longer than for other messages."""
    pictures: Seconds = 5.0
    """Time before the trip with all pictures kept (s)."""
    picture_period: Seconds = 0.5
    """Interval between the older pictures that are kept (s)."""
    memory_bytes: Annotated[int, Field(ge=1024 * 1024)] = 24 * 1024 * 1024
    """Memory limit (bytes); beyond, the oldest pictures are dropped first, then the oldest other messages."""
    quota_bytes: Bytes = 512 * 1024 * 1024
    """Maximum total size of the boxes (bytes); the oldest are removed, except the latest of each reason."""
    interval: Annotated[float, Field(ge=0)] = 60.0
    """Minimum interval between boxes of one reason (s); an earlier trip waits for it, at most ``before``."""
    unless: Annotated[tuple[Reason, ...], Field(strict=False)] = (Reason.STOPPED, Reason.DISARMED)
    """Reasons that write no box; by default an ordered stop and an ordered disarm."""


class MapRender(Schema):
    """Picture of the path over a scan map, drawn by a worker."""

    latency: Annotated[float, Field(gt=0, le=5)] = 0.2
    """Latency of its results on the virtual clock (s)"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Timeout of a silent worker (s), which is then killed"""
    period: Annotated[float, Field(ge=0.1, le=60)] = 0.5
    """Interval between the scans passed to the worker (s)"""
    max_tilt: Annotated[float, Field(gt=0, le=math.pi / 2)] = math.radians(3)
    """Maximum tilt of a scan (rad); scans beyond it are skipped. The default is an error of 0.26 m at 5 m"""
    picture: Path | None = None
    """PNG file, drawn whenever a path has ended"""
