"""Driver for a camera that sends motion JPEG over a link."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.source import LinkSource
from monstertruck_drivers.webcam.driver import WebcamDriver
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.sensor import CompressedImage


class MjpegDriver(WebcamDriver):
    """Publishes every complete picture, stamped with its arrival time minus the configured delay.

    Args:
        config: camera settings.
        port: program, TCP port or emulated camera.
        clock: time.
        out: pictures.
        events: unexpected picture sizes and rejected pictures.
        name: service name.
    """

    def __init__(
        self,
        config: MjpegConfig,
        port: Port,
        clock: Clock,
        out: Publisher[CompressedImage],
        events: EventSink,
        name: str = "camera",
    ) -> None:
        super().__init__(config, LinkSource(config, port, clock), clock, out, events, name)

    async def run(self, ready: Ready) -> None:
        """Serve one session, which is ready once the first complete picture has arrived.

        Raises:
            DeviceLostError: the program cannot be started or has ended, or the server is absent or closed the
                connection.
            DeviceTimeoutError: no picture arrived within ``watchdog``.
            DeviceMismatchError: the server refuses the path.
            WrongDeviceError: the server sends content other than pictures.
            ProtocolError: the answer is not HTTP, or no complete picture arrived within that time.
        """
        await super().run(ready)
