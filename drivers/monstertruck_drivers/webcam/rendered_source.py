"""Frame sources: the emulated camera over its port, and the real or emulated camera at a path."""

from pathlib import Path
from typing import Final, Self

from monstertruck_drivers.link import BUFFER_LIMIT, Link, Port
from monstertruck_drivers.tty import SerialPort
from monstertruck_drivers.webcam.packets import CameraPacket, PacketKind, PacketParser, decode_mode
from monstertruck_drivers.webcam.source import SET_FORMAT, CameraFrame, FrameSource, FrameStream, Mode, device_error
from monstertruck_drivers.webcam.v4l2_source import V4l2Source
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceTimeoutError

MOST: Final = BUFFER_LIMIT // 2
"""Maximum size of a picture read at once (bytes): the link's buffer holds no more."""


class RenderedSource:
    """Camera whose ``WebcamEmulator`` runs at the other end of ``port``, in this process or in another.

    Args:
        port: memory port or pty.
        clock: time.
    """

    def __init__(self, port: Port, clock: Clock) -> None:
        self.name = port.name
        self._port = port
        self._clock = clock

    async def open(self, mode: Mode, buffers: int) -> "RenderedStream":
        """Start the camera; see ``FrameSource``."""
        link = await self._port.open()
        parser = PacketParser()
        try:
            link.write(f"\nOPEN {mode.width} {mode.height} {mode.rate}\n".encode())
            async with self._clock.deadline(2.0):  # seconds until an emulated camera must grant or refuse
                granted = await self._answer(link, parser)
            return RenderedStream(link, parser, granted)
        except TimeoutError:
            link.close()
            raise DeviceTimeoutError(f"{self.name}: no camera answers") from None
        except BaseException:
            link.close()
            raise

    async def _answer(self, link: Link, parser: PacketParser) -> Mode:
        """Wait for the answer; pictures from an earlier session are dropped."""
        while True:
            for packet in parser.feed(await link.exactly(min(parser.missing, MOST))):
                if packet.kind is PacketKind.GRANTED:
                    return decode_mode(packet.payload)
                if packet.kind is PacketKind.REFUSED:
                    error = OSError(packet.number, "refused")
                    raise device_error(self.name, SET_FORMAT, error)


class RenderedStream:
    """Stream from an emulated camera."""

    def __init__(self, link: Link, parser: PacketParser, mode: Mode) -> None:
        self.mode = mode
        self._link = link
        self._parser = parser

    async def next(self) -> CameraFrame:
        """Wait for a picture; see ``FrameStream``."""
        picture: CameraPacket | None = None
        while picture is None:
            for packet in self._parser.feed(await self._link.read(least=min(self._parser.missing, MOST))):
                if packet.kind is PacketKind.PICTURE:
                    picture = packet
        return CameraFrame(picture.stamp, picture.number, picture.payload)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        if not self._link.is_lost:
            self._link.write(b"CLOSE\n")
        self._link.close()


PTYS: Final = Path("/dev/pts")


class PathSource:
    """Camera at a path; each opening checks whether the path leads to a pty, which only an emulator serves.

    Args:
        path: node, symlink or glob pattern; see ``V4l2Source``.
        clock: time.
    """

    def __init__(self, path: str, clock: Clock) -> None:
        self.name = path
        self._clock = clock

    async def open(self, mode: Mode, buffers: int) -> FrameStream:
        """Start the camera; see ``FrameSource``."""
        return await self._present().open(mode, buffers)

    def _present(self) -> FrameSource:
        path = Path(self.name)
        if path.resolve().parent == PTYS:
            return RenderedSource(SerialPort(path), self._clock)
        return V4l2Source(self.name)
