"""Receives from a device that streams without requests."""

from collections.abc import Callable
from typing import Generic, TypeVar

from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError

T = TypeVar("T")


class DeviceStream(Generic[T]):
    """Message stream of one session.

    Args:
        link: open link.
        clock: time.
        parse: takes the received bytes, in chunks of any size, and returns the completed messages.
        batch: number of bytes that justify a wake-up.
    """

    def __init__(self, link: Link, clock: Clock, parse: Callable[[bytes], list[T]], batch: int = 1) -> None:
        self.bytes_heard = 0
        self.arrival = 0
        """Arrival time of the latest bytes (ns); already set when they are parsed."""
        self._link = link
        self._clock = clock
        self._parse = parse
        self._batch = batch

    async def next(self, within: float | None = None) -> list[T]:
        """Return the messages completed by the next bytes, possibly none.

        Args:
            within: maximum wait for the bytes (s); None for no limit.

        Raises:
            DeviceLostError: the device was unplugged.
            DeviceTimeoutError: the device is silent.
        """
        try:
            data = await self._link.read(within, least=self._batch)
        except TimeoutError:
            raise DeviceTimeoutError(f"{self._link.name}: silent for {within:.1f} s") from None
        self.arrival = self._clock.now()
        self.bytes_heard += len(data)
        return self._parse(data)

    async def receive(self, within: float) -> list[T]:
        """Return the completed messages, at least one.

        Args:
            within: maximum wait for a message (s).

        Raises:
            DeviceLostError: the device was unplugged.
            DeviceTimeoutError: the device is silent.
            ProtocolError: bytes arrive, but no complete message.
        """
        heard, name = self.bytes_heard, self._link.name
        until = self._clock.now() + round(within * SECOND)
        while True:
            try:
                messages = await self.next(max(until - self._clock.now(), 0) / SECOND)
            except DeviceTimeoutError:
                self.bytes_heard += self._link.discard()
                if self.bytes_heard == heard:
                    raise DeviceTimeoutError(f"{name}: silent for {within} s") from None
                raise ProtocolError(f"{name}: {self.bytes_heard - heard} bytes, but no measurement") from None
            if messages:
                return messages
            if self._clock.now() >= until:
                raise ProtocolError(f"{name}: {self.bytes_heard - heard} bytes, but no measurement")

    async def first(self, within: float, expected: str) -> list[T]:
        """Return the first messages of a session.

        Args:
            within: maximum wait for a message (s).
            expected: text that ends the message of a ``WrongDeviceError``: the expected device and likely causes.

        Raises:
            DeviceLostError: the device was unplugged.
            DeviceTimeoutError: the device is silent.
            WrongDeviceError: bytes arrive, but no complete message.
        """
        try:
            return await self.receive(within)
        except ProtocolError as error:
            raise WrongDeviceError(f"{error} {expected}") from None
