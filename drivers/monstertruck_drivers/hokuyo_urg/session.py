"""One conversation with a scanner: waking it from any state, asking, comparing clocks, silencing it."""

import contextlib
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from monstertruck_drivers.hokuyo_urg.clock_map import Anchor
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.protocol import (
    Reply,
    ScipParser,
    StatusMeaning,
    classify,
    decode_counter,
    line_sum,
    request,
    sum_matches,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)


@dataclass(frozen=True, slots=True)
class LidarIdentity:
    """Answer to VV (or V)."""

    vendor: str
    product: str
    firmware: str
    protocol: str
    serial: str


@dataclass(frozen=True, slots=True)
class Parameters:
    """Answer to PP: everything the geometry of a scan follows from."""

    model: str
    least_mm: int
    """Values below are error codes."""
    greatest_mm: int
    steps_per_turn: int
    first_step: int
    """First step that measures."""
    last_step: int
    front_step: int
    """Step that looks straight ahead."""
    rpm: int

    @property
    def period(self) -> float:
        """Seconds of one revolution."""
        return 60.0 / self.rpm

    @property
    def step_time(self) -> float:
        """Seconds between neighbouring steps."""
        return self.period / self.steps_per_turn

    def angle(self, step: float) -> float:
        """Direction of a step, rad, counter-clockwise from straight ahead."""
        return (step - self.front_step) * 2.0 * math.pi / self.steps_per_turn


@dataclass(frozen=True, slots=True)
class InternalState:
    """Answer to II."""

    laser_on: bool
    speed: str
    mode: str
    counter: int
    """Milliseconds, 24 bits."""
    status: str


SCIP1_PARAMETERS: Final = Parameters("URG-04LX", 20, 4095, 1024, 44, 725, 384, 600)
"""URG-04LX of firmware below 3, which has no PP to ask; 4095 mm is the most its encoding holds."""


def parse_fields(lines: list[bytes], *, sums: bool = True) -> dict[str, str]:
    """``KEY:value;`` lines as a mapping.

    A wrong sum on SERI is accepted (some units send it so), and one that leaves out what follows ``<-`` (some models'
    II).

    Raises:
        ProtocolError: another line with a wrong sum, or not of this form.
    """
    fields: dict[str, str] = {}
    for line in lines:
        key, colon, value = line.partition(b":")
        if not colon or len(key) != 4:
            raise ProtocolError(f"SCIP: expected 'KEY:value', got {line!r}")
        if sums:
            note = line.partition(b"<-")[0]
            if not (sum_matches(line) or sum_matches(note + line[-1:]) or key == b"SERI"):
                raise ProtocolError(f"SCIP: bad checksum in {line!r}")
            value = value[:-1]
        fields[key.decode("latin-1")] = value.removesuffix(b";").decode("latin-1").strip()
    return fields


def build_fields(fields: Mapping[str, str | int]) -> list[bytes]:
    """Lines ``KEY:value;`` as firmware 3.1 sends them: the ``;`` is left out of the sum."""
    lines = []
    for key, value in fields.items():
        text = f"{key}:{value}".encode("latin-1")
        lines.append(text + b";" + bytes((line_sum(text),)))
    return lines


def parse_identity(fields: dict[str, str]) -> LidarIdentity:
    """Fields of VV; a missing one is empty, as old units leave some out."""
    return LidarIdentity(*(fields.get(key, "") for key in ("VEND", "PROD", "FIRM", "PROT", "SERI")))


def parse_parameters(fields: dict[str, str]) -> Parameters:
    """Fields of PP.

    Raises:
        ProtocolError: a field is missing, no number, or the geometry is impossible.
    """
    try:
        numbers = [int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")]
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: PP has no number for {error}") from error
    found = Parameters(fields.get("MODL", ""), *numbers)
    sound = (
        0 <= found.least_mm < found.greatest_mm
        and 0 <= found.first_step < found.last_step < found.steps_per_turn
        and found.rpm > 0
    )
    if not sound:
        raise ProtocolError(f"SCIP: PP states an impossible geometry: {found}")
    return found


def parse_state(fields: dict[str, str]) -> InternalState:
    """Fields of II.

    Raises:
        ProtocolError: no hexadecimal TIME.
    """
    try:
        counter = int(fields["TIME"], 16)
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"SCIP: II has no hexadecimal TIME: {error}") from error
    return InternalState(
        laser_on=fields.get("LASR", "") == "ON",
        speed=fields.get("SCSP", ""),
        mode=fields.get("MESM", ""),
        counter=counter,
        status=fields.get("STAT", ""),
    )


