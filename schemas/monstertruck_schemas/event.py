"""Messages of the ``event`` group: things that happened once."""

from enum import StrEnum

from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason


class Severity(StrEnum):
    """How much an operator should care."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Event(Message):
    """A decision, refusal, fault or recovery, with its stable reason."""

    reason: Reason
    severity: Severity
    source: str
    """Service or device it happened to."""
    text: str = ""
    values: dict[str, float | int | str | bool | None] = {}
    """Measurements behind the decision."""
