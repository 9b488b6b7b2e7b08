"""Host side of an I2C bus behind a link."""

import errno
import os
from typing import Final

from monstertruck_drivers.i2c.protocol import I2cAnswer, I2cRequest, Packets
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError

_NOT_ACKNOWLEDGED: Final = frozenset({errno.ENXIO, errno.EREMOTEIO})


class I2cBus:
    """Performs transfers with the devices on one bus, one at a time.

    Args:
        link: open link to the bus.
        clock: time.
        timeout: timeout for one transfer (s).
    """

    def __init__(self, link: Link, clock: Clock, timeout: float) -> None:
        self.name = link.name
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._packets = Packets(I2cAnswer)
        self._number = 0

    async def transfer(self, address: int, data: bytes, count: int = 0) -> bytes:
        """Write ``data``, then read ``count`` bytes after a repeated start; return them.

        Raises:
            DeviceLostError: the bus is gone.
            DeviceTimeoutError: the device does not acknowledge, or the answer did not arrive within the timeout.
        """
        self._number = (self._number + 1) % 256
        self._link.write(bytes(I2cRequest(self._number, address, data, count)))
        answer = await self._answer(address)
        if answer.error in _NOT_ACKNOWLEDGED or (not answer.error and len(answer.data) != count):
            raise DeviceTimeoutError(f"{self.name}: no acknowledgement of address 0x{address:02x}")
        if answer.error == errno.ENODEV:
            raise DeviceLostError(f"{self.name}: the bus was removed")
        if answer.error:
            raise DeviceTimeoutError(f"{self.name}: address 0x{address:02x}: {os.strerror(answer.error)}")
        return answer.data

    def send(self, address: int, data: bytes) -> None:
        """Write ``data`` without waiting for the result, as at the end of a session.

        Raises:
            DeviceLostError: the bus is gone.
        """
        self._number = (self._number + 1) % 256
        self._link.write(bytes(I2cRequest(self._number, address, data, 0)))

    async def _answer(self, address: int) -> I2cAnswer:
        due = self._clock.now() + round(self._timeout * SECOND)
        while True:
            try:
                received = await self._link.read(max((due - self._clock.now()) / SECOND, 0.0))
            except TimeoutError:
                raise DeviceTimeoutError(
                    f"{self.name}: no answer for address 0x{address:02x} within {self._timeout} s"
                ) from None
            for answer in self._packets.feed(received):
                if answer.number == self._number:
                    return answer
