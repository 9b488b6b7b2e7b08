"""Outgoing messages in batches: a message that follows another costs a fraction of a single message.

The code that encodes, records and sends messages is then in the caches, and each batch wakes Zenoh's threads once.
"""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any, Final

from monstertruck_runtime.clock import MILLISECOND, SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic

BEHIND: Final = MILLISECOND
"""Offset of the batches from the multiples (ns): messages that the gate publishes there leave with them."""
BATCH: Final = 10
"""Messages delivered in one iteration of the event loop: a fraction of a millisecond."""

Sent = tuple[Topic[Any], Message, int]
"""Topic, message and send time (ns)."""


class Outgoing:
    """Delivers messages without a fixed rate immediately, and regular messages with them or after a short delay.

    Args:
        seconds: batches are sent shortly after multiples of this period; 0 for no delay.
        deliver: receives a batch of messages.
    """

    def __init__(self, seconds: float, deliver: Callable[[Sequence[Sent]], None]) -> None:
        self._period = round(seconds * SECOND)
        self._deliver = deliver
        self._waiting: list[Sent] = []
        self._delivering = False
        self._timer: asyncio.Handle | None = None

    def send(self, topic: Topic[Any], message: Message, at: int) -> None:
        """Deliver a message now or soon; messages never overtake each other."""
        self._waiting.append((topic, message, at))
        # 1.0: topics of so many messages a second or more may wait for others
        if not self._period or topic.rate is None or topic.rate < 1.0:
            self.flush()
        elif self._timer is None:
            loop = asyncio.get_running_loop()
            passed = round(loop.time() * SECOND)
            due = passed - passed % self._period + self._period + BEHIND
            self._timer = loop.call_at(due / SECOND, self._due)

    def flush(self) -> None:
        """Deliver all waiting messages; messages sent during the delivery follow."""
        if self._delivering:
            return
        try:
            while self._waiting:
                self._next_batch()
        finally:
            if self._waiting and self._timer is None:
                self._timer = asyncio.get_running_loop().call_soon(self._due)

    def _due(self) -> None:
        """Deliver all waiting messages, one batch per iteration of the event loop."""
        try:
            if self._waiting:
                self._next_batch()
        finally:
            self._timer = asyncio.get_running_loop().call_later(0.0, self._due) if self._waiting else None

    def _next_batch(self) -> None:
        batch = self._waiting[:BATCH]
        del self._waiting[:BATCH]
        self._delivering = True
        try:
            self._deliver(batch)
        finally:
            self._delivering = False
