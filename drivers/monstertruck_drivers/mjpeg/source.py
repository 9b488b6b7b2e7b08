"""Pictures over a link, with or without HTTP."""

from abc import ABC, abstractmethod
from typing import Final, Self

from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.protocol import (
    HEAD_END,
    HEAD_MOST,
    Dechunker,
    HttpHead,
    PictureSplitter,
    request,
    size_of,
)
from monstertruck_drivers.webcam.source import CameraFrame, FrameStream, Mode
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)

OK: Final = 200
KINDS: Final = ("image/jpeg", "multipart/x-mixed-replace")


class LinkSource:
    """Camera behind a port.

    Args:
        config: camera settings.
        port: program, TCP port or emulated camera.
        clock: time.
    """

    def __init__(self, config: MjpegConfig, port: Port, clock: Clock) -> None:
        self.name = port.name if config.http is None else f"{port.name}{config.http}"
        self._config = config
        self._port = port
        self._clock = clock

    async def open(self, mode: Mode, buffers: int) -> FrameStream:
        """Connect and wait for a picture; its size becomes the granted mode. See ``FrameSource``.

        Raises:
            DeviceLostError: the program or server is missing or has ended.
            DeviceTimeoutError: no picture arrived within ``watchdog``.
            DeviceMismatchError: the server refuses the path.
            WrongDeviceError: the server sends content other than pictures.
            ProtocolError: the answer is not HTTP.
        """
        del buffers
        stream = _Polled(self, mode) if self._config.poll is not None else _Streamed(self, mode)
        try:
            async with self._clock.deadline(self._config.watchdog):
                await stream.begin()
        except TimeoutError:
            stream.close()
            raise DeviceTimeoutError(f"{self.name}: no image for {self._config.watchdog} s") from None
        except BaseException:
            stream.close()
            raise
        return stream

    async def connect(self) -> "_Connection":
        """Open the port and, with HTTP, send the request and read the header; raises the same errors as ``open``."""
        link = await self._port.open()
        if self._config.http is None:
            return _Connection(self.name, link)
        try:
            link.write(request(self._config.http, self._port.name))
            answer = b""
            while HEAD_END not in answer:
                answer += await link.read()
                if len(answer) > HEAD_MOST + HEAD_MOST and HEAD_END not in answer:
                    raise ProtocolError(
                        f"{self.name}: the header of the answer does not end within {len(answer)} bytes"
                    )
            head, _, rest = answer.partition(HEAD_END)
            return _Connection(self.name, link, self._checked(head), rest)
        except BaseException:
            link.close()
            raise

    def _checked(self, head: bytes) -> HttpHead:
        try:
            found = HttpHead.of(head)
        except ValueError as error:
            raise ProtocolError(f"{self.name}: not an HTTP server: the answer {error}") from None
        if found.status != OK:
            raise DeviceMismatchError(f"{self.name}: the server answers {found.status} {found.reason}".rstrip())
        if found.kind not in KINDS:
            raise WrongDeviceError(f"{self.name}: the server sends {found.kind or 'no content type'}, not images")
        return found

    def frame(self, number: int, data: bytes) -> CameraFrame:
        """Return a frame stamped as having just arrived."""
        return CameraFrame(self._clock.now() - round(self._config.delay * SECOND), number, data)

    def splitter(self) -> PictureSplitter:
        """Return a parser for one connection."""
        return PictureSplitter(self._config.most)

    def schedule(self) -> Schedule:
        """Return the polling schedule."""
        return Schedule(self._clock, self._config.poll or 1.0)


class _Connection:
    """Connection for one response."""

    def __init__(self, name: str, link: Link, head: HttpHead | None = None, rest: bytes = b"") -> None:
        self.link = link
        self._name = name
        self._chunks = Dechunker() if head is not None and head.chunked else None
        self._left = None if head is None else head.length
        self._rest = rest

    @property
    def ended(self) -> bool:
        """Whether all content has arrived, according to its length or the last chunk."""
        return self._left == 0 or (self._chunks is not None and self._chunks.ended)

    async def read(self) -> bytes:
        """Wait for content."""
        data, self._rest = self._rest or await self.link.read(), b""
        if self._left is not None:
            self._left = max(self._left - len(data), 0)
        if self._chunks is None:
            return data
        try:
            return self._chunks.feed(data)
        except ValueError as error:
            raise ProtocolError(f"{self._name}: {error}") from None


class _Pictures(ABC):
    """Base class of both streams; it receives a picture on opening, which the first ``next`` returns."""

    def __init__(self, source: LinkSource, mode: Mode) -> None:
        self.mode = mode
        self._source = source
        self._connection: _Connection | None = None
        self._first: CameraFrame | None = None
        self._count = 0

    async def begin(self) -> None:
        """Wait for the first picture; see ``LinkSource.open``."""
        self._first = await self._take()
        if (size := size_of(self._first.data)) is not None:
            self.mode = Mode(*size, self.mode.rate)

    async def next(self) -> CameraFrame:
        """Wait for a picture; see ``FrameStream``."""
        frame, self._first = self._first, None
        return frame or await self._take()

    @abstractmethod
    async def _take(self) -> CameraFrame:
        """Wait for the next picture."""

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.link.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()


class _Streamed(_Pictures):
    """Stream of pictures on one connection."""

    async def _take(self) -> CameraFrame:
        if self._connection is None:
            self._connection = await self._source.connect()
            self._splitter = self._source.splitter()
        while not (found := self._splitter.feed(await self._connection.read())):
            pass
        self._count += len(found)
        return self._source.frame(self._count, found[-1])


class _Polled(_Pictures):
    """Stream with one connection per picture."""

    def __init__(self, source: LinkSource, mode: Mode) -> None:
        super().__init__(source, mode)
        self._schedule = source.schedule()

    async def _take(self) -> CameraFrame:
        await self._schedule.next()
        self._connection = await self._source.connect()
        splitter, content = self._source.splitter(), b""
        found: list[bytes] = []
        try:
            while not found and not self._connection.ended:
                data = await self._connection.read()
                content += data
                found = splitter.feed(data)
        except DeviceLostError:
            if not content:
                raise
        finally:
            self.close()
        self._count += 1
        return self._source.frame(self._count, found[0] if found else content)
