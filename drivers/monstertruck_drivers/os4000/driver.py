"""Compass driver: converts the unit's stream into attitudes."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.os4000.attitude import to_attitude
from monstertruck_drivers.os4000.config import NEEDED, Os4000Config
from monstertruck_drivers.os4000.protocol import Fields, Key, Sentence
from monstertruck_drivers.os4000.session import LISTEN, Os4000Session, observed_fields, observed_rate
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude


class Os4000Driver:
    """Receives the unit's stream; writes a setting only if the unit deviates from the configuration.

    The driver does not search for the baud rate: the port opens at its configured rate, and a unit at another rate
    yields bytes without a valid sentence. Stamps are arrival times minus ``config.delay``; the unit has no clock.

    Args:
        config: rate, fields and checks.
        port: the compass's port.
        clock: time.
        out: attitudes with REP 103 signs.
        events: written settings and rejected sentences.
        name: service name.
    """

    def __init__(
        self,
        config: Os4000Config,
        port: Port,
        clock: Clock,
        out: Publisher[Attitude],
        events: EventSink,
        name: str = "compass",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._events = events
        self._refusing = False
        self._written: dict[Key, int] = {}
        """Time when each setting was written (ns)."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit is silent.
            ProtocolError: bytes arrive without a valid sentence, or sentences lack heading, pitch or roll.
            WrongDeviceError: the first bytes contain no OS4000 sentence.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            session = Os4000Session(link, self._clock)
            await self._set_up(session)
            ready()
            await self._serve(session)

    async def _set_up(self, session: Os4000Session) -> None:
        heard = await session.start(self._config.rate, self._may_write)
        wrong = self._differences(heard)
        # Readings of the stream that must agree before a setting is written: one may fall into a pause of the host.
        looks = 2
        for _ in range(looks - 1):
            if not wrong:
                return
            heard = await session.listen(LISTEN)
            wrong = {key: what for key, what in self._differences(heard).items() if key in wrong}
        for key, (number, text) in wrong.items():
            if self._may_write(key):
                self._events(Reason.DEVICE_MISMATCH, Severity.INFO, self.name, f"{text}: setting it")
                await session.set(key, number)
                heard = await session.listen(LISTEN)
        missing = NEEDED & ~observed_fields(heard)
        if missing:
            raise ProtocolError(
                f"{self._port.name}: the compass does not send {_names(missing)}, although configured to"
            )
        for _, text in self._differences(heard).values():
            self._events(Reason.DEVICE_MISMATCH, Severity.WARNING, self.name, f"{text} even after setting it")

    def _may_write(self, key: Key) -> bool:
        """Whether a setting may still be written; marks the setting as written."""
        now, before = self._clock.now(), self._written.get(key)
        # Minimum interval between two writes of one setting (s): the memory wears, and each write pauses the stream.
        setting_period = 3600.0
        if before is not None and now - before < setting_period * SECOND:
            return False
        self._written[key] = now
        return True

    def _differences(self, heard: list[tuple[int, Sentence]]) -> dict[Key, tuple[int, str]]:
        """Settings that differ from the configuration: configured value and description by key."""
        config = self._config
        wrong: dict[Key, tuple[int, str]] = {}
        fields = observed_fields(heard)
        if fields != config.fields:
            text = f"the compass sends {_names(fields)}, expected {_names(Fields(config.fields))}"
            wrong[Key.FIELDS] = config.fields, text
        rate = observed_rate(heard)
        rate_tolerance = 0.25  # tolerance of the observed rate, as a fraction of the configured rate
        if rate is None or abs(rate / config.rate - 1) > rate_tolerance:
            seen = "too rarely" if rate is None else f"{rate:.1f} times a second"
            wrong[Key.RATE] = config.rate, f"the compass sends {seen}, expected {config.rate}"
        return wrong

    async def _serve(self, session: Os4000Session) -> None:
        timeout = round(self._config.timeout * SECOND)
        stream = session.stream
        limit, heard = self._clock.now() + timeout, stream.bytes_heard
        while True:
            try:
                sentences = await stream.next(max(limit - self._clock.now(), 0) / SECOND)
            except DeviceTimeoutError:
                if stream.bytes_heard == heard:
                    raise DeviceTimeoutError(f"{self._port.name}: silent for {self._config.timeout} s") from None
                raise ProtocolError(
                    f"{self._port.name}: {stream.bytes_heard - heard} bytes, but no usable sentence "
                    f"for {self._config.timeout} s"
                ) from None
            if self._publish(sentences):
                limit, heard = self._clock.now() + timeout, stream.bytes_heard

    def _publish(self, sentences: list[Sentence]) -> bool:
        """Publish the usable sentences; the stamps of sentences that arrive in one burst are spaced by the period."""
        received = self._clock.now()
        newest = received - round(self._config.delay * SECOND)
        usable = False
        for age, sentence in reversed(list(enumerate(reversed(sentences)))):
            stamp = newest - age * SECOND // self._config.rate
            try:
                attitude = to_attitude(sentence, self._config, stamp, received, self._out.next_seq())
            except ValueError as error:
                if not self._refusing:
                    self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, f"sentence rejected: {error}")
                self._refusing = True
                continue
            self._refusing = False
            self._out.put(attitude)
            usable = True
        return usable


def _names(fields: Fields) -> str:
    return "+".join((bit.name or "").lower() for bit in Fields if bit in fields) or "nothing"
