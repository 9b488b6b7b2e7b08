"""Who asks for what: authenticity of requests, leases and the choice of the driver.

Rules:

- A request counts only with this run's nonce and a sequence number above the newest one of its source and kind.
- What may set the truck in motion must show that its sender knew the gate's state of a moment ago: then it cannot have
  waited long in some queue. That is the robot's own clock, so no other one has to be trusted.
- Operators ask from outside, the tracker from inside; a tracker off board only if the configuration names it.
- The source of the highest role with a live lease drives; among equals the one that drives already, but of the robot's
  own planners one that asks for motion before one that keeps the truck standing.
- Control passes upwards at once, downwards only after a new ARM order: once a role has driven, or has ordered a
  stop, lower roles are refused until somebody arms the truck again. So a tracker never goes on by itself after an
  operator lets go.
- After a STOP order every source must show a neutral request, or fall silent, before it may drive again.
"""

from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.requests import OPERATORS, Sequences, freshness
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, Order, Role
from monstertruckd.gate.config import GateConfig

PRIORITY: Final = {role: rank for rank, role in enumerate(reversed(Role))}
"""Greater wins."""

DRIVERS: Final = OPERATORS | {Role.TRACKER}

SETTING_OFF: Final = frozenset({Order.ARM, Order.RESET})
"""Orders after which the truck may move: they must be recent."""

Key = tuple[bool, str]

NEUTRAL: Final = 1e-3
"""Requested speeds below this one are a stick at rest, m/s."""


@dataclass(slots=True)
class Source:
    """What one source asks for at present."""

    request: DriveRequest
    deadline: int
    """End of its lease, ns."""
    arrived: int
    """When the request came, ns."""
    inside: bool = False
    """It is one of the robot's own planners."""
    held: bool = False
    """Must show a neutral request before it may drive."""

    @property
    def key(self) -> Key:
        """What tells it from all others: nobody outside can speak for a planner by taking its name."""
        return self.inside, self.request.source

    @property
    def neutral(self) -> bool:
        """Whether its stick is at rest."""
        return abs(self.request.speed) < NEUTRAL

    @property
    def setting_off(self) -> bool:
        """Whether it is a planner that asks for motion."""
        return self.inside and not self.neutral

    @property
    def rank(self) -> int:
        """Its priority."""
        return PRIORITY[self.request.role]


class Sources:
    """All requests of this run.

    Args:
        nonce: what requests must carry.
        config: leases, ages and the trackers off board.
    """

    def __init__(self, nonce: str, config: GateConfig) -> None:
        self.nonce = nonce
        self._config = config
        self._planner_requests = Sequences()
        self._requests = Sequences()
        self._orders = Sequences()
        self._drive: dict[Key, Source] = {}
        self._floor = 0

    def admit_request(self, request: DriveRequest, now: int) -> Reason:
        """OK, or why a drive request from outside does not count."""
        if request.role not in OPERATORS and not (
            request.role is Role.TRACKER and request.source in self._config.remote_trackers
        ):
            return Reason.BAD_ROLE
        alive = {source.request.source for source in self.live(now) if not source.inside}
        reason = self._requests.accept(request, self.nonce, alive)
        return freshness(request, now, self._config.max_request_age) if reason is Reason.OK else reason

    def admit_planner_request(self, request: DriveRequest) -> Reason:
        """OK, or why a drive request of the robot's own planners does not count."""
        if request.role is not Role.TRACKER:
            return Reason.BAD_ROLE
        return self._planner_requests.accept(request, self.nonce)

    def admit_order(self, request: ControlRequest, now: int) -> Reason:
        """OK, or why an order does not count."""
        reason = self._orders.accept(request, self.nonce)
        if reason is Reason.OK and request.order in SETTING_OFF:
            reason = freshness(request, now, self._config.max_request_age)
        return reason

    def add(self, request: DriveRequest, now: int, *, inside: bool) -> Source:
        """Start or renew the lease of an admitted request."""
        lease = min(request.lease, self._config.leases.of(request.role))
        key = (inside, request.source)
        before = self._drive.get(key)
        source = Source(request, now + round(lease * SECOND), now, inside)
        source.held = before is not None and before.held and now <= before.deadline and not source.neutral
        self._drive = {other: it for other, it in self._drive.items() if now <= it.deadline}
        self._drive[key] = source
        return source

    def live(self, now: int) -> list[Source]:
        """Sources whose lease runs."""
        return [source for source in self._drive.values() if now <= source.deadline]

    def driver(self, now: int, holder: Key | None) -> Source | None:
        """The source that may drive now.

        Args:
            now: ns.
            holder: key of the one driving already.
        """
        able = [source for source in self.live(now) if not source.held and source.rank >= self._floor]
        if len(able) == 1:
            return able[0]
        return max(able, key=lambda source: (source.rank, source.setting_off, source.key == holder), default=None)

    def standing(self, source: Source, now: int, holder: Key | None) -> Reason:
        """OK if this source drives or would drive, else why not."""
        if source.held:
            return Reason.NOT_ARMED_SPEED
        driver = self.driver(now, holder)
        if driver is source:
            return Reason.OK
        if driver is not None and driver.rank == source.rank:
            return Reason.BUSY
        return Reason.LOWER_PRIORITY

    def pushing(self, now: int, roles: frozenset[Role] = DRIVERS) -> bool:
        """Whether any live source of ``roles`` asks for motion."""
        return any(source.request.role in roles and not source.neutral for source in self.live(now))

    def claim(self, role: Role) -> None:
        """This role has driven or stopped the truck: lower ones wait for the next ARM order."""
        self._floor = max(self._floor, PRIORITY[role])

    def hold(self) -> None:
        """Everybody has to show a neutral request first."""
        for source in self._drive.values():
            source.held = True

    def admit(self) -> None:
        """The truck was armed anew: everybody may ask again."""
        self._floor = 0
        for source in self._drive.values():
            source.held = False
