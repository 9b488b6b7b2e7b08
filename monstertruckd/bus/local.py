"""Message passing in the process: one publisher per topic, any number of subscribers, messages passed by reference.

Everything happens on the event loop. A message reaches listeners immediately, then its readers in the order of
subscription. The taps (recorder, Zenoh) get the message immediately or a moment later, with its wire bytes, encoded
once for all taps.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from monstertruck_runtime import wire
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Value
from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import CMD_DRIVES, CMD_STEERING, EVENT, Topic, Writer
from monstertruckd.bus.outgoing import Outgoing, Sent

M = TypeVar("M", bound=Message)

TapCallback = Callable[[Topic[Any], Message, bytes, int], None]
"""Receive every message of its topics with its wire bytes and its time of publication (ns).

Must not block, nor raise."""


class LocalPublisher(Generic[M]):
    """Write end of one topic, created by ``Bus``."""

    def __init__(self, bus: "Bus", topic: Topic[M]) -> None:
        self._bus = bus
        self._topic = topic
        self._seq = 0

    def next_seq(self) -> int:
        """Sequence number for the next message of this topic."""
        seq = self._seq
        self._seq += 1
        return seq

    def put(self, message: M) -> None:
        """Pass ``message`` to every reader and tap; never blocks."""
        self._bus.hand_over(self._topic, message)


class Tap:
    """A running tap; ``close()`` ends it."""

    def __init__(self, bus: "Bus", callback: TapCallback, topics: frozenset[str]) -> None:
        self.callback = callback
        self.topics = topics
        self._bus = bus

    def close(self) -> None:
        """Stop calling back. Closing twice is harmless."""
        self._bus.untap(self)


@dataclass(slots=True)
class _ReadEnds:
    """Readers and taps of one topic."""

    listeners: list[Callable[[Any], object]] = field(default_factory=list)
    mailboxes: tuple[Mailbox[Any], ...] = ()
    """Replaced, never changed, when a listener comes or goes: a message may be on its way to the listeners."""
    taps: int = 0


class Bus:
    """Topics of one daemon.

    Each write end is handed out once, and only to the writer named in the topic table, so that write access is settled
    when the daemon is assembled.

    Args:
        clock: time source.
        gather_seconds: maximum delay of regular topics' messages, which reach the taps in batches; 0 for no delay.
    """

    def __init__(self, clock: Clock, gather_seconds: float = 0.0) -> None:
        self._clock = clock
        self._outgoing = Outgoing(gather_seconds, self._deliver_to_taps)
        self._claimed: set[str] = set()
        self._ends: defaultdict[str, _ReadEnds] = defaultdict(_ReadEnds)
        self._taps: list[Tap] = []
        self._retained: dict[str, tuple[Topic[Any], Any]] = {}
        self._drops = 0
        self.degraded: frozenset[str] = frozenset()
        """Topics that depend on an expired calibration; their messages carry ``degraded``."""
        self._events = LocalPublisher(self, EVENT)

    def publisher(self, topic: Topic[M], writer: Writer) -> Publisher[M]:
        """Return the only write end of ``topic``.

        Raises:
            RuntimeError: ``writer`` is not the topic's writer, the write end is taken, or the topic has none
                (commands: ``actuators``; events: ``event_sink``; requests: ``inject``).
        """
        if topic.group == "cmd" or topic.inward or topic.name == EVENT.name:
            msg = f"{topic.name} cannot be written directly: open the writer of its role"
            raise RuntimeError(msg)
        if writer is not topic.writer:
            msg = f"{topic.name} is written by {topic.writer}, not by {writer}"
            raise RuntimeError(msg)
        return self._claim(topic)

    def actuators(self, shafts: int = 1) -> tuple[tuple[Publisher[DriveCommand], ...], Publisher[SteeringCommand]]:
        """Return the write ends of the actuators, for the safety gate only: ``shafts`` drives and the steering.

        Raises:
            RuntimeError: the write ends have already been handed out.
        """
        return tuple(self._claim(topic) for topic in CMD_DRIVES[:shafts]), self._claim(CMD_STEERING)

    def event_sink(self) -> EventSink:
        """Return the sink for every service's events; they share one topic and its sequence numbers."""
        return self._emit

    def subscribe(self, topic: Topic[M], delivery: Delivery) -> Mailbox[M]:
        """Return a read end of ``topic``; for a retained topic it holds the latest message immediately.

        Raises:
            RuntimeError: the topic is written by a test stand and must not be read in the robot.
        """
        _require_own(topic)
        mailbox: Mailbox[M] = Mailbox(delivery, lambda closed: self._forget(topic.name, closed))
        self._ends[topic.name].mailboxes += (mailbox,)
        if (newest := self.newest(topic)) is not None:
            mailbox.put(newest)
        return mailbox

    def listen(self, topic: Topic[M], listener: Callable[[M], object]) -> None:
        """Call ``listener``, which must not block, with every message of ``topic``; no queue, so none is lost.

        Raises:
            RuntimeError: see ``subscribe``.
        """
        _require_own(topic)
        self._ends[topic.name].listeners.append(listener)

    def newest(self, topic: Topic[M]) -> M | None:
        """Latest message of a retained topic; None before the first message and for all other topics."""
        held = self._retained.get(topic.name)
        return None if held is None else held[1]

    def retained(self) -> Iterator[tuple[Topic[Any], Message, bytes]]:
        """Latest message of every retained topic with its bytes, e.g. for the head of a new log file."""
        for topic, message in list(self._retained.values()):
            yield topic, message, wire.encode(topic, message)

    def tap(self, callback: TapCallback, topics: Iterable[Topic[Any]]) -> Tap:
        """Call ``callback`` with every message of ``topics``, starting with the retained ones.

        All taps of a topic share one encoding; a topic without taps is never encoded.
        """
        self._outgoing.flush()
        chosen = tuple(topics)
        tap = Tap(self, callback, frozenset(topic.name for topic in chosen))
        self._taps.append(tap)
        for name in tap.topics:
            self._ends[name].taps += 1
        for topic, message, data in self.retained():
            if topic.name in tap.topics:
                callback(topic, message, data, self._clock.now())
        return tap

    def inject(self, topic: Topic[M], message: M) -> list[object]:
        """Accept a request from outside; ``received`` is set to the daemon's own time, whatever the request claimed.

        Returns the listeners' results in their order.

        Raises:
            RuntimeError: clients may not write ``topic``.
        """
        if topic.writer is not Writer.OUTSIDE:
            msg = f"{topic.name} is written by {topic.writer}, not from outside"
            raise RuntimeError(msg)
        return self.hand_over(topic, message.model_copy(update={"received": self._clock.now()}))

    def put_stand(self, topic: Topic[M], message: M) -> None:
        """Deliver a test stand's message only to the taps; ``received`` is set to the daemon's own time.

        Raises:
            RuntimeError: test stands may not write ``topic``.
        """
        if topic.writer is not Writer.STAND:
            msg = f"{topic.name} is written by {topic.writer}, not by a stand"
            raise RuntimeError(msg)
        self.hand_over(topic, message.model_copy(update={"received": self._clock.now()}))

    @property
    def drops(self) -> int:
        """Number of messages lost in bounded queues since the start: all FIFO subscriptions, and ``add_drops``."""
        return self._drops + sum(mailbox.drops for ends in self._ends.values() for mailbox in ends.mailboxes)

    def add_drops(self, count: int) -> None:
        """Count messages lost in a queue outside the bus."""
        self._drops += count

    def hand_over(self, topic: Topic[M], message: M) -> list[object]:
        """Deliver to listeners, readers and taps; return the listeners' results."""
        if topic.name in self.degraded:
            message = message.model_copy(update={"degraded": True})
        if topic.retained:
            self._retained[topic.name] = (topic, message)
        ends = self._ends[topic.name]
        answers = [listener(message) for listener in ends.listeners]
        for mailbox in ends.mailboxes:
            mailbox.put(message)
        if ends.taps:
            self._outgoing.send(topic, message, self._clock.now())
        return answers

    def untap(self, tap: Tap) -> None:
        """End ``tap``; see ``Tap.close``."""
        self._outgoing.flush()
        if tap in self._taps:
            self._taps.remove(tap)
            for name in tap.topics:
                self._ends[name].taps -= 1
            tap.topics = frozenset()

    def _deliver_to_taps(self, batch: Sequence[Sent]) -> None:
        """Encode the complete batch, then pass it to one tap after another.

        Raises:
            Exception: a message cannot be encoded, or a tap has a bug; only this message is lost.
        """
        encoded: list[tuple[Topic[Any], Message, bytes, int]] = []
        bug: Exception | None = None
        for topic, message, at in batch:
            try:
                encoded.append((topic, message, wire.encode(topic, message), at))
            except Exception as error:  # noqa: BLE001  # raised below
                bug = error
        for tap in tuple(self._taps):
            for sent in encoded:
                if sent[0].name in tap.topics:
                    try:
                        tap.callback(*sent)
                    except Exception as error:  # noqa: BLE001  # raised below
                        bug = error
        if bug is not None:
            raise bug

    def _claim(self, topic: Topic[M]) -> LocalPublisher[M]:
        if topic.name in self._claimed:
            msg = f"{topic.name} already has a writer"
            raise RuntimeError(msg)
        self._claimed.add(topic.name)
        return LocalPublisher(self, topic)

    def _forget(self, name: str, mailbox: Mailbox[Any]) -> None:
        self._drops += mailbox.drops
        ends = self._ends[name]
        ends.mailboxes = tuple(other for other in ends.mailboxes if other is not mailbox)

    def _emit(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Value) -> None:
        now = self._clock.now()
        self._events.put(
            Event(
                stamp=now,
                received=now,
                seq=self._events.next_seq(),
                reason=reason,
                severity=severity,
                source=source,
                text=text,
                values={name: _plain(value) for name, value in values.items()},
            )
        )


def _require_own(topic: Topic[Any]) -> None:
    if topic.writer is Writer.STAND:
        msg = f"{topic.name} is only recorded: no part of the robot may read it"
        raise RuntimeError(msg)


def _plain(value: Value) -> Value:
    """Return a value that the wire format can carry: a non-finite number is replaced by its name."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
