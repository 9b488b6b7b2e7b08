"""VESC packets: a codec that needs only the standard library, so that the stop script can use it.

A packet is a start byte, the length of its payload, the payload, a CRC of the payload (polynomial 0x1021, initial value
0, high byte first) and a stop byte. Start byte 2 is followed by one length byte, start byte 3 by two. The first byte of
the payload names the packet; numbers are big-endian and scaled. Source: VESC firmware (vedderb/bldc), ``comm/packet.c``
(framing), ``comm/commands.c`` (payloads), ``datatypes.h`` (packet and fault codes), ``confgenerator.c`` (settings).
"""

import binascii
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Self

VESC_BAUD: Final = 115_200
SHORT: Final = 2
LONG: Final = 3
STOP: Final = 3
MAX_PAYLOAD: Final = 512
"""Maximum payload of the firmware (bytes)."""
TICKS_PER_ELECTRICAL_TURN: Final = 6
"""Tachometer steps per electrical turn."""
SERVO_SCALE: Final = 1000.0
OLDEST_FIRMWARE: Final = 5
"""Oldest supported major version of the firmware."""


class PacketId(IntEnum):
    """First byte of a payload."""

    FW_VERSION = 0
    GET_VALUES = 4
    SET_DUTY = 5
    SET_CURRENT = 6
    SET_CURRENT_BRAKE = 7
    SET_RPM = 8
    SET_SERVO_POS = 12
    GET_APPCONF = 17
    ALIVE = 30
    FORWARD_CAN = 34
    SET_APPCONF_NO_STORE = 149
    """Settings until the next power-up; the answer is this packet's number."""


class PacketError(ValueError):
    """A payload is malformed or unexpected."""


def frame(payload: bytes) -> bytes:
    """Return a payload as a packet.

    Raises:
        ValueError: the payload is empty or too long.
    """
    if not 0 < len(payload) <= MAX_PAYLOAD:
        raise ValueError(f"payload of {len(payload)} bytes: expected 1 to {MAX_PAYLOAD}")
    head = bytes((SHORT, len(payload))) if len(payload) < 256 else bytes((LONG,)) + len(payload).to_bytes(2, "big")
    return head + payload + binascii.crc_hqx(payload, 0).to_bytes(2, "big") + bytes((STOP,))


class Deframer:
    """Splits a byte stream, in chunks of any size, into payloads; counts the bytes outside packets."""

    def __init__(self) -> None:
        self.bad = 0
        """Number of bytes outside of packets."""
        self.strange = b""
        """Latest bytes outside of packets."""
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the payloads completed by ``data``."""
        self._rest += data
        payloads = []
        while self._rest:
            size = self._size()
            if size is None:
                break
            if size:
                payloads.append(bytes(self._rest[self._head() : size - 3]))
                del self._rest[:size]
            else:
                self.bad += 1
                self.strange = (self.strange + self._rest[:1])[-16:]
                del self._rest[:1]
        return payloads

    def restart(self) -> None:
        """Drop an incomplete packet."""
        self._rest.clear()

    def _head(self) -> int:
        """Number of start and length bytes."""
        return self._rest[0]

    def _size(self) -> int | None:
        """Length of the packet at the start of the buffer; 0 if there is none, None if more bytes are needed."""
        rest = self._rest
        if rest[0] not in (SHORT, LONG):
            return 0
        head = self._head()
        if len(rest) < head:
            return None
        length = int.from_bytes(rest[1:head], "big")
        if not (1 if head == SHORT else 255) <= length <= MAX_PAYLOAD:
            return 0
        size = head + length + 3
        if len(rest) < size:
            return None
        whole = rest[size - 1] == STOP and binascii.crc_hqx(rest[head : size - 3], 0) == int.from_bytes(
            rest[size - 3 : size - 1], "big"
        )
        return size if whole else 0


def forwarded(can_id: int | None, payload: bytes) -> bytes:
    """Wrap a payload for the controller at a CAN id; None addresses the connected controller."""
    return payload if can_id is None else bytes((PacketId.FORWARD_CAN, can_id)) + payload


def request(packet: PacketId) -> bytes:
    """Return the payload of a packet without content."""
    return bytes((packet,))


def set_rpm(erpm: int) -> bytes:
    """Payload that makes the speed controller hold an electrical speed (rpm)."""
    return struct.pack(">Bi", PacketId.SET_RPM, erpm)


def set_current(amperes: float) -> bytes:
    """Payload that drives with a current (A); with 0 the motor coasts."""
    return struct.pack(">Bi", PacketId.SET_CURRENT, round(1000 * amperes))


def set_brake(amperes: float) -> bytes:
    """Payload that brakes with a current (A) until the motor stops."""
    return struct.pack(">Bi", PacketId.SET_CURRENT_BRAKE, round(1000 * amperes))


def set_servo(position: float) -> bytes:
    """Payload that moves the servo output to 0..1 of its range."""
    return struct.pack(">Bh", PacketId.SET_SERVO_POS, round(SERVO_SCALE * position))


@dataclass(frozen=True, slots=True)
class FirmwareIdentity:
    """Reply to ``FW_VERSION``."""

    major: int
    minor: int
    hardware: str
    serial: bytes
    """Unique number of its processor, 12 bytes."""

    @classmethod
    def of(cls, payload: bytes) -> Self:
        """Parse a payload.

        Raises:
            PacketError: the payload is not a firmware version.
        """
        name, end, rest = payload[3:].partition(b"\0")
        if payload[:1] != bytes((PacketId.FW_VERSION,)) or not end or len(rest) < 12:
            raise PacketError(f"{payload[:20].hex(' ')}: expected a firmware version")
        return cls(payload[1], payload[2], name.decode("ascii", "backslashreplace"), rest[:12])

    def payload(self) -> bytes:
        """Encode the identity as an answer."""
        head = bytes((PacketId.FW_VERSION, self.major, self.minor)) + self.hardware.encode("ascii") + b"\0"
        # Pairing, test version, hardware type, custom settings, phase filters, two interfaces, radio, name.
        return head + self.serial + bytes(9)


_VALUES: Final = struct.Struct(">BhhiiiihihiiiiiiBiB")
_LATER: Final = struct.Struct(">hhhiiB")
"""Fields that newer firmware adds: temperatures, voltages, status."""


@dataclass(frozen=True, slots=True)
class MotorValues:
    """Answer to ``GET_VALUES``: the fields used, in the packet's units and with the controller's sign."""

    motor_current: float
    """Motor current (A)."""
    duty: float
    """Duty cycle, -1..1."""
    erpm: int
    """Electrical speed (rpm)."""
    volts: float
    """Supply voltage (V)."""
    tachometer: int
    """Tachometer (sixths of electrical turns since power-up); signed 32 bits, wraps."""
    tachometer_abs: int
    """Like ``tachometer``, but increasing in both directions."""
    fault: int
    controller_id: int
    celsius: float = 25.0
    """Temperature of the transistors (degrees Celsius)."""
    timed_out: bool = False
    """Whether the watchdog controls the motor."""

    @classmethod
    def of(cls, payload: bytes) -> Self:
        """Parse a payload; later firmware may append fields.

        Raises:
            PacketError: the payload does not contain motor values.
        """
        if len(payload) < _VALUES.size or payload[0] != PacketId.GET_VALUES:
            raise PacketError(f"{payload[:20].hex(' ')}: expected values of a motor, {_VALUES.size} bytes or more")
        found = _VALUES.unpack_from(payload)
        later = payload[_VALUES.size :]
        return cls(
            motor_current=found[3] / 100,
            duty=found[7] / 1000,
            erpm=found[8],
            volts=found[9] / 10,
            tachometer=found[14],
            tachometer_abs=found[15],
            fault=found[16],
            controller_id=found[18],
            celsius=found[1] / 10,
            timed_out=len(later) >= _LATER.size and bool(_LATER.unpack_from(later)[-1] & 1),
        )

    def payload(self) -> bytes:
        """Encode the answer; unused fields are 0."""
        return _VALUES.pack(
            PacketId.GET_VALUES,
            round(10 * self.celsius),
            0,
            round(100 * self.motor_current),
            round(100 * self.motor_current * self.duty),
            0,
            round(100 * self.motor_current),
            round(1000 * self.duty),
            self.erpm,
            round(10 * self.volts),
            *(0, 0, 0, 0),
            wrapped(self.tachometer),
            wrapped(self.tachometer_abs),
            self.fault,
            0,
            self.controller_id,
        ) + _LATER.pack(0, 0, 0, 0, 0, int(self.timed_out))


_WATCHDOG: Final = struct.Struct(">If")
_WATCHDOG_AT: Final = 6
"""Offset of the watchdog's settings in a settings payload: after packet, signature (4 bytes) and CAN id."""


