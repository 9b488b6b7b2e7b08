"""Freshness check: allows motion only while a configured topic is fresh."""

from collections.abc import Iterator
from typing import Any

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.catalog import FreshConfig
from monstertruckd.gate.checks import Check, GateView, Tick


class FreshCheck(Check):
    """Keeps the robot at rest while the latest message of a topic is too old or missing.

    Args:
        config: topic and maximum age.
        view: read access to the gate's state.
    """

    reasons = (Reason.OWN_CHECK,)

    def __init__(self, config: FreshConfig, view: GateView) -> None:
        super().__init__(view)
        self._topic, self._limit = config.row, config.limit
        self.reads = (self._topic,)
        self._received: int | None = None

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Record the arrival time of a message of the topic."""
        if isinstance(seen, Message) and topic is self._topic:
            self._received = seen.received

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a stale topic."""
        if self._received is None or now - self._received > self._limit * SECOND:
            yield Reason.OWN_CHECK

    def text(self, reason: Reason) -> str:
        """Text of the reason, with the name of the topic."""
        return f"{self._topic.name} is silent"

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Age of the latest message."""
        if self._received is not None:
            yield Measurement(name="age", value=(now - self._received) / SECOND, unit="s", limit=self._limit)
