"""Requests to a Maestro and its replies over one open link; shared by the driver and `identify`."""

from monstertruck_drivers.link import Link
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.protocol import CHANNELS, ERROR_MASK, POSITION_MAX, Encoder, error_names, words
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError, ProtocolError, WrongDeviceError


class MaestroSession:
    """One session. Answers carry no identifier: only their number and form can be checked.

    Args:
        link: open link to the Command Port.
        clock: time.
        encoder: protocol form.
        timeout: timeout for the answers to one request (s).
    """

    def __init__(self, link: Link, clock: Clock, encoder: Encoder, timeout: float) -> None:
        self.encode = encoder
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._in_step = True
        """Whether no answer to an earlier request is outstanding."""

    def send(self, *commands: bytes) -> None:
        """Send commands that have no answer.

        Raises:
            DeviceLostError: the unit was unplugged.
        """
        self._link.write(b"".join(commands))

    async def ask(self, *requests: bytes) -> list[int]:
        """Send requests together and collect a 16-bit word for each.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: answers are missing.
        """
        if not self._in_step or self._link.discard():
            await self._resynchronise()
        self._link.write(b"".join(requests))
        try:
            return words(await self._link.exactly(2 * len(requests), self._timeout))
        except TimeoutError:
            self._in_step = False
            raise self._silent() from None

    def _silent(self) -> DeviceTimeoutError:
        return DeviceTimeoutError(f"{self._link.name}: no answer within {self._timeout} s")

    async def _resynchronise(self) -> None:
        """Discard late answers: wait for silence, then for exactly the answer to a request of known length.

        Raises:
            DeviceTimeoutError: the answer is missing, or further bytes arrive.
        """
        self._in_step = False
        # Attempts to resynchronise with the answers.
        for _ in range(4):
            if await self._speaks():
                continue
            self._link.write(self.encode.get_position(0))
            try:
                await self._link.exactly(2, self._timeout)
            except TimeoutError:
                raise self._silent() from None
            if not await self._speaks():
                self._in_step = True
                return
        raise DeviceTimeoutError(f"{self._link.name}: answers remain out of step with requests")

    async def identify(self, *channels: int) -> int:
        """Verify that a Maestro answers by reading its errors and the positions of ``channels``.

        Returns:
            The pending error word, which is now cleared.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit does not answer.
            WrongDeviceError: bytes arrived that a Maestro does not send.
        """
        heard = False
        # Attempts to identify: another program may be writing to a newly plugged port.
        for _ in range(3):
            heard |= await self._speaks()
            try:
                *positions, errors = await self.ask(
                    *(self.encode.get_position(channel) for channel in channels), self.encode.get_errors()
                )
                self.check(positions, errors)
            except DeviceTimeoutError:
                continue
            except ProtocolError:
                heard = True
                continue
            if not await self._speaks():
                return errors
            heard = True
        name = self._link.name
        if heard:
            raise WrongDeviceError(f"{name}: not a Maestro: it sends without being asked, or malformed answers")
        raise DeviceTimeoutError(
            f"{name}: silent; expected a Maestro's Command Port (USB interface 00) in serial mode 'USB "
            "Dual Port' (factory default is UART: set it once with the manufacturer's tool), with "
            "matching CRC setting and device number"
        )

    async def _speaks(self) -> bool:
        """Whether unrequested bytes arrive; these bytes are dropped."""
        try:
            # Silence that ends an answer (s); a Maestro sends nothing without a request.
            async with self._clock.deadline(0.02):
                return bool(await self._link.read())
        except TimeoutError:
            return False

    def check(self, positions: list[int], errors: int) -> None:
        """Reject words that cannot be the requested values.

        Raises:
            ProtocolError: a word is malformed, as after a lost byte.
        """
        if errors > ERROR_MASK or any(position > POSITION_MAX for position in positions):
            raise ProtocolError(f"{self._link.name}: malformed answers: errors {errors:#x}, positions {positions}")

    def require_link(self) -> None:
        """Detect an unplugged device without sending anything.

        Raises:
            DeviceLostError: the link is down.
        """
        if self._link.is_lost:
            raise DeviceLostError(f"{self._link.name}: unplugged")


async def identify(link: Link, clock: Clock, settings: MaestroConfig | MaestroEscConfig) -> dict[str, object]:
    """Read the error word, thereby clearing it, and all channels, using compact commands without CRC.

    Returns:
        JSON-compatible dict: ``errors`` (pending before the read) and ``channels``, which holds the pulse in
        microseconds for each servo (0: off) and the pin voltage for each input.

    Raises:
        DeviceTimeoutError: nothing answers; the message names what to check.
        WrongDeviceError: another device answers.
    """
    session = MaestroSession(link, clock, Encoder(), timeout=0.3)
    errors = await session.identify(0, 1)
    positions = await session.ask(*(session.encode.get_position(channel) for channel in range(CHANNELS)))
    return {
        "errors": error_names(errors),
        "channels": [
            {"channel": channel, "if_servo_us": word / 4, "if_input_v": round(word * 5 / 1023, 3)}
            for channel, word in enumerate(positions)
        ],
    }
