"""Wait for a picture of a camera on a port."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.mjpeg.config import MjpegConfig
from monstertruck_drivers.mjpeg.source import LinkSource
from monstertruck_drivers.webcam.source import Mode
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: MjpegConfig | None = None) -> dict[str, object]:
    """Take one picture.

    Returns:
        JSON-able: ``device``, ``port``, ``width`` and ``height`` (pixels), ``bytes``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    config = settings or MjpegConfig()
    source = LinkSource(config, port, clock)
    async with await source.open(Mode(config.width, config.height, config.rate), config.buffers) as stream:
        frame = await stream.next()
    size = stream.mode
    return {
        "device": "camera with motion JPEG",
        "port": source.name,
        "width": size.width,
        "height": size.height,
        "bytes": len(frame.data),
    }
