"""Which converters are there, and what do they read."""

from pathlib import Path
from typing import Any

from monstertruck_drivers.battery import iio
from monstertruck_runtime.errors import DeviceError
from monstertruck_runtime.threads import Offload, in_thread


async def probe(root: Path = iio.ROOT, offload: Offload = in_thread) -> dict[str, Any]:
    """Read every voltage input of every converter once.

    Returns:
        JSON-able: ``converters``: name, path, and per channel the reading and the volts at the pin, or why not.
    """
    return await offload(lambda: {"converters": [_describe(converter) for converter in iio.converters(root)]})


def _describe(converter: iio.Converter) -> dict[str, Any]:
    return {
        "name": converter.name,
        "path": str(converter.path),
        "channels": [_read(converter, number) for number in converter.channels()],
    }


def _read(converter: iio.Converter, number: int) -> dict[str, Any]:
    try:
        channel = iio.channel(converter, number)
        raw = channel.read()
    except DeviceError as error:
        return {"channel": number, "error": str(error)}
    return {"channel": number, "raw": raw, "volts": round(channel.volts(raw), 4), "full_scale": channel.full_scale}
