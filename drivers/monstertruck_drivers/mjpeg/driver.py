"""Driver of a camera that sends motion JPEG over a link."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.source import LinkSource
from monstertruck_drivers.webcam.driver import WebcamDriver
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.sensor import CompressedImage


class MjpegDriver(WebcamDriver):
    """Publishes every complete picture, stamped with its arrival minus the configured delay.

    Args:
        config: settings of the camera.
        port: program, TCP port or emulated camera.
        clock: time.
        out: pictures.
        events: deviating sizes, rejected pictures.
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
        """Serve one session; it is ready with its first whole picture.

        Raises:
            DeviceLostError: the program cannot be started, or it ended; no server, or it closed the connection.
            DeviceTimeoutError: no picture within ``watchdog``.
            DeviceMismatchError: the server refuses the path.
            WrongDeviceError: the server sends other content than pictures.
            ProtocolError: no HTTP, or no complete picture within that time.
        """
        await super().run(ready)
