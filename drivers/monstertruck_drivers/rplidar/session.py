"""Requests to an RPLIDAR, one at a time, whatever state it was left in."""

import struct
from dataclasses import dataclass
from typing import Final

from monstertruck_drivers.link import Link
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.protocol import (
    ANSWER,
    DESCRIPTOR,
    SIZES,
    ConfigKey,
    DataType,
    Health,
    RplidarCommand,
    RplidarIdentity,
    ScanMode,
    config_request,
    express_request,
    parse_descriptor,
    parse_info,
    request,
)
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)

QUIET: Final = 0.1
"""Silence that proves that a stream has ended (s); it ends within 1 ms of STOP (manufacturer's protocol)."""


@dataclass(frozen=True, slots=True)
class ScannerUnit:
    """Result of the handshake."""

    identity: RplidarIdentity
    health: Health
    modes: tuple[ScanMode, ...]
    typical: int
    """Index of the recommended mode."""
    pwm: bool
    """Whether ``MOTOR_PWM`` controls the motor."""


class RplidarSession:
    """Requests over an open link.

    Args:
        link: open link.
        clock: time.
        config: timeouts.
    """

    def __init__(self, link: Link, clock: Clock, config: RplidarConfig) -> None:
        self._link, self._clock, self._config = link, clock, config
        self._heard = 0

    async def handshake(self) -> ScannerUnit:
        """Stop the unit and identify it; a unit in protection stop is reset once.

        Raises:
            DeviceFaultError: the unit remains in protection stop.
            DeviceTimeoutError: the unit is silent.
            ProtocolError: answers violate the protocol.
            WrongDeviceError: another device answers, or another unit than the configured one.
        """
        await self.stop()
        identity = await self._identify()
        wanted = self._config.serial_number
        if wanted is not None and identity.serial != wanted.upper():
            raise WrongDeviceError(f"{self._link.name}: expected unit {wanted}, found {identity.serial}")
        health = await self._health()
        protected = 2  # health of a unit in protection stop
        if health.status == protected:
            await self.reset()
            health = await self._health()
            if health.status == protected:
                raise DeviceFaultError(f"{self._link.name}: protection stop of the unit, code 0x{health.code:04x}")
        lists_modes_from = (1, 24)  # first firmware that lists its modes (maker's protocol, GET_LIDAR_CONF)
        lists = identity.firmware >= lists_modes_from
        modes, typical = await self._listed_modes() if lists else await self._early_modes()
        return ScannerUnit(identity, health, modes, typical, await self._has_pwm(identity))

    async def start(self, mode: ScanMode) -> None:
        """Start scanning.

        Raises:
            DeviceTimeoutError: the unit does not answer.
            ProtocolError: the unit sends data of a type other than the mode's.
        """
        standard = mode.answer is DataType.STANDARD
        self._link.write(request(RplidarCommand.SCAN) if standard else express_request(mode.number))
        found = parse_descriptor(await self._descriptor("scan"))
        if found.type != mode.answer or found.length != SIZES[mode.answer]:
            raise ProtocolError(f"{self._link.name}: mode {mode.name} sends data of type 0x{found.type:02x}")

    async def stop(self) -> None:
        """Stop the unit and discard the bytes that it still sends.

        Raises:
            WrongDeviceError: the unit does not fall silent.
        """
        for _ in range(5):  # requests to stop: half a request of a dead host may swallow the first ones
            self._link.write(request(RplidarCommand.STOP))
            until = self._clock.now() + round(0.3 * SECOND)  # seconds within which a stream must end
            while self._clock.now() < until:
                try:
                    await self._link.read(QUIET)
                except TimeoutError:
                    return
        raise WrongDeviceError(f"{self._link.name}: continues to send after STOP: not an RPLIDAR, or another baud rate")

    async def reset(self) -> None:
        """Restart the unit and wait for its answer."""
        self._link.write(request(RplidarCommand.RESET))
        until = self._clock.now() + round(self._config.boot * SECOND)
        while self._clock.now() < until:
            await self._clock.sleep(QUIET)
            try:
                await self._health()
            except DeviceTimeoutError:
                continue
            return

    def turn_motor(self, pwm: int) -> None:
        """Set the motor's duty cycle (0 to 1023; 0 switches it off)."""
        self._link.write(request(RplidarCommand.MOTOR_PWM, struct.pack("<H", pwm)))

    def end(self) -> None:
        """Stop scanning without waiting."""
        self._link.write(request(RplidarCommand.STOP))

    # Parts

    async def _identify(self) -> RplidarIdentity:
        for _ in range(3):  # requests for the identity: half a request of a dead host may swallow the first
            self._heard = 0
            try:
                return parse_info(await self._ask(request(RplidarCommand.INFO), DataType.INFO))
            except DeviceTimeoutError:
                continue
        if self._heard:
            raise WrongDeviceError(
                f"{self._link.name}: the connected device is not an RPLIDAR, or has another baud rate"
            )
        raise DeviceTimeoutError(f"{self._link.name}: no answer")

    async def _health(self) -> Health:
        return Health(*struct.unpack("<BH", await self._ask(request(RplidarCommand.HEALTH), DataType.HEALTH)))

    async def _listed_modes(self) -> tuple[tuple[ScanMode, ...], int]:
        (count,) = struct.unpack_from("<H", await self._property(ConfigKey.MODE_COUNT))
        (typical,) = struct.unpack_from("<H", await self._property(ConfigKey.TYPICAL_MODE))
        modes = []
        for number in range(count):
            (time,) = struct.unpack_from("<I", await self._property(ConfigKey.SAMPLE_TIME, number))
            (far,) = struct.unpack_from("<I", await self._property(ConfigKey.LONGEST, number))
            answer = (await self._property(ConfigKey.ANSWER_TYPE, number))[0]
            name = (await self._property(ConfigKey.NAME, number)).rstrip(b"\0").decode("ascii", "replace")
            if answer in SIZES and time:
                modes.append(ScanMode(number, name, time / 256e6, far / 256, DataType(answer)))
        if not modes:
            raise ProtocolError(f"{self._link.name}: has no scan mode that this driver can read")
        return tuple(modes), typical

    async def _early_modes(self) -> tuple[tuple[ScanMode, ...], int]:
        """Return the modes for firmware that does not list them."""
        standard, express = struct.unpack(
            "<HH", await self._ask(request(RplidarCommand.SAMPLE_RATE), DataType.SAMPLE_RATE)
        )
        longest = 12.0  # of all models with such firmware
        return (
            ScanMode(0, "Standard", standard * 1e-6, longest, DataType.STANDARD),
            ScanMode(0, "Express", express * 1e-6, longest, DataType.EXPRESS),
        ), 1

    async def _has_pwm(self, identity: RplidarIdentity) -> bool:
        if identity.model >> 4 not in (2, 3):  # only the A2's and the A3's adapter board may
            return False
        answer = await self._ask(request(RplidarCommand.ADAPTER, bytes(4)), DataType.ADAPTER)
        return bool(answer[0] & 1)  # bit of the adapter board's answer

    async def _property(self, key: ConfigKey, mode: int = 0) -> bytes:
        data = await self._ask(config_request(key, mode), DataType.CONFIG)
        if len(data) < 5 or struct.unpack_from("<I", data)[0] != key:  # key and at least one byte
            raise ProtocolError(f"{self._link.name}: answered with a property other than {key.name}")
        return data[4:] + bytes(4)

    async def _ask(self, asked: bytes, kind: DataType) -> bytes:
        self._link.discard()
        self._link.write(asked)
        found = parse_descriptor(await self._descriptor(kind.name))
        if found.type != kind or found.repeated or not 0 < found.length <= 128:  # bytes of the longest single answer
            raise ProtocolError(f"{self._link.name}: {kind.name} answered with type 0x{found.type:02x}")
        return await self._exactly(found.length, kind.name)

    async def _descriptor(self, what: str) -> bytes:
        """Receive the next descriptor; skip start-up text and remnants of a stream before it."""
        head = await self._exactly(DESCRIPTOR, what)
        passed = 0
        while not head.startswith(ANSWER):
            self._heard += 1
            passed += 1
            if passed > 4096:  # more than any unit sends before it answers
                raise WrongDeviceError(f"{self._link.name}: {passed} bytes, but no answer from an RPLIDAR")
            head = head[1:] + await self._exactly(1, what)
        return head

    async def _exactly(self, count: int, what: str) -> bytes:
        try:
            data = await self._link.exactly(count, self._config.answer_timeout)
        except TimeoutError:
            raise DeviceTimeoutError(f"{self._link.name}: no answer to {what}") from None
        return data


async def identify(link: Link, clock: Clock, settings: RplidarConfig) -> dict[str, object]:
    """Perform the handshake; the unit is idle afterwards.

    Returns:
        JSON-compatible dict: ``device`` with the model number, ``serial``, ``firmware``, ``health``, ``modes`` by name
        (samples per second), ``typical``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    unit = await RplidarSession(link, clock, settings).handshake()
    return {
        "device": f"SLAMTEC RPLIDAR, model 0x{unit.identity.model:02x}",
        "serial": unit.identity.serial,
        "firmware": ".".join(map(str, unit.identity.firmware)),
        "health": unit.health.status,
        "modes": {mode.name: round(1.0 / mode.sample_time) for mode in unit.modes},
        "typical": next((mode.name for mode in unit.modes if mode.number == unit.typical), None),
    }
