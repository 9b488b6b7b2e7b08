"""Take a picture from a camera on a port."""

from monstertruck_drivers.link import Link
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.source import LinkSource
from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.clock import Clock


class _OpenPort:
    """Port whose link is already open."""

    def __init__(self, link: Link) -> None:
        self.name = link.name
        self._link = link

    async def open(self) -> Link:
        return self._link


async def identify(link: Link, clock: Clock, settings: MjpegConfig) -> dict[str, object]:
    """Take one picture.

    Returns:
        JSON-compatible dict: ``width`` and ``height`` (pixels), ``bytes``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    source = LinkSource(settings, _OpenPort(link), clock)
    async with await source.open(Mode(settings.width, settings.height, settings.rate), settings.buffers) as stream:
        frame = await stream.next()
    return {"width": stream.mode.width, "height": stream.mode.height, "bytes": len(frame.data)}
