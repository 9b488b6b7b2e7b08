"""Listening to a device that sends without being asked."""

from collections.abc import Callable
from typing import Generic, TypeVar

from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError

T = TypeVar("T")


class DeviceStream(Generic[T]):
    """Messages of one session.

    Args:
        link: open link.
        clock: time.
        parse: takes the bytes that came, however they are cut, and returns the messages that became complete.
    """

    def __init__(self, link: Link, clock: Clock, parse: Callable[[bytes], list[T]]) -> None:
        self.bytes_heard = 0
        self._link = link
        self._clock = clock
        self._parse = parse

    async def receive(self, within: float) -> list[T]:
        """Return the messages that became complete, at least one.

        Args:
            within: seconds to wait for one.

        Raises:
            DeviceLostError: unplugged.
            DeviceTimeoutError: silence.
            ProtocolError: bytes, but no message.
        """
        heard, name = self.bytes_heard, self._link.name
        until = self._clock.now() + round(within * SECOND)
        while True:
            try:
                data = await self._link.read(max(until - self._clock.now(), 0) / SECOND)
            except TimeoutError:
                if self.bytes_heard == heard:
                    raise DeviceTimeoutError(f"{name}: silent for {within} s") from None
                raise ProtocolError(f"{name}: {self.bytes_heard - heard} bytes, but no measurement") from None
            self.bytes_heard += len(data)
            if messages := self._parse(data):
                return messages
            if self._clock.now() >= until:
                raise ProtocolError(f"{name}: {self.bytes_heard - heard} bytes, but no measurement")
