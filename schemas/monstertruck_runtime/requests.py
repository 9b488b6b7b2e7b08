"""Whether a request from outside counts: nonce, sequence, freshness and role. The gate and the planners ask alike."""

from collections.abc import Collection
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Request, Role
from monstertruck_schemas.state import GateState

OPERATORS: Final = frozenset({Role.GAMEPAD, Role.KEYBOARD, Role.STATION})
"""Roles with a human behind them: may arm and reset."""

MAX_SOURCES: Final = 64
"""Names remembered for each kind of request; the one heard least recently is forgotten for a new one."""


class Sequences:
    """Newest sequence number of each source of one kind of requests."""

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}

    def accept(self, request: Request, nonce: str, keep: Collection[str] = ()) -> Reason:
        """OK, or why the request does not belong to this run; an accepted sequence number is used up.

        Args:
            request: what was asked.
            nonce: what it must carry.
            keep: sources that must not be forgotten; with all places taken by them a new one is refused.
        """
        source = request.source
        if request.nonce != nonce:
            return Reason.BAD_NONCE
        if request.seq <= self._newest.get(source, -1):
            return Reason.BAD_SEQUENCE
        if source not in self._newest and len(self._newest) >= MAX_SOURCES:
            oldest = next((name for name in self._newest if name not in keep), None)
            if oldest is None:
                return Reason.BUSY
            del self._newest[oldest]
        self._newest.pop(source, None)
        self._newest[source] = request.seq
        return Reason.OK


def freshness(request: Request, now: int, limit: float) -> Reason:
    """OK, or LEASE_EXPIRED for a request whose sender's newest gate state is older than ``limit`` s, or not told."""
    known = request.gate_stamp
    return Reason.OK if known is not None and 0 <= now - known <= limit * SECOND else Reason.LEASE_EXPIRED


def refusal(request: Request, gate: GateState | None, sequences: Sequences, now: int, max_age: float | None) -> Reason:
    """OK, or why a request to the planners does not count: the authority is that of driving.

    Args:
        request: what was asked.
        gate: newest state of the gate.
        sequences: of this kind of requests.
        now: ns.
        max_age: greatest age of what its sender knew of the gate, s; None for what sets nothing in motion.
    """
    reason = Reason.BAD_NONCE if gate is None else sequences.accept(request, gate.nonce)
    if reason is Reason.OK and max_age is not None:
        reason = freshness(request, now, max_age)
    if reason is Reason.OK and request.role not in OPERATORS:
        reason = Reason.BAD_ROLE
    return reason
