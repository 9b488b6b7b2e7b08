"""What waits to be sent to browsers: never more than the newest message of each kind, and a few events."""

import asyncio
from collections import deque
from typing import Final

from monstertruckd.station.frames import Frame

MOST_WAITING: Final = 256
"""Events, answers and tiles of the map that wait; beyond that the oldest is lost."""


class Viewer:
    """Outbox of one browser. A browser that reads slowly, or not at all, gets fewer pictures and delays nobody."""

    def __init__(self) -> None:
        self._newest: dict[str, Frame] = {}
        self._ordered: deque[Frame] = deque(maxlen=MOST_WAITING)
        self._news = asyncio.Event()
        self.lost = 0
        """Frames of the ordered queue that were dropped."""

    def show(self, kind: str, frame: Frame) -> None:
        """Send ``frame`` unless a newer one of its kind comes before it is sent."""
        self._newest[kind] = frame
        self._news.set()

    def send(self, frame: Frame) -> None:
        """Send ``frame`` behind all that were given so."""
        self.lost += len(self._ordered) == MOST_WAITING
        self._ordered.append(frame)
        self._news.set()

    def forget(self) -> None:
        """Drop all that waits: another robot is looked at."""
        self._newest.clear()
        self._ordered.clear()

    async def next(self) -> Frame:
        """The next frame to be sent: what is ordered first, pictures of the camera last."""
        while not self._ordered and not self._newest:
            self._news.clear()
            await self._news.wait()
        if self._ordered:
            return self._ordered.popleft()
        kind = next((kind for kind in self._newest if kind != "camera"), "camera")
        return self._newest.pop(kind)


class Viewers(set[Viewer]):
    """Browsers that look at the same robot or recording, and the newest frame of each kind that they are shown."""

    def __init__(self) -> None:
        super().__init__()
        self.newest: dict[str, Frame] = {}

    def show(self, kind: str, frame: Frame) -> None:
        """Show a frame everywhere, and keep it for whoever comes later."""
        self.newest[kind] = frame
        for viewer in self:
            viewer.show(kind, frame)

    def send(self, frame: Frame) -> None:
        """Send a frame everywhere, behind all that were given so."""
        for viewer in self:
            viewer.send(frame)
