"""List the cameras with their formats, sizes and rates."""

from typing import Any

from monstertruck_drivers.webcam import protocol as v4l2
from monstertruck_drivers.webcam.config import WebcamConfig
from monstertruck_drivers.webcam.v4l2_source import Kernel, asked, enumerate_formats, enumerate_modes
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceError
from monstertruck_runtime.threads import Offload, in_thread


async def identify(
    pattern: str,
    clock: Clock,
    settings: WebcamConfig,
    kernel: Kernel | None = None,
    offload: Offload = in_thread,
) -> dict[str, Any]:
    """Query every node that matches ``pattern``, without streaming.

    Returns:
        JSON-compatible dict: ``nodes``, each with path, driver, card, bus, whether it captures, pixel formats, and the
        sizes and rates for motion JPEG, or with the query error.
    """
    system = kernel or Kernel()
    return await offload(lambda: {"nodes": [_describe(path, system) for path in system.nodes(pattern)]})


def _describe(path: str, kernel: Kernel) -> dict[str, Any]:
    try:
        with asked(path, kernel) as (fd, node):
            formats = enumerate_formats(fd, kernel) if node.captures else []
            modes = enumerate_modes(fd, kernel) if v4l2.MJPG in formats else []
    except DeviceError as error:
        return {"path": path, "error": str(error)}
    return {
        "path": path,
        "driver": node.driver,
        "card": node.card,
        "bus": node.bus,
        "captures": node.captures,
        "formats": [v4l2.fourcc(pixel_format) for pixel_format in formats],
        "mjpg_modes": [{"width": m.width, "height": m.height, "rate": round(m.rate, 2)} for m in modes],
    }
