"""Which converters are there, and what do they read."""

from typing import Any

from monstertruck_drivers.battery import iio
from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.computer import Computer
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceError


async def probe(computer: Computer, clock: Clock, settings: IioConfig | None = None) -> dict[str, Any]:
    """Read every voltage input of every converter once.

    Returns:
        JSON-able: ``converters``: name, path, and per channel the reading and the volts at the pin, or why not.
    """
    root = computer.root / iio.CONVERTERS
    return await computer.machine.offload(
        lambda: {"converters": [_describe(converter) for converter in iio.converters(root)]}
    )


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