LISTEN = 0.05
"""Seconds whose bytes are thrown away after opening."""
WAKE_TIMEOUT = 0.5
"""Seconds for the answer to one QT while anything may still be streaming."""
WAKE_ATTEMPTS = 4
"""One QT completes a half line, three may stay unanswered."""
QUIET = 0.15
"""Seconds of silence that prove a stream has ended."""
DRAIN_LIMIT = 2.0
ANSWER_LIMIT = 2.0
"""Seconds for a whole answer, also over a slow RS232 line."""
STOP_TIMEOUT = 0.3


class Dialect(StrEnum):
    """Language of the sensor."""

    SCIP1 = "SCIP 1.1"
    SCIP2 = "SCIP 2.0"


@dataclass(frozen=True, slots=True)
class Sensor:
    """What the handshake found."""

    dialect: Dialect
    identity: LidarIdentity
    parameters: Parameters
    state: InternalState | None
    """None in SCIP 1.1."""


class ScipSession:
    """Asks one thing at a time over an open link."""

    def __init__(self, link: Link, clock: Clock, config: HokuyoConfig) -> None:
        self.parser = ScipParser()
        self.arrival = 0
        """When the newest bytes came, ns."""
        self._link = link
        self._clock = clock
        self._config = config
        self._replies: deque[Reply] = deque()
        self._heard = False
        self._dialect = Dialect.SCIP2

    async def next_reply(self, seconds: float) -> Reply:
        """The next reply, whatever it answers.

        Raises:
            DeviceTimeoutError: none was complete within ``seconds``.
            DeviceLostError: the link went down.
        """
        end = self._clock.now() + round(seconds * SECOND)
        try:
            while not self._replies:
                await self._receive(max(end - self._clock.now(), 0) / SECOND)
        except TimeoutError as error:
            raise DeviceTimeoutError(f"{self._link.name}: no reply within {seconds:.2f} s") from error
        return self._replies.popleft()

    async def ask(self, command: str) -> Reply:
        """Send a command and wait for its reply, passing over everything else; a busy sensor is asked twice.

        Raises:
            DeviceTimeoutError: no answer.
            DeviceLostError: the link went down.
        """
        reply = await self._ask_once(command)
        if classify(command, reply.status) is StatusMeaning.BUSY:
            with contextlib.suppress(ProtocolError):
                await self._drain()
            reply = await self._ask_once(command)
        return reply

    async def demand(self, command: str) -> Reply:
        """Like :meth:`ask`, but refuse any status that is not a success.

        Raises:
            DeviceFaultError: the sensor reports a fault.
            ProtocolError: it refuses the command.
        """
        reply = await self.ask(command)
        outcome = classify(command, reply.status)
        if outcome is StatusMeaning.FAULT:
            raise DeviceFaultError(f"{self._link.name}: {command} answered with fault {reply.status}")
        if outcome not in (StatusMeaning.OK, StatusMeaning.ALREADY):
            raise ProtocolError(f"{self._link.name}: {command} refused with status {reply.status}")
        return reply

    async def handshake(self) -> Sensor:
        """Bring the sensor to rest from any state and learn who it is.

        Raises:
            WrongDeviceError: another device, or another unit than configured.
            DeviceTimeoutError: silence.
            ProtocolError: answers against the protocol.
        """
        self._dialect = await self._wake()
        await self._drain()
        if self._dialect is Dialect.SCIP1:
            identity = parse_identity(parse_fields((await self.demand("V")).lines, sums=False))
            sensor = Sensor(self._dialect, identity, SCIP1_PARAMETERS, None)
        else:
            identity = parse_identity(await self._fields("VV", last="SERI"))
            parameters = parse_parameters(await self._fields("PP", last="SCAN"))
            state = parse_state(await self._fields("II", last="STAT"))
            sensor = Sensor(self._dialect, identity, parameters, state)
        self._check(sensor)
        return sensor

    async def compare_clocks(self) -> Anchor | None:
        """Read the sensor's counter in time-adjust mode; the quickest of several exchanges counts.

        Returns:
            None if the sensor refuses that mode.

        Raises:
            ProtocolError: the time is damaged, or the mode is not left.
        """
        if classify("TM0", (await self.ask("TM0")).status) not in (StatusMeaning.OK, StatusMeaning.ALREADY):
            return None
        anchors = []
        for _ in range(self._config.clock_samples):
            sent = self._clock.now()
            reply = await self.ask("TM1")
            received = self._clock.now()
            if classify("TM1", reply.status) is not StatusMeaning.OK:
                break
            counter = decode_counter(reply.lines[0] if reply.lines else b"")
            anchors.append(Anchor(counter, (sent + received) // 2, received - sent))
        await self.demand("TM2")
        return min(anchors, key=lambda anchor: anchor.round_trip, default=None)

    async def stop(self) -> None:
        """Laser off, stream ended; waits briefly for the answer and never fails."""
        with contextlib.suppress(DeviceError, TimeoutError):
            async with self._clock.deadline(STOP_TIMEOUT):
                await self._exchange("QT" if self._dialect is Dialect.SCIP2 else "L0")

    async def reset(self) -> None:
        """RS: everything back to default; never fails."""
        with contextlib.suppress(DeviceError):
            await self._ask_once("RS")

    # Parts

    async def _receive(self, within: float | None = None) -> None:
        data = await self._link.read(within)
        self.arrival = self._clock.now()
        self._heard = True
        self._replies += self.parser.feed(data)

    async def _exchange(self, command: str, silence: float | None = None) -> Reply:
        """Send and wait for the echo; raises TimeoutError after ``silence`` seconds without a byte."""
        self._replies.clear()
        self._link.write(request(command))
        while True:
            while self._replies:
                reply = self._replies.popleft()
                if reply.echo == command:
                    return reply
            async with self._clock.deadline(ANSWER_LIMIT if silence is None else silence):
                await self._receive()

    async def _ask_once(self, command: str) -> Reply:
        try:
            async with self._clock.deadline(ANSWER_LIMIT):
                return await self._exchange(command, self._config.line_timeout)
        except TimeoutError as error:
            raise DeviceTimeoutError(f"{self._link.name}: no answer to {command}") from error

    async def _wake(self) -> Dialect:
        """End whatever the sensor is doing; it is idle afterwards."""
        await self._discard(LISTEN)
        for _ in range(WAKE_ATTEMPTS):
            try:
                async with self._clock.deadline(WAKE_TIMEOUT):
                    reply = await self._exchange("QT")
            except TimeoutError:
                continue
            if reply.scip1:
                switched = await self.ask("SCIP2.0")
                accepted = classify("SCIP2.0", switched.status) is StatusMeaning.OK
                return Dialect.SCIP2 if accepted else Dialect.SCIP1
            outcome = classify("QT", reply.status)
            if outcome is StatusMeaning.OK:
                return Dialect.SCIP2
            await self.ask("RS" if outcome is StatusMeaning.UPDATE_MODE else "TM2")
        if self._heard and not self.parser.replies:
            raise WrongDeviceError(f"{self._link.name}: what answers does not speak SCIP")
        raise DeviceTimeoutError(f"{self._link.name}: no answer to QT")

    async def _discard(self, seconds: float) -> None:
        """Throw away what comes within ``seconds``."""
        with contextlib.suppress(TimeoutError):
            async with self._clock.deadline(seconds):
                while True:
                    await self._receive()
        self.parser.reset()
        self._replies.clear()

    async def _drain(self) -> None:
        """Throw away everything until silence.

        Raises:
            ProtocolError: there is no silence.
        """
        try:
            async with self._clock.deadline(DRAIN_LIMIT):
                with contextlib.suppress(TimeoutError):
                    while True:
                        async with self._clock.deadline(QUIET):
                            await self._receive()
        except TimeoutError as error:
            raise ProtocolError(f"{self._link.name}: keeps sending after QT") from error
        self.parser.reset()
        self._replies.clear()

    async def _fields(self, command: str, last: str) -> dict[str, str]:
        """Text fields of an answer that ends with the field ``last``, even if an empty line splits it."""
        lines = list((await self.demand(command)).lines)
        with contextlib.suppress(DeviceTimeoutError):
            while not any(line.startswith(last.encode() + b":") for line in lines):
                more = await self.next_reply(self._config.line_timeout)
                if more.echo == command:
                    lines += more.lines
        return parse_fields(lines)

    def _check(self, sensor: Sensor) -> None:
        names = f"{sensor.identity.product} {sensor.parameters.model if sensor.state else ''}".strip()
        if "URG" not in names:
            raise WrongDeviceError(f"{self._link.name}: expected a URG scanner, found {names!r}")
        if sensor.state is not None and not sensor.identity.protocol.startswith("SCIP 2"):
            raise ProtocolError(f"{self._link.name}: expected SCIP 2, the sensor states {sensor.identity.protocol!r}")
        wanted, found = self._config.serial_number, sensor.identity.serial
        if wanted is not None and found != wanted:
            raise WrongDeviceError(f"{self._link.name}: expected unit {wanted}, found {found}")
