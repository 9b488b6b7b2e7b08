"""Outboxes of browsers: the latest frame of each kind and map tile, and a few events."""

import asyncio
from collections import deque
from typing import Final

from monstertruckd.station.frames import Frame

Place = tuple[float, float]
"""Origin of a map tile (m)."""
MOST_TILES: Final = 400
"""Maximum number of waiting map tiles; then the oldest is dropped, until the next full map."""


class Viewer:
    """Outbox of one browser. A browser that reads slowly, or not at all, gets fewer images and delays no other."""

    def __init__(self) -> None:
        self._newest: dict[str, Frame] = {}
        self._tiles: dict[Place, Frame] = {}
        self._ordered: deque[Frame] = deque(maxlen=256)
        self._news = asyncio.Event()
        self.plotted: tuple[str, ...] = ()
        """Names of the numbers that the browser plots."""
        self.plot_set = 0
        """Number that the browser gave to this choice."""
        self.lost = 0
        """Number of frames dropped from the ordered queue."""

    def show(self, kind: str, frame: Frame) -> None:
        """Queue ``frame``; a newer frame of its kind replaces it before it is sent."""
        self._newest[kind] = frame
        self._news.set()

    def patch(self, place: Place, frame: Frame) -> None:
        """Queue a map tile; a newer tile at its place replaces it before it is sent."""
        self._tiles.pop(place, None)
        self._tiles[place] = frame
        if len(self._tiles) > MOST_TILES:
            del self._tiles[next(iter(self._tiles))]
        self._news.set()

    def send(self, frame: Frame) -> None:
        """Queue ``frame`` in order of the calls."""
        self.lost += len(self._ordered) == self._ordered.maxlen
        self._ordered.append(frame)
        self._news.set()

    def forget(self) -> None:
        """Drop all waiting frames: the browser switches to another robot."""
        self.forget_states()
        self._ordered.clear()

    def forget_states(self) -> None:
        """Drop waiting states and tiles of a robot, which was restarted."""
        self._newest.clear()
        self._tiles.clear()

    async def next(self) -> Frame:
        """Return the next frame to send: ordered frames first, then states, map tiles, camera images."""
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
    """Browsers that watch the same robot or recording, with the latest frame of each kind shown to them."""

    def __init__(self) -> None:
        super().__init__()
        self.newest: dict[str, Frame] = {}

    def show(self, kind: str, frame: Frame) -> None:
        """Show a frame in all browsers, and keep it for browsers that join later."""
        self.newest[kind] = frame
        for viewer in self:
            viewer.show(kind, frame)

    def send(self, frame: Frame) -> None:
        """Send a frame to all browsers, in order of the calls."""
        for viewer in self:
            viewer.send(frame)

    def patch(self, place: Place, frame: Frame) -> None:
        """Queue a map tile for all browsers; a newer tile at its place replaces it."""
        for viewer in self:
            viewer.patch(place, frame)
