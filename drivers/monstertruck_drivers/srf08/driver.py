"""SRF08 driver: groups of sonars fire in turn, and every round yields one message."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.srf08 import protocol
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_drivers.srf08.protocol import RANGE_IN_MICROSECONDS, Srf08Register
from monstertruck_drivers.srf08.session import Srf08Session
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import DeviceTimeoutError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SonarEcho, SonarRanges

LATER = 0.004
"""Time from the end of ranging to the first request, and between two requests (s)."""


class Srf08Driver:
    """Fires and reads the sonars, and sets their gain and range, which they lose at power-off.

    A sonar that does not answer, or repeats the same flight time to the microsecond, is reported as not answering; the
    other sonars continue.

    Args:
        config: sonars, groups, limits.
        port: the USB-ISS's port.
        clock: time.
        out: ranges.
        events: sonars lost and returned.
        name: service name.
    """

    def __init__(
        self,
        config: Srf08Config,
        port: Port,
        clock: Clock,
        out: Publisher[SonarRanges],
        events: EventSink,
        name: str = "sonar",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._events = events
        self._setting = protocol.range_setting(config.range_max)
        self._set_up: set[str] = set()
        """Sonars whose gain and range are set."""
        self._silent: set[str] = set()
        """Sonars whose loss was reported."""
        self._equal: dict[str, tuple[int, int]] = {}
        """Latest echo of each sonar (us), and its number of consecutive repetitions."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the USB-ISS was unplugged.
            DeviceTimeoutError: the USB-ISS does not answer, or no sonar does.
            ProtocolError: answers do not match the requests.
            WrongDeviceError: another device answers.
            PortBusyError: another process holds the port.
        """
        config = self._config
        async with await self._port.open() as link:
            session = Srf08Session(link, config.timeout)
            await session.start()
            self._set_up.clear()
            schedule = Schedule(self._clock, config.rate * len(config.groups))
            heard = self._clock.now()
            serving = False
            while True:
                echoes: dict[str, SonarEcho] = {}
                for group in config.groups:
                    await schedule.next()
                    echoes |= await self._ping(session, group)
                if any(echo.answered for echo in echoes.values()):
                    heard = self._clock.now()
                    if not serving:
                        serving = True
                        ready()
                elif self._clock.now() - heard > config.silence * SECOND:
                    raise DeviceTimeoutError(f"{self._port.name}: no sonar answers for {config.silence} s")
                self._publish(echoes)

    async def _ping(self, session: Srf08Session, group: tuple[str, ...]) -> dict[str, SonarEcho]:
        """Fire a group, wait for its echoes, and read them."""
        fired: dict[str, int | None] = {}
        for name in group:
            fired[name] = await self._fire(session, name)
        sent = self._clock.now()
        await self._clock.sleep_until(sent + round((protocol.ranging_time(self._setting) + LATER) * SECOND))
        return {name: await self._echo(session, name, at, sent) for name, at in fired.items()}

    async def _fire(self, session: Srf08Session, name: str) -> int | None:
        """Fire a sonar and return the time of the ping; None if the sonar does not accept the command."""
        address = self._config.sonars[name].address
        if name not in self._set_up:
            for register, value in ((Srf08Register.GAIN, self._config.gain), (Srf08Register.RANGE, self._setting)):
                if not await session.set(address, register, value):
                    return None
            self._set_up.add(name)
        taken = await session.set(address, Srf08Register.COMMAND, RANGE_IN_MICROSECONDS)
        return self._clock.now() if taken else None

    async def _echo(self, session: Srf08Session, name: str, at: int | None, asked: int) -> SonarEcho:
        reading = None
        if at is not None:
            address = self._config.sonars[name].address
            reading = await session.read(address)
            if not reading.present:
                await self._clock.sleep(LATER)
                reading = await session.read(address)
        if at is None or reading is None or not reading.present:
            self._lost(name, "does not answer")
            return SonarEcho(name=name, answered=False, stamp=asked)
        if self._is_stuck(name, reading.microseconds):
            self._lost(name, f"repeats {reading.microseconds} us")
            return SonarEcho(name=name, answered=False, stamp=at)
        self._returned(name)
        distance = reading.microseconds * 1e-6 * self._config.speed_of_sound / 2
        if not 0 < distance <= self._config.range_max:
            return SonarEcho(name=name, stamp=at)
        return SonarEcho(name=name, range=distance, stamp=at + reading.microseconds * 500)

    def _is_stuck(self, name: str, microseconds: int) -> bool:
        before, count = self._equal.get(name, (0, 0))
        count = count + 1 if microseconds and microseconds == before else 1
        self._equal[name] = microseconds, count
        return count >= self._config.stuck_after

    def _lost(self, name: str, why: str) -> None:
        self._set_up.discard(name)  # it may have lost its supply
        if name not in self._silent:
            self._silent.add(name)
            self._events(Reason.DEVICE_FAULT, Severity.WARNING, self.name, f"sonar {name} {why}", sonar=name)

    def _returned(self, name: str) -> None:
        if name in self._silent:
            self._silent.discard(name)
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, f"sonar {name} measures again", sonar=name)

    def _publish(self, echoes: dict[str, SonarEcho]) -> None:
        self._out.put(
            SonarRanges(
                stamp=min(echo.stamp for echo in echoes.values()),
                received=self._clock.now(),
                seq=self._out.next_seq(),
                sonars=tuple(echoes[name] for name in self._config.sonars),
                field_of_view=self._config.field_of_view,
                range_min=self._config.range_min,
                range_max=self._config.range_max,
            )
        )
