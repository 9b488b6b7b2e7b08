"""Device side of an emulated I2C bus."""

import errno
from collections.abc import Callable
from typing import Final

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.i2c.protocol import I2cAnswer, I2cRequest, Packets

BUS_RATE: Final = 100_000
"""Clock of the bus (Hz): standard mode, as on a Raspberry Pi that is not configured otherwise."""

Transfer = Callable[[int, bytes, int], bytes | None]
"""Takes address, bytes written and number of bytes to read; returns them, or None if no device acknowledges."""


async def serve(end: DeviceEnd, transfer: Transfer) -> None:
    """Serve transfers until cancelled, at the speed of the bus."""
    packets = Packets(I2cRequest)
    while True:
        for request in packets.feed(await end.read()):
            found = transfer(request.address, request.data, request.size)
            answer = I2cAnswer(request.number, errno.EREMOTEIO if found is None else 0, found or b"")
            # 9 bits a byte, with its acknowledgement; an address before each direction
            length = 9 * (len(request.data) + request.size + 1 + bool(request.size))
            end.write(bytes(answer), length / BUS_RATE)
