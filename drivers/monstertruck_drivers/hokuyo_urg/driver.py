"""Driver for Hokuyo scanners, and its SCIP session.

A session wakes the scanner from any state, identifies it, compares clocks and silences it; the driver streams scans in
a session until it is cancelled or lost.
"""

import contextlib
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.hokuyo_urg.config import HokuyoLxConfig, ScipConfig
from monstertruck_drivers.hokuyo_urg.protocol import (
    SCIP1_PARAMETERS,
    InternalState,
    LidarIdentity,
    Parameters,
    Reply,
    ScanBlock,
    ScipParser,
    StatusMeaning,
    classify,
    decode_counter,
    decode_scan,
    parse_fields,
    parse_identity,
    parse_parameters,
    parse_state,
    request,
    scan_command,
    scip1_scan_command,
    split_lx_ranges,
    split_ranges,
)
from monstertruck_drivers.link import Link
from monstertruck_drivers.scanning.clock_map import Anchor, ClockMap
from monstertruck_drivers.scanning.driver import ScannerDriver
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan

TRANSFER = 0.002
"""Assumed time from the last beam to the arrival of its scan, if it cannot be measured (s)."""
ANSWER_LIMIT = 2.0
"""Timeout for a complete answer, also over a slow RS232 line (s)."""


class Dialect(StrEnum):
    """Protocol version of the sensor."""

    SCIP1 = "SCIP 1.1"
    SCIP2 = "SCIP 2.0"


@dataclass(frozen=True, slots=True)
class Sensor:
    """Result of the handshake."""

    dialect: Dialect
    identity: LidarIdentity
    parameters: Parameters
    state: InternalState | None
    """None in SCIP 1.1."""


class ScipSession:
    """Sends one request at a time over an open link."""

    def __init__(self, link: Link, clock: Clock, config: ScipConfig) -> None:
        self.parser = ScipParser()
        self.arrival = 0
        """Arrival time of the latest bytes (ns)."""
        self._link = link
        self._clock = clock
        self._config = config
        self._replies: deque[Reply] = deque()
        self._heard = False
        self._dialect = Dialect.SCIP2

    async def next_reply(self, seconds: float) -> Reply:
        """Receive the next reply, whichever request it answers.

        Raises:
            DeviceTimeoutError: no complete reply arrived within ``seconds``.
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
        """Send a command and wait for its reply, skipping all others; repeat it once if the sensor is busy.

        Raises:
            DeviceTimeoutError: the sensor does not answer.
            DeviceLostError: the link went down.
        """
        reply = await self._ask_once(command)
        if classify(command, reply.status) is StatusMeaning.BUSY:
            with contextlib.suppress(ProtocolError):
                await self._drain()
            reply = await self._ask_once(command)
        return reply

    async def demand(self, command: str) -> Reply:
        """Like :meth:`ask`, but reject any status other than success.

        Raises:
            DeviceFaultError: the sensor reports a fault.
            ProtocolError: the sensor refuses the command.
        """
        reply = await self.ask(command)
        outcome = classify(command, reply.status)
        if outcome is StatusMeaning.FAULT:
            raise DeviceFaultError(f"{self._link.name}: {command} answered with fault {reply.status}")
        if outcome not in (StatusMeaning.OK, StatusMeaning.ALREADY):
            raise ProtocolError(f"{self._link.name}: {command} refused with status {reply.status}")
        return reply

    async def handshake(self) -> Sensor:
        """Bring the sensor to rest from any state and identify it.

        Raises:
            WrongDeviceError: another device answers, or another unit than the configured one.
            DeviceTimeoutError: the sensor does not answer.
            ProtocolError: the sensor violates its protocol.
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
        """Read the sensor's counter in time-adjust mode; uses the fastest of several exchanges.

        Returns:
            Clock anchor; None if the sensor refuses time-adjust mode.

        Raises:
            ProtocolError: the time is damaged, or the sensor does not leave time-adjust mode.
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
        """Switch the laser off and end the stream; waits briefly for the answer and never fails."""
        with contextlib.suppress(DeviceError, TimeoutError):
            async with self._clock.deadline(0.3):
                await self._exchange("QT" if self._dialect is Dialect.SCIP2 else "L0")

    async def reset(self) -> None:
        """Send RS: restore all defaults; never fails."""
        with contextlib.suppress(DeviceError):
            await self._ask_once("RS")

    # Parts

    async def _receive(self, within: float | None = None) -> None:
        data = await self._link.read(within)
        self.arrival = self._clock.now()
        self._heard = True
        self._replies += self.parser.feed(data)

    async def _exchange(self, command: str, silence: float | None = None) -> Reply:
        """Send a command and wait for its echo; raises TimeoutError after ``silence`` seconds without a byte."""
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
        """End any activity of the sensor, so that it is idle."""
        await self._discard(0.05)  # seconds after opening whose bytes are discarded
        for _ in range(4):  # one QT completes an incomplete line, three may remain unanswered
            try:
                wake_timeout = 0.5  # timeout for the answer to one QT while the sensor may still stream (s)
                async with self._clock.deadline(wake_timeout):
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
            raise WrongDeviceError(f"{self._link.name}: the connected device does not use SCIP")
        raise DeviceTimeoutError(f"{self._link.name}: no answer to QT")

    async def _discard(self, seconds: float) -> None:
        """Discard bytes that arrive within ``seconds``."""
        with contextlib.suppress(TimeoutError):
            async with self._clock.deadline(seconds):
                while True:
                    await self._receive()
        self.parser.reset()
        self._replies.clear()

    async def _drain(self) -> None:
        """Discard all input until the line is silent.

        Raises:
            ProtocolError: the line does not become silent.
        """
        try:
            async with self._clock.deadline(2.0):
                with contextlib.suppress(TimeoutError):
                    while True:
                        async with self._clock.deadline(0.15):  # seconds of silence that prove a stream has ended
                            await self._receive()
        except TimeoutError as error:
            raise ProtocolError(f"{self._link.name}: keeps sending after QT") from error
        self.parser.reset()
        self._replies.clear()

    async def _fields(self, command: str, last: str) -> dict[str, str]:
        """Request a reply's text fields up to the field ``last``, even if an empty line splits the reply."""
        lines = list((await self.demand(command)).lines)
        with contextlib.suppress(DeviceTimeoutError):
            while not any(line.startswith(last.encode() + b":") for line in lines):
                more = await self.next_reply(self._config.line_timeout)
                if more.echo == command:
                    lines += more.lines
        return parse_fields(lines)

    def _check(self, sensor: Sensor) -> None:
        names = f"{sensor.identity.product} {sensor.parameters.model if sensor.state else ''}".strip()
        series = self._config.SERIES
        if not any(name in names for name in series):
            raise WrongDeviceError(f"{self._link.name}: expected a {' or '.join(series)} scanner, found {names!r}")
        if sensor.state is not None and not sensor.identity.protocol.startswith("SCIP 2"):
            raise ProtocolError(f"{self._link.name}: expected SCIP 2, the sensor states {sensor.identity.protocol!r}")
        wanted, found = self._config.serial_number, sensor.identity.serial
        if wanted is not None and found != wanted:
            raise WrongDeviceError(f"{self._link.name}: expected unit {wanted}, found {found}")


