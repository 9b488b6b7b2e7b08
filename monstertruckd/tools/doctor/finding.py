"""One thing the doctor looked at."""

from enum import StrEnum

from monstertruck_schemas.base import Schema
from monstertruck_schemas.reasons import Reason


class Level(StrEnum):
    """How bad it is."""

    OK = "ok"
    WARN = "warn"
    """The truck drives, but not as well as it could, or not for ever."""
    FAIL = "fail"
    """The truck does not drive, or is not safe."""


class Finding(Schema):
    """What was looked at, what was seen, and how to mend it."""

    check: str
    level: Level
    reason: Reason = Reason.OK
    seen: str
    mend: str | None = None
    """Command to type; None if there is nothing to mend, or no command can."""


def fine(check: str, seen: str, mend: str | None = None) -> Finding:
    """All is well; ``mend`` may tell how to see more."""
    return Finding(check=check, level=Level.OK, seen=seen, mend=mend)


def warn(check: str, reason: Reason, seen: str, mend: str | None = None) -> Finding:
    """It works, but."""
    return Finding(check=check, level=Level.WARN, reason=reason, seen=seen, mend=mend)


def fail(check: str, reason: Reason, seen: str, mend: str | None = None) -> Finding:
    """It does not work."""
    return Finding(check=check, level=Level.FAIL, reason=reason, seen=seen, mend=mend)


def verdict(findings: list[Finding]) -> Reason:
    """Reason of the first failure; OK if there is none."""
    return next((finding.reason for finding in findings if finding.level is Level.FAIL), Reason.OK)
