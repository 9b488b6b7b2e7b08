"""From cameras to poses: a thread for each camera reads tags and discs, the loop joins their simultaneous results."""

import asyncio
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress

import cv2
import numpy as np

from monstertruck_estimation.vision.blobs import Blob, BlobReader
from monstertruck_estimation.vision.tags import EVERYWHERE, Picture, Sighting, TagReader
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import TruckError
from monstertruck_schemas.board import Colour
from monstertruckd.tools.stand.poses import RobotPose
from monstertruckd.tools.stand.tracking import StandTracker

Stream = Callable[[], Iterator[Picture]]


class StandReader:
    """Reads one camera's images.

    Args:
        marks: tags on the table.
        colours: colours of robots' discs; empty: images may be grey.
        tagged: whether robots have tags; otherwise tags are read in one image of ``EVERYWHERE``, for the marks.
        phase: number of the camera: in each image a different camera searches for tags everywhere.
    """

    def __init__(
        self, marks: Collection[int], colours: Collection[Colour], *, tagged: bool = True, phase: int = 0
    ) -> None:
        self._tags = TagReader(EVERYWHERE, marks, phase=phase) if tagged else TagReader(1, marks)
        self._blobs = BlobReader(colours) if colours else None
        self._tagged = tagged
        self._phase = phase
        self._count = 0

    def read(self, picture: Picture, expected: Sequence[Array] = ()) -> list[Sighting | Blob]:
        """Return tags and discs in an image, grey or blue, green and red.

        Args:
            picture: next image.
            expected: corners of robots' tags, (4, 2) each (pixels).
        """
        found: list[Sighting | Blob] = []
        if self._tagged or self._count == 0 or (self._count - self._phase) % EVERYWHERE == 0:
            grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            found += self._tags.read(np.asarray(grey, dtype=np.uint8), expected)
        self._count += 1
        if self._blobs is not None and picture.ndim == 3:
            found += self._blobs.read(picture)
        return found


class StandRun:
    """Tracks until the sources end or until cancelled.

    Args:
        tracker: tracker of robots and cameras.
        streams: images by camera; each call starts again.
        rate: image rate (1/s).
        clock: stamps each image when it is read.
        put: receives every pose.
        say: receives faults of cameras.
        live: whether a source that ends is a fault, and retried.
        colours: colours of robots' discs; any require colour images.
    """

    def __init__(
        self,
        tracker: StandTracker,
        streams: Mapping[str, Stream],
        rate: float,
        clock: Clock,
        put: Callable[[RobotPose], object],
        say: Callable[[str], object],
        *,
        live: bool,
        colours: Collection[Colour] = (),
    ) -> None:
        self._tracker = tracker
        self._streams = streams
        self._rate = rate
        self._clock = clock
        self._put = put
        self._say = say
        self._live = live
        self._colours = colours
        self._newest: dict[str, tuple[int, list[Sighting | Blob]]] = {}
        self._expected: dict[str, list[Array]] = {}
        self._ended = threading.Event()

    async def run(self) -> None:
        """Track; returns when all recorded sources have ended."""
        if self._live:
            await self._follow()
        else:
            await self._play()

    async def _play(self) -> None:
        """Process recorded images: the first images of all cameras are of one instant, and so on."""
        iterators = {name: stream() for name, stream in self._streams.items()}
        readers = {name: self._reader(name) for name in iterators}

        def read(name: str) -> list[Sighting | Blob] | None:
            picture = next(iterators[name], None)
            return None if picture is None else readers[name].read(picture, self._expected.get(name, ()))

        began, count = self._clock.now(), 0
        while iterators:
            stamp = began + round(count * SECOND / self._rate)
            self._expected = self._tracker.expected(stamp)
            found = await asyncio.gather(*(asyncio.to_thread(read, name) for name in iterators))
            seen = {name: tags for name, tags in zip(iterators, found, strict=True) if tags is not None}
            iterators = {name: iterators[name] for name in seen}
            if seen:
                for pose in self._tracker.take(stamp, seen):
                    self._put(pose)
                for text in self._tracker.complaints(stamp):
                    self._say(text)
            count += 1

    def _reader(self, name: str) -> StandReader:
        tracker = self._tracker
        return StandReader(tracker.marks, self._colours, tagged=tracker.tagged, phase=list(self._streams).index(name))

    async def _follow(self) -> None:
        loop = asyncio.get_running_loop()
        threads = [
            threading.Thread(target=self._watch, args=(loop, name, stream), name=f"camera {name}", daemon=True)
            for name, stream in self._streams.items()
        ]
        for thread in threads:
            thread.start()
        taken: dict[str, int] = {}
        try:
            while True:
                await self._clock.sleep(1 / self._rate)
                fresh = {n: (at, tags) for n, (at, tags) in self._newest.items() if at > taken.get(n, -1)}
                if fresh:
                    taken |= {name: at for name, (at, _) in fresh.items()}
                    stamp = max(at for at, _ in fresh.values())
                    seen = {name: tags for name, (_, tags) in fresh.items()}
                    for pose in self._tracker.take(stamp, seen, {name: at for name, (at, _) in fresh.items()}):
                        self._put(pose)
                    self._expected = self._tracker.expected(stamp + round(SECOND / self._rate))
                for text in self._tracker.complaints(self._clock.now()):
                    self._say(text)
        finally:
            self._ended.set()

    def _watch(self, loop: asyncio.AbstractEventLoop, name: str, stream: Stream) -> None:
        """Read one camera in a separate thread: OpenCV releases the interpreter while it works."""
        said = ""
        while not self._ended.is_set():
            reader = self._reader(name)
            try:
                for picture in stream():
                    at = self._clock.now()
                    self._newest[name] = at, reader.read(picture, self._expected.get(name, ()))
                    if self._ended.is_set():
                        return
                    said = ""
            except TruckError as error:
                if str(error) != said:
                    said = str(error)
                    with suppress(RuntimeError):  # the loop has ended
                        loop.call_soon_threadsafe(self._say, f"camera {name}: {error}")
            self._ended.wait(1.0)  # seconds before a lost camera is reopened
