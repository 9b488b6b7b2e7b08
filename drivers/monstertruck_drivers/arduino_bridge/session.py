"""Commands and answers over one open link to a board; shared by the driver and `identify`."""

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.protocol import (
    BAUD_RATE,
    ENCODERS,
    END,
    OK,
    REFUSED,
    BoardLines,
    counts_of,
    is_number,
    speeds,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError


class BoardSession:
    """One session. Answers carry no identifier, so leftovers of an earlier answer are discarded before each request.

    Args:
        link: open link.
        clock: time.
        timeout: maximum time to wait for an answer (s).
    """

    def __init__(self, link: Link, clock: Clock, timeout: float) -> None:
        self.asked = 0
        """Send time of the latest request (ns)."""
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._lines = BoardLines()
        self._heard = b""

    def send(self, *commands: bytes) -> None:
        """Send commands without waiting for their answers.

        Raises:
            DeviceLostError: the board was unplugged.
        """
        self._link.write(b"".join(commands))

    async def identify(self, boot: float) -> None:
        """Stop the motors and wait until the board answers.

        Args:
            boot: maximum boot time (s).

        Raises:
            DeviceLostError: the board was unplugged.
            DeviceTimeoutError: the board is silent.
            WrongDeviceError: another device answers.
        """
        knock = 0.25  # seconds between two requests to a restarting board
        until = self._clock.now() + round(max(boot, knock) * SECOND)
        while self._clock.now() < until:
            self._forget()
            self.send(END, speeds(0, 0), BAUD_RATE)
            found = await self._collect(knock, 4)
            if OK in found and any(map(is_number, found)):
                return
        name = self._link.name
        if self._heard:
            raise WrongDeviceError(f"{name}: {self._heard[:40]!r} is not an answer of ROSArduinoBridge")
        raise DeviceTimeoutError(f"{name}: silent; expected a board running ROSArduinoBridge")

    async def exchange(self, command: bytes) -> tuple[int, int]:
        """Send a command and read both encoders.

        Raises:
            DeviceLostError: the board was unplugged.
            DeviceTimeoutError: an answer is missing.
            ProtocolError: an answer is invalid.
        """
        self._forget()
        self.asked = self._clock.now()
        self.send(command, ENCODERS)
        found = await self._collect(self._timeout, 2)
        if len(found) < 2:
            raise DeviceTimeoutError(f"{self._link.name}: {len(found)} of 2 answers within {self._timeout} s")
        counts = counts_of(found[1])
        if found[0] != OK or counts is None:
            raise ProtocolError(f"{self._link.name}: answers {found[0]!r} and {found[1]!r}: expected OK and two counts")
        return counts

    def _forget(self) -> None:
        if self._link.discard():
            self._lines = BoardLines()

    async def _collect(self, within: float, count: int) -> list[bytes]:
        """Collect up to ``count`` lines within ``within`` seconds; ignore empty lines and rejections of noise."""
        found: list[bytes] = []
        due = self._clock.now() + round(within * SECOND)
        while len(found) < count and (left := due - self._clock.now()) > 0:
            try:
                data = await self._link.read(left / SECOND)
            except TimeoutError:
                break
            self._heard = data or self._heard
            found += [line for line in self._lines.feed(data) if line and line != REFUSED]
        return found


async def identify(link: Link, clock: Clock, settings: ArduinoBridgeConfig) -> dict[str, object]:
    """Read both counters; stopping the motors identifies the board.

    Returns:
        JSON-compatible dict: ``counts`` (left, right).

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = BoardSession(link, clock, settings.answer_timeout)
    await session.identify(settings.boot)
    return {"counts": list(await session.exchange(speeds(0, 0)))}
