"""What the gate has to say, without saying the same twice a second."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Value
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

MAX_TOLD: Final = 64
"""Different events that are told within one interval: sources may invent any number of names."""


@dataclass(frozen=True, slots=True)
class GateEvent:
    """One decision, refusal or transition."""

    reason: Reason
    severity: Severity
    text: str
    values: dict[str, Value]


class EventLog:
    """Collects events between two ticks.

    Args:
        interval: least seconds between two events of one reason and source; those in between are counted.
    """

    def __init__(self, interval: float) -> None:
        self._interval = round(interval * SECOND)
        self._events: list[GateEvent] = []
        self._told: dict[tuple[Reason, str], tuple[int, int]] = {}

    def tell(
        self,
        now: int,
        reason: Reason,
        severity: Severity,
        text: str = "",
        values: Mapping[str, Value] | None = None,
        *,
        source: str = "",
        always: bool = False,
    ) -> None:
        """Report; repetitions within the interval only raise the next one's ``repeated``.

        Args:
            now: ns.
            reason: what happened.
            severity: how bad it is.
            text: in words; by default the reason's own.
            values: measurements behind it.
            source: program or person it is about.
            always: a transition: never left out.
        """
        key = (reason, source)
        if key not in self._told and len(self._told) >= MAX_TOLD:
            self._told = {other: told for other, told in self._told.items() if now - told[0] < self._interval}
            if len(self._told) >= MAX_TOLD and not always:
                return
        last, repeated = self._told.get(key, (now - self._interval, 0))
        if not always and now - last < self._interval:
            self._told[key] = (last, repeated + 1)
            return
        self._told[key] = (now, 0)
        told: dict[str, Value] = {**(values or {})}
        if source:
            told["by"] = source
        if repeated:
            told["repeated"] = repeated
        self._events.append(GateEvent(reason, severity, text or reason.text, told))

    def drain(self) -> tuple[GateEvent, ...]:
        """Events since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events
