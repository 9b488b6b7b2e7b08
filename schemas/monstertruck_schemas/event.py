"""Messages of the ``event`` group: single occurrences."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message, Nanoseconds, Schema
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import GateMode


class Severity(StrEnum):
    """Importance for an operator."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Event(Message):
    """A decision, refusal, fault or recovery, with its reason code."""

    reason: Reason
    """Reason code."""
    severity: Severity
    """Severity."""
    source: str
    """Service or device concerned."""
    text: str = ""
    """Event in words."""
    values: dict[str, float | int | str | bool | None] = {}
    """Measurements behind the event."""


class Call(Message):
    """A remote call and its answer: caller, name and result."""

    name: str
    """Name of the call, e.g. ``goal``."""
    source: str
    """Caller, from the key."""
    payload: str
    """JSON object, truncated to ``CALL_TEXT`` characters."""
    reason: Reason
    """``ok``, or the reason for the refusal."""
    answer: str
    """JSON object, or the text of the refusal; truncated to the same length."""


CALL_TEXT = 4096
"""Maximum recorded length of a call's payload and answer, characters: a hundred waypoints."""


class Measurement(Schema):
    """One measurement behind a stop."""

    name: str
    """Name of the quantity."""
    value: float | None = None
    """Value; None if never measured, or out of range."""
    unit: str = ""
    """SI unit; empty for plain numbers."""
    limit: float | None = None
    """Threshold, in the same unit."""
    age: float | None = None
    """Seconds from the measurement to the stop."""


class Cause(Schema):
    """One link of the chain that led to a stop."""

    reason: Reason
    """Reason code."""
    source: str
    """Device, service, program or person concerned."""
    since: Nanoseconds
    """Time when it began."""
    text: str
    """Cause in words."""
    measurements: tuple[Measurement, ...] = ()
    because: Annotated[int, Field(ge=0)] | None = None
    """Index of the cause behind this one; None if unknown."""


class Stop(Message):
    """Cause of a stop by the gate: the tripped checks with start and measurements, and their own causes.

    ``stamp`` is the time of the stop. If a cause becomes known later (a hub is reported lost only once all its devices
    are gone), a second message with the same ``number`` adds it.
    """

    number: Annotated[int, Field(ge=1)]
    """Number of the stop since the daemon started."""
    reason: Reason
    """Reason of the first cause."""
    mode: GateMode
    """State of the gate after the stop."""
    ordered: bool = False
    """Whether an operator ordered it as a normal end of driving."""
    quick: bool = False
    """Whether it was the drive's quick stop instead of its ordinary ramp."""
    holder: str | None = None
    """Source that was driving."""
    role: Role | None = None
    """Role of the holder."""
    speed: float | None = None
    """Measured speed at its start (m/s); None if unknown."""
    stopping_distance: float = 0.0
    """Expected stopping distance at its start, m."""
    causes: Annotated[tuple[Cause, ...], Field(min_length=1)]
    """Tripped checks, worst first, then the causes behind them."""
    black_box: str | None = None
    """Name of the black-box file with the minute before the stop; None if none is written."""
    text: str
    """Description of all causes in one line."""


class LogLevel(StrEnum):
    """Levels of the journal."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    FATAL = "fatal"


class LogRecord(Message):
    """One line of the daemon's journal."""

    level: LogLevel
    """Level of the record."""
    name: str
    """Name of the logger: its module."""
    text: str
    """Message."""
    file: str = ""
    """Source file."""
    line: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Line in the source file."""
