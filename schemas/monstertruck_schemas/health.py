"""Messages of the ``health`` group."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message, Nanoseconds, Schema
from monstertruck_schemas.reasons import Reason


class ServiceState(StrEnum):
    """Life of a supervised service."""

    STARTING = "starting"
    READY = "ready"
    BACKOFF = "backoff"
    FAILED = "failed"
    STOPPED = "stopped"


class ServiceHealth(Schema):
    """One row of the health table."""

    name: str
    state: ServiceState
    since: Nanoseconds
    restarts: Annotated[int, Field(ge=0)] = 0
    reason: Reason = Reason.OK
    detail: str = ""
    """Last error in words; empty when there was none."""


class HealthTable(Message):
    """Health of every service; published on change and once a second."""

    services: tuple[ServiceHealth, ...]


class LoopHealth(Message):
    """Punctuality of the control tick over the last second and since the start."""

    ticks: int
    lateness_p50: float
    """Seconds late against the 50 Hz schedule."""
    lateness_p99: float
    lateness_max: float
    drops: int = 0
    """Messages lost in bounded queues since the start."""


class RecorderHealth(Message):
    """What the recorder wrote."""

    recording: bool
    path: str | None = None
    bytes_written: int = 0
    messages: int = 0
    drops: int = 0
    reason: Reason = Reason.OK