@dataclass(frozen=True, slots=True)
class WatchdogSetting:
    """Controller watchdog, which brakes when set-points stop."""

    milliseconds: int
    """Time without a set-point until the watchdog acts (ms); 0 = never."""
    brake_current: float
    """Brake current (A); 0 = the motor coasts."""

    @classmethod
    def of(cls, settings: bytes) -> Self:
        """Parse an answer to ``GET_APPCONF``.

        Raises:
            PacketError: the payload does not contain the settings.
        """
        if len(settings) < _WATCHDOG_AT + _WATCHDOG.size or settings[0] != PacketId.GET_APPCONF:
            raise PacketError(f"{settings[:20].hex(' ')}: expected settings")
        return cls(*_WATCHDOG.unpack_from(settings, _WATCHDOG_AT))

    def applied(self, settings: bytes) -> bytes:
        """Return a payload that writes these settings with this watchdog, valid until the next power-up."""
        end = _WATCHDOG_AT + _WATCHDOG.size
        new = _WATCHDOG.pack(self.milliseconds, self.brake_current)
        return bytes((PacketId.SET_APPCONF_NO_STORE,)) + settings[1:_WATCHDOG_AT] + new + settings[end:]


FAULTS: Final = (
    *("none", "over voltage", "under voltage", "gate driver", "over current", "transistors too hot"),
    *("motor too hot", "gate driver over voltage", "gate driver under voltage", "processor under voltage"),
    *("restarted by its own watchdog", "encoder connection"),
)
"""Texts of the fault codes, starting with 0."""


def fault_text(code: int) -> str:
    """Return the meaning of a fault code."""
    return f"{code} ({FAULTS[code]})" if code < len(FAULTS) else str(code)


def wrapped(value: int) -> int:
    """Wrap a number to a signed 32-bit counter."""
    return (value + (1 << 31)) % (1 << 32) - (1 << 31)


def step(before: int, now: int) -> int:
    """Steps between two readings of a counter, across its wrap."""
    return wrapped(now - before)


def stop_frames(brake: float, can_id: int | None) -> tuple[bytes, bytes]:
    """Return two packets: one brakes a motor with a current (A), the other lets it coast."""
    return frame(forwarded(can_id, set_brake(brake))), frame(forwarded(can_id, set_current(0.0)))
