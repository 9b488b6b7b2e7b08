"""Emulated RPLIDARs, byte for byte: start-up, health, modes, motor spin-up and streams."""

import asyncio
import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import Array, BeamSource, EmulatorSetup, ReceivedBytes
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.protocol import (
    COUNTS,
    MODELS,
    NO_QUALITY,
    SIZES,
    SYNC,
    TURN_Q6,
    ConfigKey,
    DataType,
    Descriptor,
    RplidarCommand,
    RplidarIdentity,
    RplidarModel,
    ScanMode,
    build_capsule,
    build_descriptor,
    build_express,
    build_info,
    build_standard,
    build_ultra,
    ultra_offset,
)
from monstertruck_drivers.scanning.head import TURNING, TurningHead
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

GREETING: Final = b"RP LIDAR System.\r\nFirmware Ver 1.29 - rc7, HW Ver 7\r\nModel: 18\r\n"
"""Start-up message of an A1."""
RANGE: Final = "range"
"""Signal: distances of a record (mm)."""
SCAN: Final = "scan"


class RplidarEmulator(FaultyDevice):
    """RPLIDAR with its rotating head.

    Faults (``inject``): ``silent on|off`` and ``deaf on|off``, ``health 0|1|2 CODE`` (2: protection stop until a
    reset), ``broken on|off`` (protection stop also after a reset), ``bad_checksum N`` (the next N records), ``torn``
    (the next record begins in its middle), and the head's faults.

    Args:
        clock: time.
        source: range source.
        model: the model's data sheet.
        seed: seed for covers.
        firmware: firmware version; below 1.24, the unit does not list its modes.
        serial: 32 hexadecimal digits.
    """

    def __init__(
        self,
        clock: Clock,
        source: BeamSource,
        model: RplidarModel = MODELS["a1"],
        *,
        seed: int = 0,
        firmware: tuple[int, int] = (1, 29),
        serial: str = "7DED9A87C5E392D3A5E49EF0ED383D65",
    ) -> None:
        self.name = "lidar"
        self.received = ReceivedBytes()
        """Bytes the host sent, for tests."""
        self.mode: ScanMode | None = None
        """Current scan mode; None: idle."""
        rng = np.random.default_rng(seed)
        self.signals = Signals(clock.now, {RANGE: SignalKind.ARRAY, SCAN: SignalKind.SWITCH}, rng, codes={RANGE: 1})
        self.head = TurningHead(clock, source, model.ranges, model.frequency, rng)
        self._clock, self._model = clock, model
        self._identity = RplidarIdentity(model.number, firmware, 7, serial)
        self.faults = FaultTable(
            self.name,
            {
                "silent|deaf on|off": False,
                "health 0|1|2 [CODE]": self._set_health,
                "broken on|off": self._break,
                "bad_checksum N": 0,
                "torn": 0,
                **self.head.fault_rows(),
            },
        )
        self._broken = False
        self._health = (0, 0)
        self._forced = self._greeting = False
        self._input = b""
        self._ready_at = 0
        self._angle = 0.0
        """Angle of the latest standard sample (turns)."""
        self.power_cycle()

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        end.baud = self._model.baud
        end.on_plug = lambda plugged: self.power_cycle() if plugged else None  # the port is its supply
        self.power_cycle()
        async with asyncio.TaskGroup() as group:
            group.create_task(self._scan(end))
            while True:
                data = await end.read()
                self.received.extend(data)
                if self.faults["deaf"] or self._clock.now() < self._ready_at:
                    continue
                self._input += data
                while (taken := self._request()) is not None:
                    await self._clock.sleep(0.001)  # seconds from a request to its answer
                    self._answer(end, *taken)

    def power_cycle(self) -> None:
        """Switch the supply off and on: the unit is idle; a motor on the adapter board stops, any other turns."""
        self.head.stop()
        self._restart()
        self._motor_off = self._model.adapter
        self.head.frequency = 0.0 if self._motor_off else self._model.frequency

    def _restart(self) -> None:
        self.mode, self._input = None, b""
        self._health = (2, 0x8001) if self._broken else (0, 0)
        boot = SECOND // 2  # nanoseconds after power-up and reset without an answer
        self._ready_at = self._clock.now() + boot
        self._greeting = self._model.number == MODELS["a1"].number

    def _set_health(self, status: str, code: str = "0") -> None:
        if status not in ("0", "1", "2"):
            raise ValueError(status)
        self._health = int(status), int(code, base=0)

    def _break(self, broken: bool) -> None:
        self._broken = broken
        if broken:
            self._health = (2, 0x8001)

    # Requests

    def _request(self) -> tuple[int, bytes] | None:
        """Return the next request as command and payload; drop bytes that do not form a request."""
        while self._input:
            data = self._input
            if data[0] != SYNC:
                self._input = data[1:]
                continue
            if len(data) < 2:  # sync and command
                return None
            if data[1] < 0x80:  # no payload
                self._input = data[2:]
                return data[1], b""
            if len(data) < 3 or len(data) < 4 + data[2]:  # length, payload and sum
                return None
            size = data[2]
            self._input = data[4 + size :]
            total = 0
            for byte in data[: 3 + size]:
                total ^= byte
            if total == data[3 + size]:
                return data[1], data[3 : 3 + size]
        return None

    def _answer(self, end: DeviceEnd, command: int, payload: bytes) -> None:
        if command == RplidarCommand.MOTOR_PWM:
            self._drive(payload)
            return
        self.mode = None  # every other request ends a scan
        match command:
            case RplidarCommand.RESET:
                self._restart()
            case RplidarCommand.INFO:
                self._single(end, DataType.INFO, build_info(self._identity))
            case RplidarCommand.HEALTH:
                self._single(end, DataType.HEALTH, struct.pack("<BH", *self._health))
            case RplidarCommand.SAMPLE_RATE:
                times = [round(mode.sample_time * 1e6) for mode in (self._model.modes[0], self._model.modes[1])]
                self._single(end, DataType.SAMPLE_RATE, struct.pack("<HH", *times))
            case RplidarCommand.ADAPTER if self._model.number >> 4 in (2, 3):
                self._single(end, DataType.ADAPTER, struct.pack("<I", self._model.adapter))
            case RplidarCommand.CONFIG if self._identity.firmware >= (1, 24):
                if (data := self._property(payload)) is not None:
                    self._single(end, DataType.CONFIG, data)
            case RplidarCommand.SCAN | RplidarCommand.FORCE_SCAN:
                self._begin(end, self._model.modes[0], forced=command == RplidarCommand.FORCE_SCAN)
            case RplidarCommand.EXPRESS_SCAN if payload:
                modes, number = self._model.modes, payload[0] if self._identity.firmware >= (1, 24) else 0
                if number < len(modes):
                    self._begin(end, modes[number] if number else _first_capsules(modes), forced=False)

    def _drive(self, payload: bytes) -> None:
        """Set the motor speed, as the adapter board does; a running scan continues."""
        if self._model.adapter and len(payload) == struct.calcsize("<H"):
            (pwm,) = struct.unpack("<H", payload)
            default_pwm = 660  # duty cycle (of 1023) at which the head turns at the data sheet's rate
            self.head.frequency = self._model.frequency * pwm / default_pwm

    def _begin(self, end: DeviceEnd, mode: ScanMode, *, forced: bool) -> None:
        if self._health[0] == 2:  # protects itself
            return
        if not self.faults["silent"]:
            end.write(build_descriptor(Descriptor(SIZES[mode.answer], True, mode.answer)))
        self.mode, self._forced = mode, forced

    def _single(self, end: DeviceEnd, kind: DataType, data: bytes) -> None:
        if not self.faults["silent"]:
            end.write(build_descriptor(Descriptor(len(data), False, kind)) + data)

    def _property(self, payload: bytes) -> bytes | None:
        (key,) = struct.unpack_from("<I", payload + bytes(4))
        (number,) = struct.unpack_from("<H", payload[4:] + bytes(2))
        modes = self._model.modes
        if number >= len(modes):
            return None
        mode = modes[number]
        values: dict[int, bytes] = {
            ConfigKey.MODE_COUNT: struct.pack("<H", len(modes)),
            ConfigKey.TYPICAL_MODE: struct.pack("<H", self._model.typical),
            ConfigKey.SAMPLE_TIME: struct.pack("<I", round(mode.sample_time * 256e6)),
            ConfigKey.LONGEST: struct.pack("<I", round(mode.longest * 256)),
            ConfigKey.ANSWER_TYPE: bytes((mode.answer,)),
            ConfigKey.NAME: mode.name.encode() + b"\0",
        }
        found = values.get(key)
        return None if found is None else struct.pack("<I", key) + found

    # Samples

    async def _scan(self, end: DeviceEnd) -> None:
        while True:
            if self.mode is not None:
                await self._stream(end, self.mode)
                continue
            if self._greeting and self._clock.now() >= self._ready_at:
                self._greeting = False
                end.write(GREETING)
            self.head.turn(np.array([self.head.now()], np.int64))
            await self._clock.sleep(0.01)  # seconds between two checks for work

    async def _stream(self, end: DeviceEnd, mode: ScanMode) -> None:
        group = 8  # standard samples that are sent together
        count = group if mode.answer is DataType.STANDARD else COUNTS[mode.answer]
        period, fresh = mode.sample_time * SECOND, True
        begin = float(self.head.now())
        while self.mode is mode:
            ahead = mode.answer is DataType.ULTRA  # its last samples depend on the first sample of the next record
            times = (begin + period * np.arange(1, count + 1 + ahead)).astype(np.int64)
            last = int(times[-1])
            await self._clock.sleep_until(self.head.world_time(last))
            overslept = SECOND // 2  # maximum lag after the host's machine slept (ns)
            late = self.head.now() - last > overslept
            begin = float(self.head.now() if late else begin + period * count)
            if self.mode is not mode or late:
                continue
            data = self._record(mode, times, fresh=fresh)
            ready = self._forced or self.head.speed > TURNING * max(self._model.frequency, 0.1)
            if not ready or self.faults["silent"]:
                continue
            fresh = False
            if self.faults.strikes("bad_checksum"):
                data = bytes((data[0] ^ 3,)) + data[1:]
            if self.faults.strikes("torn"):
                data = data[len(data) // 2 :]
            end.write(data)

    def _record(self, mode: ScanMode, times: NDArray[np.int64], *, fresh: bool) -> bytes:
        turned = self.head.turn(times)
        if mode.answer is DataType.STANDARD:
            millimetres = self._millimetres(self.head.look(turned, times))
            angles = np.mod(turned, 1.0)
            starts, self._angle = np.diff(angles, prepend=self._angle) < 0.0, float(angles[-1])
            return build_standard(turned, millimetres, np.where(millimetres > 0, NO_QUALITY, 0), starts)
        start = round(float(turned[0]) * TURN_Q6) % TURN_Q6
        if mode.answer is DataType.DENSE:
            millimetres = self._millimetres(self.head.look(turned, times))
            return build_capsule(start, millimetres.astype("<u2").tobytes(), fresh=fresh)
        if mode.answer is DataType.EXPRESS:
            # Angle that is to be subtracted from express samples, 1/8 degrees; the real ones depend on the distance.
            offset = 20
            millimetres = np.minimum(self._millimetres(self.head.look(turned - offset / 8 / 360, times)), 0x3FFF)
            return build_capsule(start, build_express(millimetres, np.full(len(times), offset)), fresh=fresh)
        guessed = self.head.look(turned - ultra_offset(np.array([3000.0])), times)
        millimetres = self._millimetres(self.head.look(turned - ultra_offset(guessed * 1000), times))
        return build_capsule(start, build_ultra(millimetres), fresh=fresh)

    def _millimetres(self, ranges: Array) -> NDArray[np.int64]:
        found: NDArray[np.int64] = np.rint(ranges * 1000).astype(np.int64)
        return np.clip(self.signals.report(RANGE, found), 0, 0xFFFF)


def _first_capsules(modes: tuple[ScanMode, ...]) -> ScanMode:
    """Return the mode for an express request of mode 0."""
    return next(mode for mode in modes if mode.answer is not DataType.STANDARD)


def emulated(setup: EmulatorSetup) -> RplidarEmulator:
    """Create a simulated robot's lidar."""
    settings = setup.settings if isinstance(setup.settings, RplidarConfig) else RplidarConfig()
    serial = settings.serial_number or "7DED9A87C5E392D3A5E49EF0ED383D65"
    return RplidarEmulator(setup.clock, setup.room, MODELS[settings.model], seed=setup.seed, serial=serial)
