"""Sources of drive requests: authentication, leases and the choice of the driver.

Rules:

- A request is valid only with this run's nonce and a sequence number above the newest one of its source and kind.
- While the lease of a source runs, no other program takes over its name.
- A request that may set the truck in motion must carry the stamp of a recent gate state: it cannot have waited long in
  a queue then. The stamp is of the robot's own clock, so no other clock has to be trusted.
- Operators send from outside, the tracker from inside; a tracker on another machine only if the configuration names it.
- The source of the highest role with a valid lease drives; among equal roles the one that drives already, but of the
  robot's own planners one that requests motion before one that requests standstill.
- Control passes to a higher role at once, to a lower one only after a new ARM order: once a role has driven, or has
  ordered a stop, lower roles are refused until the truck is armed again. So a tracker never continues by itself after
  an operator has released the stick.
- After a STOP order every source must send a neutral request before it may drive again, until the truck is armed again;
  for one that was driving, none for its lease is as good. A source that is first heard after the stop is no exception.
- An ARM order with ``hold`` keeps planners out until one without.
"""

from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.requests import MAX_SOURCES, OPERATORS, Sequences, freshness
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, Order, Role
from monstertruckd.gate.config import GateConfig

PRIORITY: Final = {role: rank for rank, role in enumerate(reversed(Role))}
"""The greater number wins."""

DRIVERS: Final = OPERATORS | {Role.TRACKER}

STARTING: Final = frozenset({Order.ARM, Order.RESET})
"""Orders after which the truck may move: they must carry a recent gate stamp."""

Key = tuple[bool, str]


@dataclass(slots=True)
class Source:
    """Newest request of one source."""

    request: DriveRequest
    deadline: int
    """End of its lease, ns."""
    arrived: int
    """When the request came, ns."""
    inside: bool = False
    """One of the robot's own planners."""
    held: bool = False
    """Must send a neutral request before it may drive."""

    @property
    def key(self) -> Key:
        """Unique key: a source outside cannot act for a planner by taking its name."""
        return self.inside, self.request.source

    @property
    def neutral(self) -> bool:
        """Whether it requests standstill."""
        return self.request.neutral

    @property
    def requests_motion(self) -> bool:
        """Whether it is a planner that requests motion."""
        return self.inside and not self.neutral

    @property
    def rank(self) -> int:
        """Its priority."""
        return PRIORITY[self.request.role]


class Sources:
    """All requests of this run.

    Args:
        nonce: of this run; requests must carry it.
        config: leases, request age and remote trackers.
    """

    def __init__(self, nonce: str, config: GateConfig) -> None:
        self.nonce = nonce
        self._config = config
        self._planner_requests = Sequences()
        self._requests = Sequences(config.max_request_age)
        self._orders = Sequences(config.max_request_age)
        self._drive: dict[Key, Source] = {}
        self._min_rank = 0
        self._released: set[Key] | None = None
        """Sources that were heard at the STOP order or have been neutral since; None = there was none."""

    def accept_request(self, request: DriveRequest, now: int) -> Reason:
        """OK, or why a drive request from outside is refused."""
        if request.role not in OPERATORS and not (
            request.role is Role.TRACKER and request.source in self._config.remote_trackers
        ):
            return Reason.BAD_ROLE
        alive = {source.request.source: source.request for source in self.live(now) if not source.inside}
        if request.source in alive and alive[request.source].instance != request.instance:
            return Reason.BUSY
        reason = self._requests.accept(request, self.nonce, now, alive)
        return freshness(request, now, self._config.max_request_age) if reason is Reason.OK else reason

    def accept_planner_request(self, request: DriveRequest, now: int) -> Reason:
        """OK, or why a drive request of the robot's own planners is refused."""
        if request.role is not Role.TRACKER:
            return Reason.BAD_ROLE
        return self._planner_requests.accept(request, self.nonce, now)

    def accept_order(self, request: ControlRequest, now: int) -> Reason:
        """OK, or why an order is refused."""
        reason = self._orders.accept(request, self.nonce, now)
        if reason is Reason.OK and request.order in STARTING:
            reason = freshness(request, now, self._config.max_request_age)
        return reason

    def add(self, request: DriveRequest, now: int, *, inside: bool) -> Source:
        """Start or renew the lease of an accepted request."""
        lease = min(request.lease, self._config.leases.of(request.role))
        key = (inside, request.source)
        before = self._drive.get(key)
        source = Source(request, now + round(lease * SECOND), now, inside)
        if not source.neutral:
            source.held = self._unheard(key) or (before is not None and before.held and now <= before.deadline)
        elif self._released is not None and len(self._released) < MAX_SOURCES:
            self._released.add(key)
        self._drive = {other: it for other, it in self._drive.items() if now <= it.deadline}
        self._drive[key] = source
        return source

    def live(self, now: int) -> list[Source]:
        """Sources whose lease has not expired."""
        return [source for source in self._drive.values() if now <= source.deadline]

    def driver(self, now: int, holder: Key | None) -> Source | None:
        """The source that may drive now.

        Args:
            now: ns.
            holder: key of the driving source.
        """
        able = [source for source in self.live(now) if not source.held and source.rank >= self._min_rank]
        if len(able) == 1:
            return able[0]
        return max(able, key=lambda source: (source.rank, source.requests_motion, source.key == holder), default=None)

    def priority(self, source: Source, now: int, holder: Key | None) -> Reason:
        """OK if this source drives or would drive, or why not."""
        if source.held:
            return Reason.NOT_ARMED_SPEED
        driver = self.driver(now, holder)
        if driver is source:
            return Reason.OK
        if driver is not None and driver.rank == source.rank:
            return Reason.BUSY
        return Reason.LOWER_PRIORITY

    def motion_requested(self, now: int, roles: frozenset[Role] = DRIVERS) -> bool:
        """Whether any source of ``roles`` with a valid lease requests motion."""
        return any(source.request.role in roles and not source.neutral for source in self.live(now))

    def claim(self, role: Role) -> None:
        """``role`` has driven or stopped the truck: lower roles wait for the next ARM order."""
        self._min_rank = max(self._min_rank, PRIORITY[role])

    def hold(self) -> None:
        """Every source must send a neutral request before it may drive."""
        self._released = set(self._drive)
        for source in self._drive.values():
            source.held = True

    def _unheard(self, key: Key) -> bool:
        """Whether a source has neither been heard at the STOP order nor been neutral since."""
        return self._released is not None and key not in self._released

    def release(self, *, planners: bool) -> None:
        """End ``claim`` and ``hold``: the truck was armed again.

        Args:
            planners: may drive as well.
        """
        self._min_rank = 0 if planners else PRIORITY[Role.STATION]
        self._released = None
        for source in self._drive.values():
            source.held = False

    def waiting(self, now: int) -> tuple[str, ...]:
        """Names of the planners that request motion."""
        return tuple(
            source.request.source
            for source in self.live(now)
            if source.request.role is Role.TRACKER and not source.neutral
        )
