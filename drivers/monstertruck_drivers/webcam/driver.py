"""Camera driver: whole pictures become messages, at the camera's own times."""

from typing import Final

from monstertruck_drivers.webcam.config import WebcamConfig
from monstertruck_drivers.webcam.jpeg import complete
from monstertruck_drivers.webcam.source import Frame, FrameSource, FrameStream, Mode
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import CompressedImage

OLDEST: Final = SECOND
"""Nanoseconds a picture may have taken to arrive; its stamp is not believed beyond."""


class WebcamDriver:
    """Publishes every whole picture.

    Args:
        config: mode and watchdog.
        source: the camera: ``V4l2Source`` or ``RenderedSource``.
        clock: time; a real camera's stamps are of CLOCK_MONOTONIC, as the wall clock is.
        out: pictures.
        events: modes that differ, pictures refused, stamps not believed.
        name: service name.
    """

    def __init__(
        self,
        config: WebcamConfig,
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
        self._told_mode: Mode | None = None
        self._refusing = False
        self._doubting = False
        self._stamp = -OLDEST

    async def run(self, ready: Ready) -> None:
        """Serve one session; it is ready with its first whole picture.

        Raises:
            DeviceLostError: no camera, or unplugged.
            PortBusyError: another program streams from it.
            DeviceMismatchError: it has no motion JPEG, or refuses the mode.
            DeviceFaultError: no bandwidth on its hub.
            DeviceTimeoutError: no picture within the watchdog's time.
            ProtocolError: pictures, but no whole one within that time.
        """
        config = self._config
        wanted = Mode(config.width, config.height, config.rate)
        async with await self._source.open(wanted, config.buffers) as stream:
            self._tell_mode(wanted, stream.mode)
            await self._serve(stream, ready)

    def _tell_mode(self, wanted: Mode, granted: Mode) -> None:
        if granted != wanted and granted != self._told_mode:
            text = f"the camera gives {granted}, configured is {wanted}"
            self._events(Reason.DEVICE_MISMATCH, Severity.INFO, self.name, text)
        self._told_mode = granted

    async def _serve(self, stream: FrameStream, ready: Ready) -> None:
        patience = self._config.watchdog
        limit, seen = self._clock.now() + round(patience * SECOND), 0
        while True:
            try:
                async with self._clock.deadline((limit - self._clock.now()) / SECOND):
                    frame = await stream.next()
            except TimeoutError:
                if seen == 0:
                    raise DeviceTimeoutError(f"{self._source.name}: no picture for {patience} s") from None
                raise ProtocolError(f"{self._source.name}: {seen} pictures in {patience} s, none whole") from None
            seen += 1
            if self._publish(frame):
                ready()
                limit, seen = self._clock.now() + round(patience * SECOND), 0

    def _publish(self, frame: Frame) -> bool:
        received = self._clock.now()
        try:
            if frame.damaged:
                raise ValueError("damaged on the bus")
            data = complete(frame.data)
        except ValueError as error:
            if not self._refusing:
                self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, f"picture refused: {error}")
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
        """The camera's stamp if it can be true, else the time of arrival."""
        if stamp is None:
            return received
        possible = max(self._stamp, received - OLDEST) <= stamp <= received
        if not possible and not self._doubting:
            text = f"stamp {(stamp - received) / SECOND:+.3f} s from arrival: arrival times are used"
            self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, text)
        self._doubting = not possible
        return stamp if possible else received
