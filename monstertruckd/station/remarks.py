"""Log lines about clients, limited per address, so that a client sending rubbish cannot fill the disk."""

import asyncio
import logging
from collections import Counter
from typing import Final

COUNTING_WINDOW: Final = 60.0
"""Time over which lines are counted (s)."""
BURST: Final = 20
"""Maximum number of lines per address in that time; further lines are counted, and reported at its end."""
OTHERS: Final = "other addresses"
LONGEST_LINE: Final = 300
"""Maximum length of a line (characters)."""


def printable(text: str) -> str:
    """Return one line that a terminal shows unchanged: control characters become escapes."""
    short = text if len(text) <= LONGEST_LINE else f"{text[:LONGEST_LINE]}..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in short)


class Remarks:
    """Writes log lines with a limit per address; use it on the event loop.

    Args:
        log: destination of the lines.
    """

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._counts: Counter[str] = Counter()
        self._timer: asyncio.TimerHandle | None = None

    def add(self, peer: str | None, text: str, level: int = logging.WARNING) -> None:
        """Write ``text``, unless ``peer`` has already caused many lines."""
        known = peer or "?"
        # Maximum number of addresses counted separately in that time; all others share one count.
        if known not in self._counts and len(self._counts) >= 32:
            known = OTHERS
        self._counts[known] += 1
        if self._counts[known] <= BURST:
            self._log.log(level, "%s", printable(text))
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(COUNTING_WINDOW, self.tell)

    def tell(self) -> None:
        """Write the number of omitted lines, and restart the count."""
        if self._timer is not None:
            self._timer.cancel()
        counts, self._counts, self._timer = self._counts, Counter(), None
        for peer, count in counts.items():
            if count > BURST:
                self._log.warning("%s: %d further lines left out", printable(peer), count - BURST)
