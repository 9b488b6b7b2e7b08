"""Stop log: numbered stops, their causes with measurements, and the lost devices behind the causes."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.stop_text import causes_text, duration_text
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Event, Measurement, Severity, Stop
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.arbitration import Source
from monstertruckd.gate.samples import STALE_SENSORS

HUB_WINDOW: Final = SECOND
"""Maximum time between the losses of a hub and of its devices, ns; its loss is reported once all devices are gone."""

HUB_EVENTS: Final = frozenset({Reason.HUB_LOST, Reason.OVER_CURRENT})
"""Events that explain the loss of every device listed in their ``roles``."""


def lease_cause(source: Source, now: int) -> Cause:
    """Stop cause for the expired lease of ``source``."""
    request = source.request
    figures = [
        Measurement(
            name="request age",
            value=(now - source.arrived) / SECOND,
            unit="s",
            limit=(source.deadline - source.arrived) / SECOND,
        )
    ]
    if not source.inside and request.gate_stamp is not None:
        # From the gate state known to the sender to the arrival of the request: both directions and the sender's delay.
        figures.append(Measurement(name="round trip", value=(source.arrived - request.gate_stamp) / SECOND, unit="s"))
    return Cause(
        reason=Reason.LEASE_EXPIRED,
        source=request.source,
        since=min(source.deadline, now),
        text=f"lease of {request.source} expired",
        measurements=tuple(figures),
    )


@dataclass(slots=True)
class _Outage:
    """Latest outage of a service."""

    first: ServiceHealth
    """First failure; later failures only repeat that the device is still absent."""
    end: int | None = None
    """Time when the service was ready again, ns."""


class Outages:
    """Latest outage of each service, and the events that explain outages: lost devices, hubs and links.

    Args:
        services: reason given by the loss of each sensor service, by service name.
    """

    def __init__(self, services: Mapping[str, Reason]) -> None:
        self._services = services
        self._outages: dict[str, _Outage] = {}
        self._hubs: dict[str, Event] = {}
        self._link: Event | None = None

    def observe(self, message: Message) -> None:
        """Process a health table, or an event of any service."""
        if isinstance(message, HealthTable):
            self._observe_health(message)
        elif isinstance(message, Event):
            self._observe_event(message)

    def _observe_health(self, table: HealthTable) -> None:
        for service in table.services:
            outage = self._outages.get(service.name)
            if service.state in (ServiceState.BACKOFF, ServiceState.FAILED):
                if outage is None or outage.end is not None:
                    self._outages[service.name] = _Outage(service)
            elif service.state is ServiceState.READY and outage is not None and outage.end is None:
                outage.end = service.since

    def _observe_event(self, event: Event) -> None:
        if event.source == DeviceRole.LINK:
            self._link = event if event.severity is not Severity.INFO else None
        if event.reason in HUB_EVENTS:
            for role in str(event.values.get("roles", "")).split(","):
                self._hubs[role] = event

    def explain(self, causes: Sequence[Cause], over: Mapping[Reason, int] = MappingProxyType({})) -> tuple[Cause, ...]:
        """Link each cause to the cause behind it; a shared cause is listed once.

        Args:
            causes: causes of a stop.
            over: time when a sensor was fresh again, ns; a later outage does not explain its silence.
        """
        chain = list(causes)
        found: dict[tuple[Reason, str, int], int] = {}
        for index, cause in enumerate(causes):
            effect = index
            for deeper in self._behind(cause, over.get(cause.reason)):
                key = (deeper.reason, deeper.source, deeper.since)
                known = key in found
                if not known:
                    found[key] = len(chain)
                    chain.append(deeper)
                chain[effect] = chain[effect].model_copy(update={"because": found[key]})
                if known:
                    break
                effect = found[key]
        return tuple(chain)

    def _behind(self, cause: Cause, over: int | None) -> Iterator[Cause]:
        """Chain of causes behind ``cause``: each is behind the previous one."""
        services = [name for name, stale in self._services.items() if stale is cause.reason] or [cause.source]
        outages = (outage for name in services if (outage := self._outages.get(name)) is not None)
        outage = next((outage for outage in outages if outage.end is None or cause.since <= outage.end), None)
        if outage is not None and (over is None or outage.first.since <= over):
            service = outage.first
            detail = service.detail or service.reason.text
            text = detail if service.name in detail else f"{service.name}: {detail}"
            yield Cause(reason=service.reason, source=service.name, since=service.since, text=text)
            hub = self._hubs.get(service.name)
            if hub is not None and hub.stamp >= service.since - HUB_WINDOW:
                yield _cause_of(hub)
        elif cause.reason is Reason.LEASE_EXPIRED and self._link is not None:
            yield _cause_of(self._link)


def _cause_of(event: Event) -> Cause:
    return Cause(reason=event.reason, source=event.source, since=event.stamp, text=event.text or event.reason.text)


class StopLog:
    """Collects stops between two ticks, and adds causes of the latest stop that become known later.

    Args:
        outages: outages that explain causes.
    """

    def __init__(self, outages: Outages) -> None:
        self._outages = outages
        self._count = 0
        self._causes: tuple[Cause, ...] = ()
        """Causes of the latest stop, before ``Outages.explain``."""
        self._over: dict[Reason, int] = {}
        """Time when each sensor whose silence caused the stop was fresh again, ns."""
        self._newest: Stop | None = None
        self._pending: list[Stop] = []

    def add(
        self,
        now: int,
        mode: GateMode,
        causes: Sequence[Cause],
        *,
        ordered: bool,
        quick: bool,
        driver: DriveRequest | None,
        speed: float | None,
        stopping_distance: float,
    ) -> None:
        """Add a stop.

        Args:
            now: current time (ns).
            mode: next mode of the gate.
            causes: causes of the stop, worst first.
            ordered: whether an ordinary order caused the stop.
            quick: whether the drives stop by quick stop.
            driver: latest request of the driving source.
            speed: measured speed, m/s; None if unknown.
            stopping_distance: expected stopping distance (m).
        """
        self._count += 1
        self._causes, self._over = tuple(causes), {}
        explained = self._outages.explain(causes)
        self._newest = Stop(
            stamp=now,
            received=now,
            seq=0,
            number=self._count,
            reason=explained[0].reason,
            mode=mode,
            causes=explained,
            ordered=ordered,
            quick=quick,
            holder=None if driver is None else driver.source,
            role=None if driver is None else driver.role,
            speed=speed,
            stopping_distance=stopping_distance,
            text=_text(explained, now),
        )
        self._pending.append(self._newest)

    def summary(self, now: int) -> str:
        """One line about the latest stop; empty before the first stop."""
        newest = self._newest
        if newest is None:
            return ""
        return f"stopped {duration_text((now - newest.stamp) / SECOND)} ago: {causes_text(newest.causes, newest.stamp)}"

    def drain(self, now: int, present: Collection[Reason]) -> tuple[Stop, ...]:
        """Return the stops since the last call, or the latest stop again if more of its causes are known; ``seq`` is 0.

        Args:
            now: ns.
            present: reasons that limit or stop the truck now.
        """
        newest = self._newest
        for cause in self._causes:
            if cause.reason in STALE_SENSORS and cause.reason not in present:
                self._over.setdefault(cause.reason, now)
        explained_within = 3 * SECOND  # period after a stop while reports may still add causes, ns
        if newest is not None and not self._pending and now - newest.stamp <= explained_within:
            causes = self._outages.explain(self._causes, self._over)
            if causes != newest.causes:
                known = {"reason": causes[0].reason, "causes": causes, "text": _text(causes, newest.stamp)}
                self._newest = newest.model_copy(update=known)
                return (self._newest,)
        stops = tuple(self._pending)
        self._pending.clear()
        return stops


def _text(causes: Sequence[Cause], now: int) -> str:
    return f"stopped: {causes_text(causes, now)}"
