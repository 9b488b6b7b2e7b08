"""ROS 2 nodes as operators of the robot, each under its own name.

ROS 2 has neither leases nor priorities nor nonces: a plain forwarder would bypass the protections of the gate.
So every node is a separate source with its own session. This module refuses messages that may be old, repeated or from
an unknown publisher; the gate judges the others like the requests of any operator.
"""

import asyncio
import re
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import dataclass
from typing import Any, Final

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import BusyError, InputError, TruckError
from monstertruckd.ros2.cdr import RosMessage
from monstertruckd.ros2.node import RosArrival, RosSender

LEASE: Final = 0.25
"""Validity of a drive message (s); the bridge never repeats it."""

RosOrder = Callable[[TruckClient], Awaitable[Any]]
"""Sends a request to the robot."""


def source_of(node: str, owner: str | None = None) -> str:
    """Return the source name of a node, such as ``ros2:teleop``, after the owner of the certificate if there is one.

    Args:
        node: qualified name.
        owner: common name of the certificate; the robot binds source names to it.
    """
    name = re.sub(r"[^A-Za-z0-9_.-]", ".", node.strip("/")) or "node"
    before = "ros2" if owner is None else f"{owner}:ros2"
    return f"{before}:{name}"[:64]  # 64: maximum length of a source name


def stamp_of(time: RosMessage) -> int:
    """Return a ``builtin_interfaces/msg/Time`` in nanoseconds."""
    return int(time["sec"]) * SECOND + int(time["nanosec"])


def _require_recent(what: str, stamp: int, now: int) -> None:
    difference = (now - stamp) / SECOND
    max_age = 0.5  # maximum difference between a stamp and this clock (s): the gate's limit for the age of a request
    if abs(difference) > max_age:
        side = "behind" if difference > 0.0 else "ahead of"
        raise InputError(
            f"{what} is {abs(difference):.1f} s {side} this clock (at most {max_age} s): an old message, "
            "or clocks that differ; run NTP on both computers"
        )


def check_arrival(arrival: RosArrival, now: int, newest: dict[bytes, int]) -> None:
    """Accept a message that is neither old nor a repetition.

    Args:
        arrival: message of a known publisher.
        now: real time (ns).
        newest: latest sequence numbers by publisher; updated with the message.

    Raises:
        InputError: the message is old or repeated.
    """
    _require_recent("its time of sending", arrival.stamp, now)
    before = newest.get(arrival.publisher)
    if before is not None and arrival.sequence <= before:
        raise InputError(f"sequence number {arrival.sequence} after {before}: repeated or out of order")
    newest[arrival.publisher] = arrival.sequence


def check_age(what: str, header: RosMessage, now: int) -> None:
    """Check the stamp of a header; 0 means no stamp.

    Args:
        what: name of the message in the refusal.
        header: ``std_msgs/msg/Header``.
        now: real time (ns).

    Raises:
        InputError: the stamp is old or in the future.
    """
    if stamp := stamp_of(header["stamp"]):
        _require_recent(what, stamp, now)


def frame_in(header: RosMessage, frames: tuple[str, ...]) -> str:
    """Return the frame of a header; empty if it has none.

    Raises:
        InputError: the frame is not one of ``frames``.
    """
    frame = str(header["frame_id"]).lstrip("/")
    if frame not in ("", *frames):
        raise InputError(f"frame {frame!r}: expected {' or '.join(frames)}")
    return frame


def check_header(header: RosMessage, now: int, frames: tuple[str, ...]) -> None:
    """Check the header of a message that drives; raises the same errors as ``check_age`` and ``frame_in``."""
    check_age("its header's stamp", header, now)
    frame_in(header, frames)


def planar_twist(twist: RosMessage) -> tuple[float, float, float]:
    """Return the velocities forward and to the left (m/s) and the turn rate (rad/s).

    Non-finite numbers are forwarded to the gate, which refuses them with its own reason.

    Raises:
        InputError: another component is not 0.
    """
    linear, angular = twist["linear"], twist["angular"]
    others = {"linear.z": linear["z"], "angular.x": angular["x"], "angular.y": angular["y"]}
    if wrong := [name for name, value in others.items() if value != 0.0]:
        raise InputError(f"{', '.join(wrong)}: expected 0, the robot moves in a plane")
    return linear["x"], linear["y"], angular["z"]


@dataclass(slots=True)
class RosOperator:
    """One node with its session on the robot."""

    client: TruckClient
    exit: AsyncExitStack
    waiting: RosOrder | None = None
    """Latest drive request that has not been sent yet."""
    task: asyncio.Task[None] | None = None


