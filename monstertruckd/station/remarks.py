"""Log lines about clients, limited per address, so that a client that sends garbage cannot fill the disk."""

import asyncio
import logging
from collections import Counter
from typing import Final

OTHERS: Final = "other addresses"


def printable(text: str, longest: int = 300) -> str:
    """Return one line that a terminal shows unchanged: control characters are escaped, excess text is cut off."""
    short = text if len(text) <= longest else f"{text[:longest]}..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in short)


class Remarks:
    """Writes log lines with a limit per address; must be used on the event loop.

    Args:
        log: destination of the lines.
        window: time over which lines are counted (s).
        burst: maximum number of lines per address in the window; further lines are counted and reported at its end.
        most_peers: maximum number of addresses counted separately in the window; all others share one count.
    """

    def __init__(self, log: logging.Logger, *, window: float = 60.0, burst: int = 20, most_peers: int = 32) -> None:
        self._log = log
        self._window, self._burst, self._most_peers = window, burst, most_peers
        self._counts: Counter[str] = Counter()
        self._timer: asyncio.TimerHandle | None = None

    def add(self, peer: str | None, text: str, level: int = logging.WARNING) -> None:
        """Write ``text`` unless ``peer`` has already caused too many lines."""
        known = peer or "?"
        if known not in self._counts and len(self._counts) >= self._most_peers:
            known = OTHERS
        self._counts[known] += 1
        if self._counts[known] <= self._burst:
            self._log.log(level, "%s", printable(text))
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(self._window, self.tell)

    def tell(self) -> None:
        """Write the number of omitted lines, and restart the count."""
        if self._timer is not None:
            self._timer.cancel()
        counts, self._counts, self._timer = self._counts, Counter(), None
        for peer, count in counts.items():
            if count > self._burst:
                self._log.warning("%s: %d further lines not logged", printable(peer), count - self._burst)
