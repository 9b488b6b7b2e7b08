"""What leaves over Zenoh, put in rows: waking Zenoh's threads costs several times what a message does."""

import asyncio
from collections.abc import Callable
from typing import Any, Final

from monstertruck_schemas.topics import Topic

OFTEN: Final = 20.0
"""Topics of so many messages a second or more may wait for others."""

Put = Callable[[bytes], None]


class Outgoing:
    """Puts rare messages at once, and with them, or after a moment, the frequent ones that wait.

    Args:
        seconds: a frequent message waits at most this long; 0: it does not.
        guard: runs what the timer calls, so that a failure is told.
    """

    def __init__(self, seconds: float, guard: Callable[[Callable[[], None]], None]) -> None:
        self._seconds = seconds
        self._guard = guard
        self._loop = asyncio.get_running_loop()
        self._waiting: list[tuple[Put, bytes]] = []
        self._timer: asyncio.TimerHandle | None = None

    def send(self, topic: Topic[Any], put: Put, data: bytes) -> None:
        """Put one message now or soon; messages never overtake each other."""
        self._waiting.append((put, data))
        if topic.rate is None or topic.rate < OFTEN or self._seconds == 0.0:
            self.flush()
        elif self._timer is None:
            self._timer = self._loop.call_later(self._seconds, self._guard, self._due)

    def flush(self) -> None:
        """Put all that waits."""
        waiting, self._waiting = self._waiting, []
        for put, data in waiting:
            put(data)

    def close(self) -> None:
        """Put what waits, for the last time."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self.flush()

    def _due(self) -> None:
        self._timer = None
        self.flush()
