"""Receives from an OS4000 and configures it over one open link; shared by the driver and `identify`."""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

from monstertruck_drivers.link import Link
from monstertruck_drivers.os4000 import protocol
from monstertruck_drivers.os4000.config import Os4000Config
from monstertruck_drivers.os4000.protocol import FORMAT_TAGGED, Fields, Key, Os4000Parser, Sentence, is_other_format
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, WrongDeviceError

LISTEN: Final = 1.2
"""Time limit for the first sentence of a streaming unit (s); longer than its pause after a setting."""
LEAVE: Final = b"\x1b\r"
"""ESC leaves a command. If none is open, ESC opens one, and CR, which is not a key, leaves it."""


class Os4000Session:
    """One session.

    Args:
        link: open link, at the unit's baud rate.
        clock: time.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.parser = Os4000Parser()
        self.stream = DeviceStream(link, clock, self.parser.feed)
        """Stream of sentences."""
        self._link = link
        self._clock = clock

    async def listen(self, seconds: float, count: int = 6) -> list[tuple[int, Sentence]]:
        """Collect sentences with their arrival times until ``count`` have arrived or ``seconds`` have passed."""
        heard: list[tuple[int, Sentence]] = []
        try:
            async with self._clock.deadline(seconds):
                while len(heard) < count:
                    heard += [(self._clock.now(), sentence) for sentence in await self.stream.next()]
        except TimeoutError:
            pass
        return heard

    async def start(self, rate: int, may_set: Callable[[Key], bool] = lambda _: True) -> list[tuple[int, Sentence]]:
        """Make the unit send sentences, whatever state it was left in.

        The unit may stream, wait inside an unfinished command, have its output switched off (a stored setting), or
        print another format. The session writes only to a silent unit or to one that prints another known format. It
        tries only the port's baud rate, because a port cannot change its rate.

        Args:
            rate: sentence rate to set if the output is off (Hz).
            may_set: called before a setting is written; returns whether writing is allowed.

        Returns:
            At least one sentence, each with its arrival time.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit is silent.
            WrongDeviceError: bytes arrive, but no OS4000 sentence.
        """
        # The content of a half-typed command must not become its value: leave the command before ending anything.
        set_rate = protocol.key(Key.RATE) + protocol.value(rate)
        remedies = [LEAVE, b"\r", set_rate]
        heard = await self.listen(LISTEN)
        if not heard and any(is_other_format(line) for line in self.parser.text):
            if may_set(Key.FORMAT):
                await self.set(Key.FORMAT, FORMAT_TAGGED)
            heard = await self.listen(LISTEN)
        silent = self.stream.bytes_heard == 0
        while not heard and remedies and silent:
            remedy = remedies.pop(0)
            if remedy is not set_rate or may_set(Key.RATE):
                self._link.write(remedy)
                heard = await self.listen(LISTEN)
        if heard:
            return heard
        name = self._link.name
        if heard_bytes := self.stream.bytes_heard:
            raise WrongDeviceError(
                f"{name}: {heard_bytes} bytes, but no OS4000 sentence: another device, or another baud rate "
                f"than the unit's ({', '.join(map(str, protocol.BAUDS))}; {protocol.FACTORY_BAUD} from the factory)"
            )
        raise DeviceTimeoutError(
            f"{name}: silent; expected an OS4000 that streams at its baud rate (factory default "
            f"{protocol.FACTORY_BAUD})"
        )

    async def set(self, command: Key, number: int) -> None:
        """Write one setting and return to streaming.

        The terminator of a value may depend on the firmware version: the session sends a space, then CR, and finally
        ESC to leave the command.

        Raises:
            DeviceLostError: the unit was unplugged.
        """
        self._link.write(protocol.key(command))
        await self.listen(0.3, count=1000)  # seconds to wait for the prompt of a command
        for end in (protocol.value(number), b"\r", LEAVE):
            self._link.write(end)
            if await self.listen(LISTEN, count=1):
                return

    async def ask(self, command: Key, seconds: float = 0.5) -> list[str]:
        """Return the text that an immediate command prints."""
        self.parser.text = []
        self._link.write(protocol.key(command))
        await self.listen(seconds, count=1000)
        return [line.decode("ascii", "backslashreplace") for line in self.parser.text]


def observed_fields(heard: list[tuple[int, Sentence]]) -> Fields:
    """Return all fields received; a field may be empty in individual sentences."""
    mask = Fields(0)
    for _, sentence in heard:
        mask |= sentence.fields
    return mask


def observed_rate(heard: list[tuple[int, Sentence]]) -> float | None:
    """Return the sentence rate (Hz) from the median interval, robust to a lost sentence or a burst; None if too few."""
    times = [time for time, _ in heard]
    intervals = sorted(after - before for before, after in pairwise(times))
    if len(intervals) < 2 or intervals[len(intervals) // 2] == 0:
        return None
    return SECOND / intervals[len(intervals) // 2]


async def identify(link: Link, clock: Clock, settings: Os4000Config) -> dict[str, object]:
    """Receive sentences and request the firmware version; only a silent unit's rate is changed.

    Returns:
        JSON-compatible dict: ``version`` (lines that the unit prints), ``rate`` (Hz), ``fields`` (names), ``sample`` in
        the device's units and signs.

    Raises:
        DeviceTimeoutError: the unit is silent.
        WrongDeviceError: another device answers, or the unit's baud rate differs from the port's.
    """
    session = Os4000Session(link, clock)
    heard = await session.start(20)  # rate that a unit gets whose output is off
    version = await session.ask(Key.VERSION)
    _, sample = heard[-1]
    rate, fields = observed_rate(heard), observed_fields(heard)
    return {
        "version": version,
        "rate": None if rate is None else round(rate, 1),
        "fields": [(bit.name or "").lower() for bit in Fields if bit in fields],
        "sample": {
            "heading_deg": sample.heading,
            "pitch_deg": sample.pitch,
            "roll_deg": sample.roll,
            "temperature_c": sample.temperature,
            "field_mg": sample.field,
            "acceleration_g": sample.acceleration,
        },
    }
