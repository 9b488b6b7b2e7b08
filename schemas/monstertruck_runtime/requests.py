"""External requests: parsing, authentication by nonce, sequence, freshness and role; and clients that send orders.

The gate and the planners check requests by the same rules, whether sent by topic or by remote call.
"""

import json
import math
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping
from typing import Any, Final, Protocol, TypeVar

from pydantic import ValidationError

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_runtime.ports import RpcRegistry
from monstertruck_schemas.base import Message, first_mistake
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder, DriveRequest, Order, Request, Role
from monstertruck_schemas.state import GateState
from monstertruck_schemas.topics import Topic, owner_of

M = TypeVar("M", bound=Message)
R = TypeVar("R", bound=Request)

OPERATORS: Final = frozenset({Role.HAND, Role.GAMEPAD, Role.KEYBOARD, Role.STATION})
"""Roles of human operators, who may arm and reset."""

MAX_SOURCES: Final = 64
"""Maximum number of sources for each kind of request; a new one replaces the least recent one."""

MAX_PROGRAMS: Final = 16
"""Maximum number of sources per owner, because a client can invent program names."""


class Operator(Protocol):
    """Client of one robot that sends orders."""

    source: str

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Subscribe to a topic."""

    async def call(self, rpc: str, payload: dict[str, Any] | None = None) -> dict[str, Any]:
        """Call ``rpc`` with a JSON object; return its answer."""

    async def header(self, lease: float = 1.0) -> dict[str, Any]:
        """Header of the next request, as plain data."""

    def order(self, order: Order, *, hold: bool = False, calibrates: bool = False) -> Coroutine[Any, Any, GateState]:
        """Send an order and wait until it is carried out; return the resulting gate state.

        Args:
            order: order to send.
            hold: with an order to arm: planners do not drive until the truck is armed without it.
            calibrates: with an order to arm: see ``ControlRequest``.

        Raises:
            RequestRefusedError: refused; carries the reason.
            NoAnswerError: no answer in time.
            NotFoundError: no such robot.
        """

    async def arm(self, *, hold: bool = False, calibrates: bool = False) -> GateState:
        """Allow driving, with ``hold`` except by planners; answered once armed. Raises the errors of ``order``."""
        return await self.order(Order.ARM, hold=hold, calibrates=calibrates)

    async def disarm(self) -> GateState:
        """Stop and forbid driving; answered once disarmed. Raises the errors of ``order``."""
        return await self.order(Order.DISARM)

    async def estop(self) -> GateState:
        """Emergency stop, latched; answered once latched. Raises the errors of ``order``."""
        return await self.order(Order.ESTOP)

    async def reset(self) -> GateState:
        """Clear the emergency stop; answered once disarmed. Raises the errors of ``order``."""
        return await self.order(Order.RESET)

    async def stop(self) -> GateState:
        """Stop driving by the ordinary ramp; answered once at rest. Raises the errors of ``order``."""
        return await self.order(Order.STOP)

    async def drive_shafts(self, *rates: float, lease: float = 0.3) -> None:
        """Request the wheel rate of every driven shaft, rad/s, for ``lease`` seconds."""

    async def behave(
        self,
        order: BehaviourOrder,
        behaviour: str = "",
        settings: Mapping[str, Any] | None = None,
        *,
        own: bool = False,
    ) -> dict[str, Any]:
        """Start a configured behaviour, or stop it; return its ``number``. ``plan/behaviour`` publishes the progress.

        Args:
            order: start or stop.
            behaviour: name of the behaviour.
            settings: settings that replace the configured ones for this run.
            own: with a stop: only a behaviour started by this client.

        Raises:
            RequestRefusedError: it does not start, or none is running; carries the reason.
            InputError: a setting is invalid.
            NotFoundError: no such robot or behaviour.
            NoAnswerError: no answer in time.
        """
        request = {"order": order, "behaviour": behaviour, "own": own}
        request |= {"settings": dict(settings)} if settings else {}
        return await self.call("behave", {**await self.header(), **request})


def parse_request(model: type[R], payload: dict[str, Any]) -> R:
    """Parse the request in a remote call.

    Args:
        model: model of the request.
        payload: JSON object.

    Raises:
        RequestRefusedError: a number is not finite.
        InputError: the request is invalid; the text names the first invalid field.
    """
    try:
        return model.model_validate_json(json.dumps(payload), extra="ignore")  # a newer client may send more fields
    except ValidationError as error:
        text = first_mistake(error)
        if error.errors(include_url=False)[0]["type"] == "finite_number":
            raise RequestRefusedError(Reason.NOT_FINITE, text) from None
        raise InputError(text) from None


def register_numbered(
    rpc: RpcRegistry,
    name: str,
    model: type[R],
    take: Callable[[R], int],
    kept: Callable[[], Awaitable[object]] | None = None,
) -> None:
    """Serve ``name``, whose payload is a ``model``; the answer is the ``number`` returned by ``take``.

    Args:
        rpc: registry of remote calls.
        name: name of the call.
        model: model of its payload.
        take: carries out the request.
        kept: returns once the request survives a power cut; the call is answered then. None if nothing is saved.
    """

    async def call(payload: dict[str, Any]) -> dict[str, Any]:
        number = take(parse_request(model, payload))
        if kept is not None:
            await kept()
        return {"number": number}

    rpc.register(name, call)


class Sequences:
    """Latest sequence number of each source for one kind of request.

    A number is remembered only while an older request could still arrive; after that the request's gate stamp is too
    old. So a number of 2^62 sent under another source's name does not block that source permanently.

    Args:
        max_age: maximum age of a request's gate stamp, s.
    """

    def __init__(self, max_age: float = math.inf) -> None:
        self._memory = max(max_age, 2.0) * SECOND  # minimum seconds that a sequence number is remembered
        self._newest: dict[str, tuple[int, int]] = {}
        """Number, and time of its acceptance, ns."""

    def accept(self, request: Request, nonce: str, now: int, keep: Collection[str] = ()) -> Reason:
        """Return OK, or why the request does not belong to this run; an accepted sequence number is not accepted again.

        Args:
            request: request to check.
            nonce: required nonce.
            now: ns.
            keep: sources with a valid lease. They are not dropped (if they use all places, a new one is refused), and
                their numbers may not jump.
        """
        source = request.source
        if request.nonce != nonce:
            return Reason.BAD_NONCE
        newest, at = self._newest.get(source, (-1, 0))
        if request.seq <= newest and now - at <= self._memory:
            return Reason.BAD_SEQUENCE
        # 2**32: maximum step of a source's numbers during its lease, which may be nanoseconds
        if source in keep and source in self._newest and abs(request.seq - newest) > 2**32:
            return Reason.BUSY
        if source not in self._newest and (crowd := crowded(self._newest, source)):
            oldest = next((name for name in crowd if name not in keep), None)
            if oldest is None:
                return Reason.BUSY
            del self._newest[oldest]
        self._newest.pop(source, None)
        self._newest[source] = request.seq, now
        return Reason.OK


def crowded(known: Collection[str], source: str) -> Collection[str]:
    """Sources that may be dropped for a new one, in the order of ``known``; empty if there is room.

    Args:
        known: names of sources.
        source: new source.
    """
    programs = [name for name in known if owner_of(name) == owner_of(source)]
    if len(programs) >= MAX_PROGRAMS:
        return programs
    return known if len(known) >= MAX_SOURCES else ()


def freshness(request: Request, now: int, limit: float) -> Reason:
    """Return OK, or LEASE_EXPIRED for a request whose gate stamp is missing or older than ``limit`` s."""
    known = request.gate_stamp
    return Reason.OK if known is not None and 0 <= now - known <= limit * SECOND else Reason.LEASE_EXPIRED


def late_text(limit: float) -> str:
    """Message for a request that ``freshness`` refuses."""
    return f"the request came more than {limit:g} s after its sender had heard the gate: the link or a computer is slow"


def planner_request(seq: int, gate: GateState, now: int, source: str, lease: float, **motion: Any) -> DriveRequest:
    """Create a planner's drive request to the gate with the latest state ``gate``.

    Args:
        seq: sequence number of the publisher.
        gate: state whose nonce and stamp authenticate the request.
        now: ns.
        source: name of the planner.
        lease: lease, s.
        motion: fields of the request that describe the motion.
    """
    return DriveRequest(
        stamp=now,
        received=now,
        seq=seq,
        source=source,
        role=Role.TRACKER,
        lease=lease,
        nonce=gate.nonce,
        gate_stamp=gate.stamp,
        **motion,
    )


def inner_request(seq: int, gate: GateState | None, now: int, source: str) -> dict[str, Any]:
    """Header of a request from one service of the robot to another, in place of an operator.

    Args:
        seq: increases from request to request.
        gate: latest state of the gate.
        now: ns.
        source: name of the service.
    """
    return {
        "stamp": now,
        "received": now,
        "seq": seq,
        "source": source,
        "role": Role.STATION,
        "lease": 1.0,
        "nonce": "" if gate is None else gate.nonce,
        "gate_stamp": None if gate is None else gate.stamp,
    }


def examine(request: Request, gate: GateState | None, sequences: Sequences, now: int, max_age: float | None) -> None:
    """Refuse a request to the planners that violates the rules of driving.

    Args:
        request: request to check.
        gate: latest state of the gate.
        sequences: sequences of this kind of request.
        now: ns.
        max_age: maximum age of its gate stamp, s; None for a request that moves nothing.

    Raises:
        RequestRefusedError: the sender lacks the permission, or the request is too old.
    """
    reason = Reason.BAD_NONCE if gate is None else sequences.accept(request, gate.nonce, now)
    if reason is Reason.OK and max_age is not None:
        reason = freshness(request, now, max_age)
    if reason is Reason.OK and request.role not in OPERATORS:
        reason = Reason.BAD_ROLE
    if reason is Reason.LEASE_EXPIRED and max_age is not None:
        raise RequestRefusedError(reason, late_text(max_age))
    if reason is not Reason.OK:
        raise RequestRefusedError(reason)


def does_not_drive(gate: GateState | None) -> RequestRefusedError:
    """Refusal of a request for motion while the robot is not armed: main reason and message."""
    if gate is None:
        return RequestRefusedError(Reason.DISARMED, f"the robot does not drive: {Reason.DISARMED.text}")
    return RequestRefusedError(gate.worst, f"the robot does not drive: {gate.why}")
