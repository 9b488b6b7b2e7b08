"""Messages of the ``event`` group: things that happened once."""

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message, Nanoseconds, Schema
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import GateMode


class Severity(StrEnum):
    """How much an operator should care."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Event(Message):
    """A decision, refusal, fault or recovery, with its stable reason."""

    reason: Reason
    """Reason code."""
    severity: Severity
    """Severity."""
    source: str
    """Service or device it happened to."""
    text: str = ""
    """Event in words."""
    values: dict[str, float | int | str | bool | None] = {}
    """Measurements behind the decision."""


class Call(Message):
    """A remote call that was answered: who asked for what, and the answer."""

    name: str
    """Name of the call, e.g. ``goal``."""
    source: str
    """Who called, by the key."""
    payload: str
    """JSON object, cut after ``CALL_TEXT`` characters."""
    reason: Reason
    """``ok``, or why it was refused."""
    answer: str
    """JSON object, or the text of the refusal; cut to the same length."""


CALL_TEXT = 4096
"""Characters of a call's payload and of its answer that are recorded: a hundred waypoints."""


class Measurement(Schema):
    """One figure behind a stop."""

    name: str
    """Name of the quantity."""
    value: float | None = None
    """None if never measured, or out of range."""
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
    """Device, service, program or person it happened to or came from."""
    since: Nanoseconds
    """When it began."""
    text: str
    """Cause in words."""
    measurements: tuple[Measurement, ...] = ()
    because: Annotated[int, Field(ge=0)] | None = None
    """Index of the cause behind this one; None if unknown."""


class Stop(Message):
    """Cause of a stop by the gate: the tripped checks with start and measurements, and the causes behind them.

    ``stamp`` is the moment of the stop. A cause behind it that becomes known a little later (a lost hub is judged once
    all its devices are gone) is added by a second message of the same ``number``.
    """

    number: Annotated[int, Field(ge=1)]
    """Counts the stops since the daemon started."""
    reason: Reason
    """Reason of the first cause."""
    mode: GateMode
    """State of the gate after it."""
    ordered: bool = False
    """An operator ordered an ordinary end of driving."""
    quick: bool = False
    """Whether it was the drive's quick stop instead of its ordinary ramp."""
    holder: str | None = None
    """Source that was driving."""
    role: Role | None = None
    """Role of the holder."""
    speed: float | None = None
    """Measured speed at its start (m/s); None if unknown."""
    stopping_distance: float = 0.0
    """Metres the truck was still expected to travel."""
    causes: Annotated[tuple[Cause, ...], Field(min_length=1)]
    """Tripped checks, worst first, then the causes behind them."""
    black_box: str | None = None
    """Name of the black-box file that will hold the minute before; None if none is written."""
    text: str
    """All of it in one line."""


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
    """Logger: the module it came from."""
    text: str
    """Message."""
    file: str = ""
    """Source file."""
    line: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Line in the source file."""
