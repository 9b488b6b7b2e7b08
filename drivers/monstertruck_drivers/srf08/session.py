"""Requests to a USB-ISS and its sonars, and their replies; shared by the driver and `identify`."""

from monstertruck_drivers.link import Link
from monstertruck_drivers.srf08 import protocol
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_drivers.srf08.protocol import ACK, ADDRESSES, MODULE, READ_SIZE, Srf08Reading
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError


class Srf08Session:
    """One session.

    Args:
        link: open link.
        timeout: maximum time to wait for an answer (s).
    """

    def __init__(self, link: Link, timeout: float) -> None:
        self._link = link
        self._timeout = timeout

    async def ask(self, command: bytes, size: int) -> bytes:
        """Send a command and return its answer.

        Raises:
            DeviceLostError: the USB-ISS was unplugged.
            DeviceTimeoutError: the answer did not arrive within the timeout.
            ProtocolError: unrequested bytes arrived.
        """
        if count := self._link.discard():
            raise ProtocolError(f"{self._link.name}: {count} unexpected bytes: answers are out of step with requests")
        self._link.write(command)
        try:
            return await self._link.exactly(size, self._timeout)
        except TimeoutError:
            raise DeviceTimeoutError(f"{self._link.name}: the USB-ISS does not answer") from None

    async def start(self) -> int:
        """Identify the USB-ISS and set it to I2C mode; return its firmware version.

        Raises:
            DeviceLostError: the USB-ISS was unplugged.
            DeviceTimeoutError: the USB-ISS does not answer.
            WrongDeviceError: another device answers.
            ProtocolError: the USB-ISS refuses the mode.
        """
        answer = b""
        attempts = 3  # a host that died may have left half a command, which the USB-ISS drops after a pause
        for attempt in range(attempts):
            self._link.discard()
            try:
                answer = await self.ask(protocol.VERSION, 3)
                break
            except DeviceTimeoutError:
                if self._link.discard():
                    answer = b"?"
                if attempt == attempts - 1 and not answer:
                    raise
        if len(answer) != 3 or answer[0] != MODULE:
            raise WrongDeviceError(f"{self._link.name}: {answer.hex(' ')} is not the answer of a USB-ISS")
        self._link.discard()
        mode = await self.ask(protocol.SET_MODE, 2)
        if mode[0] != ACK:
            raise ProtocolError(f"{self._link.name}: the USB-ISS refuses I2C mode: {mode.hex(' ')}")
        return answer[1]

    async def set(self, address: int, register: int, value: int) -> bool:
        """Write a register; return False if no module acknowledged."""
        return (await self.ask(protocol.write(address, register, value), 1))[0] != 0

    async def read(self, address: int) -> Srf08Reading:
        """Read the registers of a module."""
        return protocol.parse_reading(await self.ask(protocol.read(address), READ_SIZE))


async def identify(link: Link, clock: Clock, settings: Srf08Config) -> dict[str, object]:
    """Read the version of the USB-ISS and the software revision at every address.

    Returns:
        JSON-compatible dict: ``firmware`` of the USB-ISS, ``sonars`` (address to software revision).

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = Srf08Session(link, settings.timeout)
    firmware = await session.start()
    readings = {address: await session.read(address) for address in ADDRESSES}
    return {
        "firmware": firmware,
        "sonars": {str(address): reading.revision for address, reading in readings.items() if reading.present},
    }
