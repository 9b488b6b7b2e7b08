"""Camera driver: publishes complete pictures with the camera's own time stamps."""

from typing import Final, Protocol

from monstertruck_drivers.webcam.source import CameraFrame, FrameSource, FrameStream, Mode
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import CompressedImage

START: Final = b"\xff\xd8"
END: Final = b"\xff\xd9"
_HUFFMAN: Final = 0xC4
_FRAME_HEADERS: Final = frozenset(range(0xC0, 0xD0)) - {_HUFFMAN, 0xC8, 0xCC}

_TABLES: Final = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000017d01020300041105"
    "122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a434445"
    "464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8"
    "a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa01000301"
    "01010101010101010000000000000102030405060708090a0b11000201020404030407050404000102770001020311040521310612"
    "41510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a35363738393a434445464748"
    "494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aa"
    "b2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
TABLES_SEGMENT: Final = b"\xff\xc4" + (2 + len(_TABLES)).to_bytes(2, "big") + _TABLES


def complete(data: bytes) -> bytes:
    """Return the picture from its FF D8 to its FF D9, with Huffman tables.

    Only the headers are parsed, because a flipped bit in the compressed data merely alters the picture.

    Args:
        data: bytes from the camera; trailing zeros are removed.

    Raises:
        ValueError: the picture is truncated or not a JPEG; the message names the position of the error.
    """
    end = data.rfind(END) + len(END)
    if end < len(END) or data[end:].strip(b"\0"):
        raise ValueError(f"{len(data)} bytes do not end in FF D9")
    scan, has_tables = _follow(data)
    if has_tables:
        return data[:end]
    return data[:scan] + TABLES_SEGMENT + data[scan:end]


def _follow(data: bytes) -> tuple[int, bool]:
    """Return the start of the scan, and whether Huffman tables precede it."""
    if not data.startswith(START):
        raise ValueError(f"begins with {data[:2].hex(' ')} instead of FF D8")
    at, has_tables, has_frame = len(START), False, False
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xDA and has_frame:  # start of scan
            return at, has_tables
        has_tables |= marker == _HUFFMAN
        has_frame |= marker in _FRAME_HEADERS
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ValueError(f"header ends at byte {at}")


OLDEST: Final = SECOND
"""Maximum age of a picture at its arrival (ns); an older stamp is not used."""


class CameraSettings(Protocol):
    """Settings common to all cameras; see ``WebcamConfig``."""

    @property
    def width(self) -> int: ...  # noqa: D102
    @property
    def height(self) -> int: ...  # noqa: D102
    @property
    def rate(self) -> float: ...  # noqa: D102
    @property
    def watchdog(self) -> float: ...  # noqa: D102
    @property
    def buffers(self) -> int: ...  # noqa: D102
    @property
    def frame(self) -> str: ...  # noqa: D102


class WebcamDriver:
    """Publishes every complete picture.

    Args:
        config: mode and watchdog.
        source: the camera: ``V4l2Source`` or ``RenderedSource``.
        clock: time source; a real camera's stamps are CLOCK_MONOTONIC times, like those of the real clock.
        out: pictures.
        events: deviating modes, rejected pictures and unused stamps.
        name: service name.
    """

    def __init__(
        self,
        config: CameraSettings,
        source: FrameSource,
        clock: Clock,
        out: Publisher[CompressedImage],
        events: EventSink,
        name: str = "camera",
    ) -> None:
        self.name = name
        self._config = config
        self._source = source
        self._clock = clock
        self._out = out
        self._events = events
        self._reported_mode: Mode | None = None
        self._refusing = False
        self._doubting = False
        self._stamp = -OLDEST

    async def run(self, ready: Ready) -> None:
        """Serve one session, which is ready after the first complete picture.

        Raises:
            DeviceLostError: there is no camera, or it was unplugged.
            PortBusyError: another program is streaming from the camera.
            DeviceMismatchError: the camera does not offer motion JPEG or refuses the mode.
            DeviceFaultError: the camera's hub has no bandwidth left.
            DeviceTimeoutError: no picture arrived within ``watchdog``.
            ProtocolError: pictures arrived, but no complete one within that time.
        """
        config = self._config
        wanted = Mode(config.width, config.height, config.rate)
        async with await self._source.open(wanted, config.buffers) as stream:
            self._report_mode(wanted, stream.mode)
            await self._serve(stream, ready)

    def _report_mode(self, wanted: Mode, granted: Mode) -> None:
        if granted != wanted and granted != self._reported_mode:
            text = f"the camera offers {granted}, expected {wanted}"
            self._events(Reason.DEVICE_MISMATCH, Severity.INFO, self.name, text)
        self._reported_mode = granted

    async def _serve(self, stream: FrameStream, ready: Ready) -> None:
        timeout = self._config.watchdog
        limit, seen = self._clock.now() + round(timeout * SECOND), 0
        while True:
            try:
                async with self._clock.deadline((limit - self._clock.now()) / SECOND):
                    frame = await stream.next()
            except TimeoutError:
                if seen == 0:
                    raise DeviceTimeoutError(f"{self._source.name}: no image for {timeout} s") from None
                raise ProtocolError(f"{self._source.name}: {seen} images in {timeout} s, none complete") from None
            seen += 1
            if self._publish(frame):
                ready()
                limit, seen = self._clock.now() + round(timeout * SECOND), 0

    def _publish(self, frame: CameraFrame) -> bool:
        received = self._clock.now()
        try:
            if frame.damaged:
                raise ValueError("damaged on the bus")
            data = complete(frame.data)
        except ValueError as error:
            if not self._refusing:
                self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, f"image rejected: {error}")
            self._refusing = True
            return False
        self._refusing = False
        self._stamp = self._believed(frame.stamp, received)
        self._out.put(
            CompressedImage(
                stamp=self._stamp,
                received=received,
                seq=self._out.next_seq(),
                frame=self._config.frame,
                data=data,
                sequence=frame.sequence,
            )
        )
        return True

    def _believed(self, stamp: int | None, received: int) -> int:
        """Return the camera's stamp if it is plausible, otherwise the arrival time."""
        if stamp is None:
            return received
        possible = max(self._stamp, received - OLDEST) <= stamp <= received
        if not possible and not self._doubting:
            text = f"stamp differs by {(stamp - received) / SECOND:+.3f} s from arrival: arrival times are used"
            self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, text)
        self._doubting = not possible
        return stamp if possible else received