class HokuyoDriver(ScannerDriver[ScipConfig]):
    """Driver for a scanner that uses SCIP."""

    scans = 0
    """Number of scans published since the daemon started."""
    dropped = 0
    """Number of damaged scans since the daemon started."""

    async def run(self, ready: Ready) -> None:
        """Run one session: wake, identify, compare clocks, stream. The laser is off when the session ends.

        Raises:
            DeviceLostError: the scanner was unplugged.
            DeviceTimeoutError: the scanner is silent, sent no valid scan for ``stale_periods``, or its scans arrive
                with a growing delay.
            WrongDeviceError: another device answers.
            ProtocolError: too many consecutive scans are damaged, or the scanner violates the protocol.
            DeviceFaultError: the sensor reports a hardware fault that one reset did not clear.
        """
        async with await self._port.open() as link:
            session = ScipSession(link, self._clock, self._config)
            sensor = await session.handshake()
            try:
                if sensor.dialect is Dialect.SCIP1:
                    await self._poll(session, sensor, ready)
                else:
                    await self._stream(session, sensor, ready)
            finally:
                await session.stop()

    # SCIP 2.0

    async def _stream(self, session: ScipSession, sensor: Sensor, ready: Ready) -> None:
        config, geometry = self._config, sensor.parameters
        anchor = await session.compare_clocks()
        if anchor is None:
            text = "refuses its time-adjust mode: the age of its scans is assumed, not measured"
            self._report(Severity.WARNING, text, reason=Reason.CLOCK_DRIFT)
        mapping = ClockMap(round((_sweep(geometry) + TRANSFER) * SECOND), anchor)
        shape = (geometry.first_step, geometry.last_step, config.cluster)
        command = scan_command(config.scan_format, *shape, skip=config.skip)
        await session.demand(command)

        interval = geometry.period * (config.skip + 1)
        due = self._deadline(config.first_scan_periods * interval)
        bad, first = 0, True
        while True:
            rejected = session.parser.rejected
            reply = await self._reply_before(session, due)
            bad += session.parser.rejected - rejected
            self.dropped += session.parser.rejected - rejected
            if reply.answers_scan(command):
                outcome = classify(command, reply.status)
                if outcome is StatusMeaning.DATA and (block := self._decode(reply, shape, bad)) is not None:
                    if first:
                        ready()
                        self._report_ready(sensor)
                    bad, first = 0, False
                    due = self._deadline(config.stale_periods * interval)
                    assert block.counter is not None  # SCIP 2.0
                    step_0 = self._watch.stamp(mapping, block.counter, session.arrival, self._port.name)
                    self._publish(block, step_0, geometry, session.arrival)
                elif outcome in (StatusMeaning.DATA, StatusMeaning.UNSTABLE):
                    bad += 1
                else:
                    due = self._deadline(await self._other_status(session, reply.status, outcome, interval))
            if bad > config.max_bad_scans:
                raise ProtocolError(f"{self._port.name}: {bad} damaged scans in a row")

    async def _other_status(self, session: ScipSession, status: str, outcome: StatusMeaning, interval: float) -> float:
        """Handle a scan block without data; return the seconds to wait for the next scan."""
        if outcome is StatusMeaning.VERIFYING:
            self._report(Severity.WARNING, f"sensor verifies a suspected fault, status {status}", status=status)
            return self._config.verify_timeout
        if outcome is StatusMeaning.RESUMED:
            self._report(Severity.INFO, "sensor resumed after verification", reason=Reason.DEVICE_READY, status=status)
            return self._config.first_scan_periods * interval
        if outcome is StatusMeaning.FAULT:
            await session.reset()
            raise DeviceFaultError(f"{self._port.name}: the sensor reports a hardware fault, status {status}")
        raise ProtocolError(f"{self._port.name}: status {status} within a stream of scans")

    # SCIP 1.1

    async def _poll(self, session: ScipSession, sensor: Sensor, ready: Ready) -> None:
        """Request every scan from a unit that supports SCIP 1.1 only; it sends no time, so the arrival time is used."""
        config, geometry = self._config, sensor.parameters
        shape = (geometry.first_step, geometry.last_step, config.cluster)
        await session.demand("L1")
        bad, first = 0, True
        while True:
            asked = self._clock.now()
            block = self._decode(await session.demand(scip1_scan_command(*shape)), shape, bad)
            if block is not None:
                if first:
                    ready()
                    self._report_ready(sensor)
                bad, first = 0, False
                age = _sweep(geometry) + TRANSFER
                self._publish(block, session.arrival - round(age * SECOND), geometry, session.arrival)
            else:
                bad += 1
            if bad > config.max_bad_scans:
                raise ProtocolError(f"{self._port.name}: {bad} damaged scans in a row")
            await self._clock.sleep_until(asked + round(geometry.period * (config.skip + 1) * SECOND))

    # Shared parts

    def _deadline(self, seconds: float) -> int:
        return self._clock.now() + round(seconds * SECOND)

    async def _reply_before(self, session: ScipSession, due: int) -> Reply:
        left = (due - self._clock.now()) / SECOND
        try:
            return await session.next_reply(max(left, 0.0))
        except DeviceTimeoutError as error:
            raise DeviceTimeoutError(f"{self._port.name}: no valid scan in time") from error

    def _decode(self, reply: Reply, shape: tuple[int, int, int], bad: int) -> ScanBlock | None:
        """Parse a scan; None if it is damaged. The first of consecutive damaged scans (``bad`` 0) is reported."""
        try:
            return decode_scan(reply, *shape)
        except ProtocolError as error:
            self.dropped += 1
            if bad == 0:
                self._report(Severity.WARNING, str(error), reason=Reason.DEVICE_PROTOCOL, dropped=self.dropped)
            return None

    def _publish(self, block: ScanBlock, step_0: int, geometry: Parameters, received: int) -> None:
        """Publish one scan, with its stamp moved from step 0 to the first beam."""
        config = self._config
        # A cluster's range is the minimum of its steps: it represents their middle.
        first = geometry.first_step + (config.cluster - 1) / 2
        last = first + (len(block.values) - 1) * config.cluster
        ranges, codes = split(block.values, geometry, config)
        longest = geometry.greatest_mm / 1000
        greatest_2char = 4.095  # maximum range in two characters, m
        self._out.put(
            LaserScan(
                stamp=step_0 + round(first * geometry.step_time * SECOND),
                received=received,
                seq=self._out.next_seq(),
                frame=config.frame or self.name,
                start_angle=geometry.angle(first),
                end_angle=geometry.angle(last),
                time_increment=geometry.step_time * config.cluster,
                scan_time=geometry.period,
                range_min=geometry.least_mm / 1000,
                range_max=min(longest, greatest_2char) if config.scan_format == "MS" else longest,
                ranges=ranges,
                codes=codes,
                range_noise=config.sheet.noise,
            )
        )
        self.scans += 1

    def _report_ready(self, sensor: Sensor) -> None:
        self._report(
            Severity.INFO,
            sensor.state.status if sensor.state else "",
            reason=Reason.DEVICE_READY,
            product=sensor.identity.product,
            serial=sensor.identity.serial,
            firmware=sensor.identity.firmware,
            dialect=sensor.dialect.value,
        )

    def _report(
        self, severity: Severity, text: str, *, reason: Reason = Reason.DEVICE_FAULT, **values: str | int
    ) -> None:
        self._events(reason, severity, self.name, text, **values)


def split(
    values: NDArray[np.int32], geometry: Parameters, config: ScipConfig
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Split scan values into ranges and error codes, using the error values of the scanner's series."""
    if isinstance(config, HokuyoLxConfig):
        free = config.no_return == "free"
        return split_lx_ranges(values, geometry.least_mm, geometry.greatest_mm, free=free)
    return split_ranges(values, geometry.least_mm)


def _sweep(geometry: Parameters) -> float:
    """Time from step 0 to the last beam (s)."""
    return geometry.last_step * geometry.step_time
