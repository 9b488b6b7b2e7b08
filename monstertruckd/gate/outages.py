"""What is behind a stop: devices, hubs and links that were lost before it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Cause, Event, Severity
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruckd.gate.watch import SENSOR_SERVICES

TOGETHER: Final = SECOND
"""A hub's loss is judged once all its devices are gone, and may be told this much before or after theirs, ns."""

ROOTS: Final = frozenset({Reason.HUB_LOST, Reason.OVER_CURRENT})
"""Events that explain the loss of every device they name in ``roles``."""

LINK: Final = "link"
"""Source of the events about the network link."""


@dataclass(slots=True)
class _Loss:
    """A service's newest outage."""

    first: ServiceHealth
    """Its first failure: later ones only say that the device is still away."""
    back: int | None = None


class Outages:
    """Remembers each service's newest outage and the events that explain outages."""

    def __init__(self) -> None:
        self._losses: dict[str, _Loss] = {}
        self._roots: dict[str, Event] = {}
        self._link: Event | None = None

    def observe_health(self, table: HealthTable) -> None:
        """Take the services' health."""
        for row in table.services:
            loss = self._losses.get(row.name)
            if row.state in (ServiceState.BACKOFF, ServiceState.FAILED):
                if loss is None or loss.back is not None:
                    self._losses[row.name] = _Loss(row)
            elif row.state is ServiceState.READY and loss is not None and loss.back is None:
                loss.back = row.since

    def observe_event(self, event: Event) -> None:
        """Take what happened anywhere in the daemon."""
        if event.source == LINK:
            self._link = event if event.severity is not Severity.INFO else None
        if event.reason in ROOTS:
            for role in str(event.values.get("roles") or "").split(","):
                self._roots[role] = event

    def explain(self, heads: Sequence[Cause]) -> tuple[Cause, ...]:
        """The given causes, each pointing to what was behind it; causes shared by several come once."""
        causes = list(heads)
        found: dict[tuple[Reason, str, int], int] = {}
        for index, head in enumerate(heads):
            above = index
            for cause in self._behind(head):
                key = (cause.reason, cause.source, cause.since)
                known = key in found
                if not known:
                    found[key] = len(causes)
                    causes.append(cause)
                causes[above] = causes[above].model_copy(update={"because": found[key]})
                if known:
                    break
                above = found[key]
        return tuple(causes)

    def _behind(self, head: Cause) -> Iterator[Cause]:
        """Causes behind ``head``, each behind the one before it."""
        services = [name for name, stale in SENSOR_SERVICES.items() if stale is head.reason] or [head.source]
        losses = (loss for name in services if (loss := self._losses.get(name)) is not None)
        loss = next((loss for loss in losses if loss.back is None or head.since <= loss.back), None)
        if loss is not None:
            row = loss.first
            detail = row.detail or row.reason.text
            text = detail if row.name in detail else f"{row.name}: {detail}"
            yield Cause(reason=row.reason, source=row.name, since=row.since, text=text)
            root = self._roots.get(row.name)
            if root is not None and root.stamp >= row.since - TOGETHER:
                yield _told(root)
        elif head.reason is Reason.LEASE_EXPIRED and self._link is not None:
            yield _told(self._link)


def _told(event: Event) -> Cause:
    return Cause(reason=event.reason, source=event.source, since=event.stamp, text=event.text or event.reason.text)
