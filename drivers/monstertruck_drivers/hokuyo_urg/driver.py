"""The scanner as a service: one session streams scans until it is cancelled or lost."""

from monstertruck_drivers.hokuyo_urg.clock_map import ClockMap
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.protocol import (
    Reply,
    ScanBlock,
    StatusMeaning,
    classify,
    decode_scan,
    scan_command,
    scip1_scan_command,
    split_ranges,
)
from monstertruck_drivers.hokuyo_urg.session import Dialect, Parameters, ScipSession, Sensor
from monstertruck_drivers.link import Port
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceFaultError, DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan

TRANSFER = 0.002
"""Seconds assumed from the last beam to the arrival where it cannot be measured."""
GREATEST_2CHAR = 4.095
"""Metres; the most a two-character range can tell."""
TOO_LATE = 0.3
"""Seconds by which scans arrive later than at the start, from which on they are worth little."""
LATE_FOR = 3.0
"""Seconds of such scans after which the session starts anew, and with it the comparison of the clocks."""
SLEW_PERIOD = 60.0
"""Least seconds between two reports of clocks that run apart."""


class HokuyoDriver:
    """URG-04LX on a port.

    Args:
        config: how it is driven.
        port: where it is plugged in.
        clock: time.
        out: where scans go.
        events: where faults, recoveries and losses are reported.
        name: of the service.
    """

    def __init__(
        self,
        config: HokuyoConfig,
        port: Port,
        clock: Clock,
        out: Publisher[LaserScan],
        events: EventSink,
        name: str = "lidar",
    ) -> None:
        self.name = name
        self.scans = 0
        """Scans published since the daemon started."""
        self.dropped = 0
        """Damaged scans since the daemon started."""
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._events = events
        self._slew_due = 0
        self._late_since: int | None = None

    async def run(self, ready: Ready) -> None:
        """One session: wake, identify, compare clocks, stream; the laser is off when it ends.

        Raises:
            DeviceLostError: nothing plugged in, or unplugged.
            DeviceTimeoutError: silence, no good scan for ``stale_periods``, or scans that arrive late for seconds.
            WrongDeviceError: another device answers.
            ProtocolError: too many damaged scans in a row, or answers against the protocol.
            DeviceFaultError: the sensor reports a hardware fault; it was reset once.
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
            self._tell(Severity.WARNING, text, reason=Reason.CLOCK_DRIFT)
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
                        self._tell_ready(sensor)
                    bad, first = 0, False
                    due = self._deadline(config.stale_periods * interval)
                    self._publish(block, self._stamp(mapping, block, session.arrival), geometry, session.arrival)
                elif outcome is StatusMeaning.DATA:
                    bad += 1
                else:
                    due = self._deadline(await self._other_status(session, reply.status, outcome, interval))
            if bad > config.max_bad_scans:
                raise ProtocolError(f"{self._port.name}: {bad} damaged scans in a row")

    async def _other_status(self, session: ScipSession, status: str, outcome: StatusMeaning, interval: float) -> float:
        """React to a scan block without data; returns the seconds to wait for the next scan."""
        if outcome is StatusMeaning.VERIFYING:
            self._tell(Severity.WARNING, f"sensor verifies a suspected fault, status {status}", status=status)
            return self._config.verify_timeout
        if outcome is StatusMeaning.RESUMED:
            self._tell(Severity.INFO, "sensor resumed after verification", reason=Reason.DEVICE_READY, status=status)
            return self._config.first_scan_periods * interval
        if outcome is StatusMeaning.FAULT:
            await session.reset()
            raise DeviceFaultError(f"{self._port.name}: sensor reports hardware trouble, status {status}")
        raise ProtocolError(f"{self._port.name}: status {status} within a stream of scans")

    def _stamp(self, mapping: ClockMap, block: ScanBlock, arrival: int) -> int:
        """The daemon's time at step 0, ns."""
        assert block.counter is not None  # SCIP 2.0
        restarts, slews = mapping.restarts, mapping.slews
        stamp = mapping.stamp(block.counter, arrival)
        if mapping.restarts > restarts:
            self._tell(Severity.WARNING, "sensor's clock restarted", counter=block.counter)
        if mapping.slews > slews and arrival >= self._slew_due:
            self._slew_due = arrival + round(SLEW_PERIOD * SECOND)
            text = f"the sensor's clock and the computer's run apart by {mapping.drift:.1%}: followed"
            self._tell(Severity.WARNING, text, reason=Reason.CLOCK_DRIFT)
        if mapping.late < TOO_LATE * SECOND:
            self._late_since = None
        elif self._late_since is None:
            self._late_since = arrival
        elif arrival - self._late_since > LATE_FOR * SECOND:
            self._late_since = None
            raise DeviceTimeoutError(
                f"{self._port.name}: scans arrive {mapping.late / SECOND:.1f} s later than at the start: begins anew"
            )
        return stamp

    # SCIP 1.1

    async def _poll(self, session: ScipSession, sensor: Sensor, ready: Ready) -> None:
        """Units that know SCIP 1.1 only: ask for every scan; they tell no time, so the arrival must do."""
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
                    self._tell_ready(sensor)
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
            raise DeviceTimeoutError(f"{self._port.name}: no good scan in time") from error

    def _decode(self, reply: Reply, shape: tuple[int, int, int], bad: int) -> ScanBlock | None:
        """The scan, or None if it is damaged; reported unless ``bad`` others came just before."""
        try:
            return decode_scan(reply, *shape)
        except ProtocolError as error:
            self.dropped += 1
            if bad == 0:
                self._tell(Severity.WARNING, str(error), reason=Reason.DEVICE_PROTOCOL, dropped=self.dropped)
            return None

    def _publish(self, block: ScanBlock, step_0: int, geometry: Parameters, received: int) -> None:
        """Send one scan, its stamp moved from step 0 to the first beam."""
        config = self._config
        # A cluster's range is the least of its steps: it stands for their middle.
        first = geometry.first_step + (config.cluster - 1) / 2
        last = first + (len(block.values) - 1) * config.cluster
        ranges, codes = split_ranges(block.values, geometry.least_mm)
        longest = geometry.greatest_mm / 1000
        self._out.put(
            LaserScan(
                stamp=step_0 + round(first * geometry.step_time * SECOND),
                received=received,
                seq=self._out.next_seq(),
                frame=config.frame,
                start_angle=geometry.angle(first),
                end_angle=geometry.angle(last),
                time_increment=geometry.step_time * config.cluster,
                scan_time=geometry.period,
                range_min=geometry.least_mm / 1000,
                range_max=min(longest, GREATEST_2CHAR) if config.scan_format == "MS" else longest,
                ranges=ranges,
                codes=codes,
            )
        )
        self.scans += 1

    def _tell_ready(self, sensor: Sensor) -> None:
        self._tell(
            Severity.INFO,
            sensor.state.status if sensor.state else "",
            reason=Reason.DEVICE_READY,
            product=sensor.identity.product,
            serial=sensor.identity.serial,
            firmware=sensor.identity.firmware,
            dialect=sensor.dialect.value,
        )

    def _tell(
        self, severity: Severity, text: str, *, reason: Reason = Reason.DEVICE_FAULT, **values: str | int
    ) -> None:
        self._events(reason, severity, self.name, text, **values)


def _sweep(geometry: Parameters) -> float:
    """Seconds from step 0 to the last beam."""
    return geometry.last_step * geometry.step_time
