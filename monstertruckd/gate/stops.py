"""The gate's stops, numbered, each with the chain of causes as far as it is known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.stops import sentence, span
from monstertruck_schemas.event import Cause
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.outages import Outages

EXPLAINED_WITHIN: Final = 3 * SECOND
"""So long after a stop news may still show what was behind it, ns."""


@dataclass(frozen=True, slots=True)
class Trip:
    """One stop; the fields of ``Stop``."""

    number: int
    at: int
    mode: GateMode
    causes: tuple[Cause, ...]
    ordered: bool
    quick: bool
    holder: str | None
    role: Role | None
    speed: float | None
    stopping_distance: float

    @property
    def reason(self) -> Reason:
        """That of its first cause."""
        return self.causes[0].reason


class StopBook:
    """Collects stops between two ticks, and what is found out about the newest one afterwards.

    Args:
        outages: what is behind causes.
    """

    def __init__(self, outages: Outages) -> None:
        self._outages = outages
        self._count = 0
        self._heads: tuple[Cause, ...] = ()
        self._newest: Trip | None = None
        self._untold: list[Trip] = []

    def add(
        self,
        now: int,
        mode: GateMode,
        heads: Sequence[Cause],
        *,
        ordered: bool,
        quick: bool,
        driver: DriveRequest | None,
        speed: float | None,
        stopping_distance: float,
    ) -> None:
        """Note a stop.

        Args:
            now: ns.
            mode: the gate's state from now on.
            heads: what tripped it, worst first.
            ordered: it was an ordinary order.
            quick: by quick stop.
            driver: newest request of whoever drove.
            speed: measured, m/s; None = not known.
            stopping_distance: still to be expected, m.
        """
        self._count += 1
        self._heads = tuple(heads)
        self._newest = Trip(
            number=self._count,
            at=now,
            mode=mode,
            causes=self._outages.explain(heads),
            ordered=ordered,
            quick=quick,
            holder=None if driver is None else driver.source,
            role=None if driver is None else driver.role,
            speed=speed,
            stopping_distance=stopping_distance,
        )
        self._untold.append(self._newest)

    def words(self, now: int) -> str:
        """The newest stop in one line; empty before the first one."""
        newest = self._newest
        if newest is None:
            return ""
        return f"stopped {span((now - newest.at) / SECOND)} ago: {sentence(newest.causes, newest.at)}"

    def drain(self, now: int) -> tuple[Trip, ...]:
        """Stops since the last call, and the newest one again if more is known of it by now."""
        newest = self._newest
        if newest is not None and not self._untold and now - newest.at <= EXPLAINED_WITHIN:
            causes = self._outages.explain(self._heads)
            if causes != newest.causes:
                self._newest = replace(newest, causes=causes)
                return (self._newest,)
        told = tuple(self._untold)
        self._untold.clear()
        return told
