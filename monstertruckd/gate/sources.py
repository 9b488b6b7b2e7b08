"""Who asks for what: authenticity of requests, leases and the choice of the driver.

Rules:

- A request counts only with this run's nonce and a sequence number above the newest one of its source and kind.
- The source of the highest role with a live lease drives; among equals the one that drives already.
- Control passes upwards at once, downwards only after a new ARM order: once a role has driven, or has ordered a
  stop, lower roles are refused until somebody arms the truck again. So a tracker never goes on by itself after an
  operator lets go.
- After a STOP order every source must show a neutral request, or fall silent, before it may drive again.
"""

from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Request, Role
from monstertruckd.gate.config import Leases

PRIORITY: Final = {role: rank for rank, role in enumerate(reversed(Role))}
"""Greater wins."""

OPERATORS: Final = frozenset({Role.GAMEPAD, Role.KEYBOARD, Role.STATION})
"""Roles with a human behind them: may arm and reset."""

DRIVERS: Final = OPERATORS | {Role.TRACKER}

MAX_SOURCES: Final = 64
"""Names remembered per run; more are refused, so that junk can neither fill the memory nor forget a sequence."""

NEUTRAL: Final = 1e-3
"""Requested speeds below this one are a stick at rest, m/s."""


@dataclass(slots=True)
class Source:
    """What one source asks for at present."""

    request: DriveRequest
    deadline: int
    """End of its lease, ns."""
    held: bool = False
    """Must show a neutral request before it may drive."""

    @property
    def neutral(self) -> bool:
        """Whether its stick is at rest."""
        return abs(self.request.speed) < NEUTRAL

    @property
    def rank(self) -> int:
        """Its priority."""
        return PRIORITY[self.request.role]


class Sources:
    """All requests of this run.

    Args:
        nonce: what requests must carry.
        leases: longest lease of each role.
    """

    def __init__(self, nonce: str, leases: Leases) -> None:
        self.nonce = nonce
        self._leases = leases
        self._sequences: dict[tuple[type[Request], str], int] = {}
        self._drive: dict[str, Source] = {}
        self._floor = 0

    def authenticate(self, request: Request) -> Reason:
        """OK, or why the request does not belong to this run; an accepted sequence number is used up."""
        if request.nonce != self.nonce:
            return Reason.BAD_NONCE
        key = (type(request), request.source)
        if request.seq <= self._sequences.get(key, -1):
            return Reason.BAD_SEQUENCE
        if key not in self._sequences and len(self._sequences) >= MAX_SOURCES:
            return Reason.BUSY
        self._sequences[key] = request.seq
        return Reason.OK

    def add(self, request: DriveRequest, now: int) -> Source:
        """Start or renew the lease of an authentic request of a driving role."""
        lease = min(request.lease, self._leases.of(request.role))
        before = self._drive.get(request.source)
        source = Source(request, now + round(lease * SECOND))
        source.held = before is not None and before.held and now <= before.deadline and not source.neutral
        self._drive[request.source] = source
        return source

    def live(self, now: int) -> list[Source]:
        """Sources whose lease runs."""
        return [source for source in self._drive.values() if now <= source.deadline]

    def driver(self, now: int, holder: str | None) -> Source | None:
        """The source that may drive now.

        Args:
            now: ns.
            holder: name of the one driving already.
        """
        able = [source for source in self.live(now) if not source.held and source.rank >= self._floor]
        return max(able, key=lambda source: (source.rank, source.request.source == holder), default=None)

    def standing(self, source: Source, now: int, holder: str | None) -> Reason:
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
