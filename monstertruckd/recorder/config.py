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
    """Where and how the log is written."""

    directory: str = "logs"
    """Folder of the log files; made when missing."""
    compression: Compression = Compression.LZ4
    chunk_size: Bytes = 256 * 1024
    """Bytes after which a chunk is closed."""
    chunk_seconds: Annotated[float, Field(gt=0, le=0.5)] = 0.5
    """Seconds after which a chunk is closed: what a crash can lose, and half as much again."""
    rotate_bytes: Bytes = 512 * 1024 * 1024
    """Size after which the next file is begun."""
    rotate_seconds: Seconds = 1800.0
    """Duration after which the next file is begun."""
    quota_bytes: Bytes = 8 * 1024 * 1024 * 1024
    """Size of all logs in the folder above which the oldest are removed."""
    fsync_seconds: Seconds = 5.0
    """Seconds between two fsync, which is what a power cut can lose."""
    queue_size: Annotated[int, Field(gt=0)] = 8192
    """Messages waiting for the disk before newer ones are dropped and counted."""


class BlackBoxConfig(Schema):
    """The minute before every trip of the gate, kept in memory until then."""

    directory: str | None = None
    """Folder of the boxes; null = ``blackbox`` in the recorder's folder, and none at all without a recorder."""
    before: Seconds = 60.0
    """Seconds before the trip."""
    after: Seconds = 5.0
    """Seconds after it; trips meanwhile share the box."""
    journal: Seconds = 60.0
    """Seconds of events and log records, where those are to reach further back than the rest."""
    pictures: Seconds = 5.0
    """Seconds before the trip of which all pictures are kept."""
    picture_period: Seconds = 0.5
    """Seconds between two pictures that are kept of the time before."""
    memory_bytes: Annotated[int, Field(ge=1024 * 1024)] = 24 * 1024 * 1024
    """Bytes all that may take; beyond, the oldest pictures go first, then the oldest of the rest."""
    quota_bytes: Bytes = 512 * 1024 * 1024
    """Size of all boxes in the folder above which the oldest are removed; the newest of each reason stays."""
    interval: Annotated[float, Field(ge=0)] = 60.0
    """Least seconds between two boxes of one reason; a trip meanwhile waits for it, at most ``before``."""
    unless: Annotated[tuple[Reason, ...], Field(strict=False)] = (Reason.STOPPED, Reason.DISARMED)
    """Reasons without a box: by default what an operator ordered."""


class MapRender(Schema):
    """The picture of path over scan map that the worker draws."""

    latency: Annotated[float, Field(gt=0, le=5)] = 0.2
    """Seconds after which its results count on the virtual clock"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Seconds after which a silent worker is killed"""
    period: Annotated[float, Field(ge=0.1, le=60)] = 0.5
    """Seconds between two scans it is given"""
    max_tilt: Annotated[float, Field(gt=0, le=math.pi / 2)] = math.radians(3)
    """Scans whose plane was tilted more than this are left out, rad: over 5 m they are 0.26 m off"""
    picture: Path | None = None
    """PNG file drawn whenever a path has come to its end"""
