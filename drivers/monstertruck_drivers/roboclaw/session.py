"""Requests to one RoboClaw and its answers; shared by the driver and `identify`."""

from monstertruck_drivers.link import Link
from monstertruck_drivers.roboclaw.config import RoboclawConfig
from monstertruck_drivers.roboclaw.protocol import (
    COUNTS_SIZE,
    LONGEST_NAME,
    NAME,
    PACKET_GAP,
    RoboclawCommand,
    counts,
    is_intact,
    request,
)
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError


class RoboclawSession:
    """One session.

    Args:
        link: open link.
        clock: time.
        address: the unit's address.
        timeout: maximum time to wait for an answer (s).
    """

    def __init__(self, link: Link, clock: Clock, address: int, timeout: float) -> None:
        self._link = link
        self._clock = clock
        self._address = address
        self._timeout = timeout

    async def identify(self) -> str:
        """Return the unit's version text.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit does not answer.
            WrongDeviceError: another device answers.
        """
        heard = b""
        for _ in range(3):
            answer = await self._text()
            heard = answer or heard
            asked = request(self._address, RoboclawCommand.VERSION)
            if is_intact(asked, answer) and NAME in answer.lower():
                return answer.partition(b"\n")[0].decode("ascii", "backslashreplace")
            # A host that died may have left half a request, which the unit drops after a pause.
            await self._clock.sleep(2 * PACKET_GAP)
        if not heard:
            raise DeviceTimeoutError(f"{self._link.name}: silent; expected a RoboClaw at address {self._address}")
        raise WrongDeviceError(f"{self._link.name}: {heard.hex(' ')} is not the answer of a RoboClaw")

    async def counts(self) -> tuple[int, int]:
        """Read both counters.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the answer did not arrive in time.
            ProtocolError: the answer is damaged.
        """
        asked = request(self._address, RoboclawCommand.COUNTS)
        self._link.discard()
        self._link.write(asked)
        try:
            answer = await self._link.exactly(COUNTS_SIZE, self._timeout)
        except TimeoutError:
            raise DeviceTimeoutError(f"{self._link.name}: the RoboClaw does not answer") from None
        if not is_intact(asked, answer):
            raise ProtocolError(f"{self._link.name}: answer {answer.hex(' ')} has a wrong CRC")
        return counts(answer)

    async def _text(self) -> bytes:
        """Return the answer to a version request."""
        self._link.discard()
        self._link.write(request(self._address, RoboclawCommand.VERSION))
        answer, until = b"", self._clock.now() + round(self._timeout * SECOND)
        while len(answer) <= LONGEST_NAME and not is_intact(request(self._address, RoboclawCommand.VERSION), answer):
            try:
                answer += await self._link.read(max(until - self._clock.now(), 0) / SECOND)
            except TimeoutError:
                break
        return answer


async def identify(link: Link, clock: Clock, settings: RoboclawConfig) -> dict[str, object]:
    """Read the version and both counters.

    Returns:
        JSON-compatible dict: ``version`` and ``counts`` (inputs 1 and 2).

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = RoboclawSession(link, clock, settings.address, settings.answer_timeout)
    return {"version": await session.identify(), "counts": list(await session.counts())}
