"""What waits to be sent to browsers: the newest message of each kind and tile of the map, and a few events."""

import asyncio
from collections import deque
from typing import Final

from monstertruckd.station.frames import Frame

Place = tuple[float, float]
"""Where a part of the map begins, m."""
MOST_ANSWERS: Final = 256
"""Events and answers that wait; beyond that the oldest is lost."""
MOST_TILES: Final = 400
"""Changed parts of the map that wait; beyond that the oldest is lost, until the whole map comes again."""


class Viewer:
    """Outbox of one browser. A browser that reads slowly, or not at all, gets fewer pictures and delays nobody."""

    def __init__(self) -> None:
        self._newest: dict[str, Frame] = {}
        self._tiles: dict[Place, Frame] = {}
        self._ordered: deque[Frame] = deque(maxlen=MOST_ANSWERS)
        self._news = asyncio.Event()
        self.lost = 0
        """Frames of the ordered queue that were dropped."""

    def show(self, kind: str, frame: Frame) -> None:
        """Send ``frame`` unless a newer one of its kind comes before it is sent."""
        self._newest[kind] = frame
        self._news.set()

    def patch(self, place: Place, frame: Frame) -> None:
        """Send a part of the map unless a newer one of its place comes before it is sent."""
        self._tiles.pop(place, None)
        self._tiles[place] = frame
        if len(self._tiles) > MOST_TILES:
            del self._tiles[next(iter(self._tiles))]
        self._news.set()

    def send(self, frame: Frame) -> None:
        """Send ``frame`` behind all that were given so."""
        self.lost += len(self._ordered) == MOST_ANSWERS
        self._ordered.append(frame)
        self._news.set()

    def forget(self) -> None:
        """Drop all that waits: another robot is looked at."""
        self.forget_states()
        self._ordered.clear()

    def forget_states(self) -> None:
        """Drop what waits of a robot's state: it started again."""
        self._newest.clear()
        self._tiles.clear()

    async def next(self) -> Frame:
        """The next frame to be sent: what is ordered first, then states, parts of the map, pictures of the camera."""
        while not self._ordered and not self._newest and not self._tiles:
            self._news.clear()
            await self._news.wait()
        if self._ordered:
            return self._ordered.popleft()
        kind = next((kind for kind in self._newest if kind != "camera"), None)
        if kind is None and self._tiles:
            return self._tiles.pop(next(iter(self._tiles)))
        return self._newest.pop(kind or "camera")


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

    def patch(self, place: Place, frame: Frame) -> None:
        """Send a part of the map everywhere, unless a newer one of its place comes before."""
        for viewer in self:
            viewer.patch(place, frame)
