"""What leaves the process, in rows: a message that follows another costs a fraction of one that comes alone.

The code that encodes, records and puts is then in the caches, and each row wakes Zenoh's threads once.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from monstertruck_schemas.base import Message
from monstertruck_schemas.topics import Topic

OFTEN: Final = 10.0
"""Topics of so many messages a second or more may wait for others."""
ROW: Final = 8
"""Messages delivered in one turn of the loop: a fraction of a millisecond."""


class Outgoing:
    """Delivers rare messages at once, and with them, or after a moment, the frequent ones that wait before them.

    Args:
        seconds: a frequent message waits at most this long; 0: it does not.
        deliver: gets topic, message and the time it was sent.
    """

    def __init__(self, seconds: float, deliver: Callable[[Topic[Any], Message, int], None]) -> None:
        self._seconds = seconds
        self._deliver = deliver
        self._waiting: deque[tuple[Topic[Any], Message, int]] = deque()
        self._timer: asyncio.TimerHandle | None = None

    def send(self, topic: Topic[Any], message: Message, at: int) -> None:
        """Deliver now or soon; messages never overtake each other."""
        self._waiting.append((topic, message, at))
        if self._seconds == 0.0 or topic.rate is None or topic.rate < OFTEN:
            self.flush()
        elif self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._seconds, self._due)

    def flush(self) -> None:
        """Deliver all that waits."""
        waiting = self._waiting
        while waiting:
            self._deliver(*waiting.popleft())

    def _due(self) -> None:
        """Deliver all that waits, a row a turn."""
        waiting = self._waiting
        try:
            for _ in range(ROW):
                if waiting:
                    self._deliver(*waiting.popleft())
        finally:
            self._timer = asyncio.get_running_loop().call_later(0.0, self._due) if waiting else None
