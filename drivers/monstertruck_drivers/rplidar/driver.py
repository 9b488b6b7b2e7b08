"""RPLIDAR driver: starts the motor and the scan, and publishes every revolution."""

from typing import Final

import numpy as np

from monstertruck_drivers.emulation import Array
from monstertruck_drivers.link import Link
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.protocol import (
    COUNTS,
    SIZES,
    TURN_Q6,
    DataType,
    Decoded,
    Record,
    RecordParser,
    ScanMode,
    decode_capsule,
    decode_standard,
)
from monstertruck_drivers.rplidar.session import RplidarSession, ScannerUnit
from monstertruck_drivers.scanning.driver import ScannerDriver
from monstertruck_drivers.scanning.publishing import publish
from monstertruck_drivers.scanning.turns import ArrivalTimes, BeamSamples, TurnCutter, on_equal_steps
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason

STANDS: Final = ": its motor does not turn (an A1 needs port.dtr false)"


class SampleDecoder:
    """Decodes a byte stream into samples, with measurement times that assume immediate arrival.

    Args:
        mode: scan mode.
        baud: baud rate; None if the line has none.
    """

    def __init__(self, mode: ScanMode, baud: int | None) -> None:
        self.parser = RecordParser(mode.answer)
        self._mode = mode
        transfer = 0.001  # seconds assumed from the end of a record on the line to its arrival
        self._latency = ((SIZES[mode.answer] * 10 / baud if baud else 0.0) + transfer) * SECOND
        self._before: tuple[Record, float] | None = None
        self._usual: float | None = None
        self._odd: list[float] = []

    def feed(self, data: bytes, arrival: float) -> list[BeamSamples]:
        """Return the samples from the completed records; ``arrival`` is the arrival time of the bytes (ns)."""
        records = self.parser.feed(data)
        if self._mode.answer is DataType.STANDARD:
            return [self._timed(decode_standard(record.data), arrival) for record in records]
        found = []
        for record in records:
            before, self._before = self._before, (record, arrival)
            if before is not None and not record.fresh and self._follows(before[0], record):
                decoded = decode_capsule(self._mode.answer, before[0], record)
                found.append(self._timed(decoded, before[1]))
        return found

    def _follows(self, record: Record, following: Record) -> bool:
        """Whether the records are consecutive."""
        assert record.start is not None
        assert following.start is not None
        span = float((following.start - record.start) % TURN_Q6)
        agree = 0.25  # tolerance of a record's span (fraction of the usual one); beyond it, records were lost
        if self._usual is not None and abs(span - self._usual) <= agree * self._usual:
            self._usual += (span - self._usual) / 8
            self._odd.clear()
            return True
        self._odd.append(span)
        if (
            self._usual is None or len(self._odd) >= 5
        ):  # number of consecutive deviating spans that redefine the usual one
            self._usual = float(np.median(self._odd))
            self._odd.clear()
        return False

    def _timed(self, decoded: Decoded, arrival: float) -> BeamSamples:
        count = len(decoded.turns)
        before_last: Array = np.arange(count - 1.0, -1.0, -1.0) * (self._mode.sample_time * SECOND)
        return BeamSamples(*decoded, arrival - self._latency - before_last)


class RplidarDriver(ScannerDriver[RplidarConfig]):
    """Driver for an RPLIDAR on a port."""

    async def run(self, ready: Ready) -> None:
        """Serve one session: identify the unit, check its health, and scan. Motor and scan are off when it ends.

        Raises:
            DeviceFaultError: the unit remains in protection stop after a reset.
            DeviceLostError: no unit is plugged in, or it was unplugged.
            DeviceTimeoutError: the unit is silent, or its head does not turn.
            PortBusyError: another process holds the port.
            ProtocolError: answers violate the protocol, or bytes arrive without a valid sample.
            WrongDeviceError: another device answers, or another unit than the configured one.
        """
        async with await self._port.open() as link:
            session = RplidarSession(link, self._clock, self._config)
            unit = await session.handshake()
            if unit.health.status:
                self._events(
                    Reason.DEVICE_FAULT, Severity.WARNING, self.name, "unit warns", code=f"0x{unit.health.code:04x}"
                )
            mode = self._mode_of(unit)
            try:
                if unit.pwm:
                    session.turn_motor(self._config.motor_pwm)
                await session.start(mode)
                await self._stream(link, unit, mode, ready)
            finally:
                if not link.is_lost:
                    session.end()
                    if unit.pwm:
                        session.turn_motor(0)

    def _mode_of(self, unit: ScannerUnit) -> ScanMode:
        wanted = self._config.scan_mode
        if wanted == "typical":
            return next((mode for mode in unit.modes if mode.number == unit.typical), unit.modes[-1])
        for mode in unit.modes:
            if mode.name.lower() == wanted.lower():
                return mode
        names = ", ".join(mode.name for mode in unit.modes)
        raise ProtocolError(f"{self._port.name}: the unit has no scan mode {wanted!r}; it lists {names}")

    async def _stream(self, link: Link, unit: ScannerUnit, mode: ScanMode, ready: Ready) -> None:
        config, clock, begin = self._config, self._clock, self._clock.now()
        decoder, cutter = SampleDecoder(mode, link.baud), TurnCutter()
        times = ArrivalTimes(mode.sample_time * SECOND)
        wake_period = 0.01  # duration of the samples that justify a wake-up (s)
        records = max(wake_period / mode.sample_time / COUNTS[mode.answer], 1.0)
        stream: DeviceStream[BeamSamples] = DeviceStream(
            link,
            clock,
            lambda data: decoder.feed(data, float(stream.arrival - begin)),
            batch=round(records) * SIZES[mode.answer],
        )
        sheet = config.sheet._replace(greatest=mode.longest)
        due, first, measured = begin + round(config.first_scan * SECOND), True, False
        patience = config.first_scan
        while True:
            try:
                found = await stream.next(patience)
            except DeviceTimeoutError as error:
                raise DeviceTimeoutError(f"{error}{STANDS if first else ''}") from None
            for samples in found:
                measured = True
                for revolution in cutter.add(samples):
                    turn = on_equal_steps(times.timed(revolution))
                    if turn is None:
                        continue
                    if first:
                        ready()
                        self._report_ready(unit, mode)
                    due, first, measured = clock.now() + round(config.stale * SECOND), False, False
                    patience = config.silence
                    publish(turn, begin, stream.arrival, sheet, config, self._out, self.name)
            if clock.now() >= due:
                if measured:
                    raise DeviceTimeoutError(f"{self._port.name}: samples, but no complete revolution")
                raise ProtocolError(f"{self._port.name}: bytes, but no sample of an RPLIDAR")

    def _report_ready(self, unit: ScannerUnit, mode: ScanMode) -> None:
        identity = unit.identity
        self._events(
            Reason.DEVICE_READY,
            Severity.INFO,
            self.name,
            f"RPLIDAR 0x{identity.model:02x}",
            serial=identity.serial,
            firmware=".".join(map(str, identity.firmware)),
            mode=mode.name,
        )