class Operators:
    """Sessions of the nodes that send requests.

    Args:
        connect: creates the client of a source.
        owner: owner of this program's certificate; None without one.
        clock: time.
        report: called with the node and the text of every refusal.
    """

    def __init__(
        self,
        connect: Callable[[str], TruckClient],
        owner: str | None,
        clock: Clock,
        report: Callable[[str, str], None],
    ) -> None:
        self._connect = connect
        self._owner = owner
        self._clock = clock
        self._report = report
        self._operators: dict[RosSender, RosOperator] = {}
        self._opening: dict[RosSender, asyncio.Task[RosOperator]] = {}
        self._sequences: dict[RosSender, dict[bytes, int]] = {}
        """Latest sequence number of every publisher."""
        self._asking: set[asyncio.Task[None]] = set()
        self.refused = 0
        """Number of messages and requests refused here."""
        self.last_refusal = ""

    @property
    def sources(self) -> list[str]:
        """Sources of the connected nodes."""
        return [operator.client.source for operator in self._operators.values()]

    def refuse(self, node: str, what: str, why: str) -> None:
        """Count and report a refusal."""
        self.refused += 1
        self.last_refusal = f"{what} of {node} refused: {why}"
        self._report(node, self.last_refusal)

    def accepted(self, what: str, arrival: RosArrival, check: Callable[[int], None]) -> RosSender | None:
        """Return the sender of an accepted message; None after a reported refusal.

        Args:
            what: name of the topic.
            arrival: the message.
            check: checks the content at a real time (ns); raises ``InputError``.
        """
        sender = arrival.sender
        if sender is None:
            self.refuse("an unknown publisher", what, "the graph has no publisher of this topic with its identity")
            return None
        now = self._clock.now() + self._clock.real_offset()
        try:
            check_arrival(arrival, now, self._sequences.setdefault(sender, {}))
            check(now)
        except InputError as error:
            self.refuse(sender.node, what, str(error))
            return None
        return sender

    def drive(self, sender: RosSender, what: str, order: RosOrder) -> None:
        """Send a node's drive request; if several are waiting, only the latest is sent.

        Requests that arrive while the node's session is being opened are dropped, because they would be too old.
        """
        operator = self._operators.get(sender)
        if operator is None:
            if sender not in self._opening:
                self.ask(sender, what, _connected)
            return
        operator.waiting = order
        if operator.task is None or operator.task.done():
            operator.task = asyncio.create_task(self._drive(sender, operator, what))

    async def _drive(self, sender: RosSender, operator: RosOperator, what: str) -> None:
        while operator.waiting is not None:
            order, operator.waiting = operator.waiting, None
            try:
                await order(operator.client)
            except TruckError as error:
                self.refuse(sender.node, what, str(error))

    def ask(self, sender: RosSender, what: str, order: RosOrder) -> None:
        """Send a node's request and report a refusal."""

        async def carry_out() -> None:
            await order(await self.session(sender))

        self.run(sender.node, what, carry_out())

    def run(self, node: str, what: str, work: Coroutine[Any, Any, Any]) -> None:
        """Run ``work`` and report a refusal under the node's name."""

        async def reported() -> None:
            try:
                await work
            except TruckError as error:
                self.refuse(node, what, str(error))

        task = asyncio.create_task(reported())
        self._asking.add(task)
        task.add_done_callback(self._asking.discard)

    async def session(self, sender: RosSender) -> TruckClient:
        """Return the session of a node; it is opened on first use.

        Raises:
            BusyError: there are too many nodes are connected.
            TruckError: the robot cannot be reached.
        """
        if sender in self._operators:
            return self._operators[sender].client
        if sender not in self._opening:
            most_operators = 16  # maximum number of nodes connected to the robot
            if len(self._operators) + len(self._opening) >= most_operators:
                raise BusyError(f"{most_operators} ROS nodes are connected: expected fewer")
            self._opening[sender] = asyncio.create_task(self._open(sender))
        return (await asyncio.shield(self._opening[sender])).client

    async def _open(self, sender: RosSender) -> RosOperator:
        stack = AsyncExitStack()
        try:
            client = await stack.enter_async_context(self._connect(source_of(sender.node, self._owner)))
            await client.ready()
        except BaseException:
            await stack.aclose()
            raise
        finally:
            del self._opening[sender]
        operator = self._operators[sender] = RosOperator(client, stack)
        return operator

    async def leave_absent(self, present: Callable[[RosSender], bool]) -> None:
        """Close the sessions of nodes that have left."""
        self._sequences = {sender: newest for sender, newest in self._sequences.items() if present(sender)}
        for sender, operator in list(self._operators.items()):
            if not present(sender):
                del self._operators[sender]
                await operator.exit.aclose()

    async def close(self) -> None:
        """Close all sessions."""
        for task in (*self._asking, *self._opening.values()):
            task.cancel()
        await self.leave_absent(lambda _: False)


async def _connected(_: TruckClient) -> None:
    """Request nothing; only the session is needed."""
