"""RPLIDAR requests, answers and samples (SLAMTEC, "RPLIDAR interface protocol and application notes" 2.8).

A request consists of 0xA5, the command, and, for commands with a payload, its length, the payload, and the exclusive or
of all preceding bytes. An answer begins with a descriptor: A5 5A, 30 bits of length and 2 of mode (1 = repeated), type
of data. Samples come in one of four forms:

- standard (0x81): one sample in five bytes, checked by three bits only;
- express (0x82): 32 samples in 84 bytes, each with an individual angle correction to subtract;
- ultra (0x84): 96 samples in 132 bytes, of each three neighbours, one is absolute and two are differences; angle
corrections follow from the distances, as in the manufacturer's library; - dense (0x85): 40 samples in 84 bytes.

The last three forms contain their start angle; their samples are spread evenly up to the start of the next record.
Angles increase clockwise seen from above; 0 is straight ahead.
"""

import functools
import math
import operator
import struct
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import Array, RangeSheet

SYNC: Final = 0xA5
ANSWER: Final = b"\xa5\x5a"
DESCRIPTOR: Final = 7
TURN_Q6: Final = 360 << 6
"""A turn in 1/64 degrees."""


class RplidarCommand(IntEnum):
    """Second byte of a request; commands from 0x80 upwards have a payload."""

    STOP = 0x25
    RESET = 0x40
    SCAN = 0x20
    FORCE_SCAN = 0x21
    INFO = 0x50
    HEALTH = 0x52
    SAMPLE_RATE = 0x59
    EXPRESS_SCAN = 0x82
    CONFIG = 0x84
    MOTOR_PWM = 0xF0
    ADAPTER = 0xFF


class DataType(IntEnum):
    """Last byte of a descriptor."""

    INFO = 0x04
    HEALTH = 0x06
    SAMPLE_RATE = 0x15
    CONFIG = 0x20
    STANDARD = 0x81
    EXPRESS = 0x82
    ULTRA = 0x84
    DENSE = 0x85
    ADAPTER = 0xFF


class ConfigKey(IntEnum):
    """Properties that ``RplidarCommand.CONFIG`` requests."""

    MODE_COUNT = 0x70
    SAMPLE_TIME = 0x71
    """Sample time (1/256 us)."""
    LONGEST = 0x74
    """Maximum range (1/256 m)."""
    ANSWER_TYPE = 0x75
    TYPICAL_MODE = 0x7C
    NAME = 0x7F


class ScanMode(NamedTuple):
    """A unit's scan mode."""

    number: int
    name: str
    sample_time: float
    """Time between samples (s)."""
    longest: float
    """Maximum range (m)."""
    answer: DataType


class RplidarModel(NamedTuple):
    """Data sheet of one model."""

    title: str
    number: int
    """Model number reported by the unit."""
    baud: int
    ranges: RangeSheet
    modes: tuple[ScanMode, ...]
    typical: int
    """Index into ``modes`` of the recommended mode."""
    frequency: float
    """Rotation rate (Hz)."""
    adapter: bool = False
    """Whether the adapter board drives the motor (``MOTOR_PWM``)."""


def _modes(*rows: tuple[str, float, float, DataType]) -> tuple[ScanMode, ...]:
    return tuple(ScanMode(i, name, us * 1e-6, far, kind) for i, (name, us, far, kind) in enumerate(rows))


_S, _E, _U, _D = DataType.STANDARD, DataType.EXPRESS, DataType.ULTRA, DataType.DENSE
MODELS: Final = {
    "a1": RplidarModel(
        "RPLIDAR A1M8", 0x18, 115200, RangeSheet(0.15, 12.0, 0.0, 0.01),
        _modes(("Standard", 500, 12, _S), ("Express", 250, 12, _E)), 1, 5.5,
    ),
    "a2": RplidarModel(
        "RPLIDAR A2M8", 0x28, 115200, RangeSheet(0.15, 12.0, 0.0, 0.01),
        _modes(("Standard", 500, 12, _S), ("Express", 250, 12, _E), ("Boost", 125, 12, _U)), 2, 10.0, True,
    ),
    "a3": RplidarModel(
        "RPLIDAR A3M1", 0x31, 256000, RangeSheet(0.2, 25.0, 0.0, 0.01, 10.0),
        _modes(("Standard", 250, 25, _S), ("Express", 125, 25, _E), ("Boost", 62.5, 25, _U),
               ("Sensitivity", 62.5, 25, _U)), 3, 10.0, True,
    ),
    "c1": RplidarModel(
        "RPLIDAR C1", 0x41, 460800, RangeSheet(0.05, 12.0, 0.03, 0.0, 6.0),
        _modes(("Standard", 200, 12, _S), ("DenseBoost", 200, 12, _D)), 0, 10.0,
    ),
    "s1": RplidarModel(
        "RPLIDAR S1", 0x61, 256000, RangeSheet(0.1, 40.0, 0.05, 0.0, 10.0),
        _modes(("Standard", 217, 40, _S), ("DenseBoost", 108.5, 40, _D)), 1, 10.0,
    ),
    "s2": RplidarModel(
        "RPLIDAR S2", 0x71, 1000000, RangeSheet(0.05, 30.0, 0.03, 0.0, 10.0),
        _modes(("Standard", 62.5, 30, _S), ("DenseBoost", 31.25, 30, _D)), 1, 10.0,
    ),
}  # fmt: skip
"""Ranges, rates and accuracy of the data sheets."""


# Requests and descriptors


def _xor(data: bytes) -> int:
    return functools.reduce(operator.xor, data, 0)


def request(command: RplidarCommand, payload: bytes = b"") -> bytes:
    """Encode a request."""
    if command < 0x80:  # commands without a payload
        return bytes((SYNC, command))
    body = bytes((SYNC, command, len(payload))) + payload
    return body + bytes((_xor(body),))


def express_request(mode: int) -> bytes:
    """Encode a request to scan in a mode other than the first."""
    return request(RplidarCommand.EXPRESS_SCAN, struct.pack("<BI", mode, 0))


def config_request(key: ConfigKey, mode: int = 0) -> bytes:
    """Encode a request for a property of a mode or of the unit."""
    own = key in (ConfigKey.MODE_COUNT, ConfigKey.TYPICAL_MODE)
    return request(RplidarCommand.CONFIG, struct.pack("<I", key) + (b"" if own else struct.pack("<H", mode)))


class Descriptor(NamedTuple):
    """Descriptor of the following answer."""

    length: int
    """Size of one record (bytes)."""
    repeated: bool
    type: int


def build_descriptor(descriptor: Descriptor) -> bytes:
    """Encode a descriptor."""
    return ANSWER + struct.pack("<IB", descriptor.length | descriptor.repeated << 30, descriptor.type)


def parse_descriptor(data: bytes) -> Descriptor:
    """Decode a descriptor from its seven bytes."""
    word, kind = struct.unpack("<IB", data[2:DESCRIPTOR])
    return Descriptor(word & 0x3FFFFFFF, bool(word >> 30), kind)


class RplidarIdentity(NamedTuple):
    """Reply to INFO."""

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial: str


def parse_info(data: bytes) -> RplidarIdentity:
    """Decode the identity from its 20 bytes."""
    return RplidarIdentity(data[0], (data[2], data[1]), data[3], data[4:20].hex().upper())


def build_info(identity: RplidarIdentity) -> bytes:
    """Inverse of ``parse_info``."""
    major, minor = identity.firmware
    return bytes((identity.model, minor, major, identity.hardware)) + bytes.fromhex(identity.serial)


class Health(NamedTuple):
    """Reply to HEALTH."""

    status: int
    """0 good, 1 warning, 2 protection stop."""
    code: int


# Samples


class Record(NamedTuple):
    """Samples of one record, still encoded."""

    start: int | None
    """Start angle of the samples (1/64 degrees); None if each sample has an angle."""
    fresh: bool
    """Whether the record begins a stream."""
    data: bytes


SIZES: Final = {DataType.STANDARD: 5, DataType.EXPRESS: 84, DataType.ULTRA: 132, DataType.DENSE: 84}
COUNTS: Final = {DataType.STANDARD: 1, DataType.EXPRESS: 32, DataType.ULTRA: 96, DataType.DENSE: 40}
"""Number of samples per record."""
SURE: Final = 8
"""Number of consecutive valid standard samples required after damage."""


class RecordParser:
    """Extracts records of one type from a byte stream; counts the bytes outside records.

    Args:
        kind: sample type.
    """

    def __init__(self, kind: DataType) -> None:
        self.refused = 0
        self._kind, self._size = kind, SIZES[kind]
        self._buffer = bytearray()
        self._sound = True

    def feed(self, data: bytes) -> list[Record]:
        """Return the completed records."""
        self._buffer += data
        return self._standard() if self._kind is DataType.STANDARD else self._capsules()

    def _capsules(self) -> list[Record]:
        buffer, size, at, records = self._buffer, self._size, 0, []
        while len(buffer) - at >= size:
            body = bytes(buffer[at : at + size])
            stated = (body[0] & 0xF) | (body[1] & 0xF) << 4
            if body[0] >> 4 == 0xA and body[1] >> 4 == 0x5 and _xor(body[2:]) == stated:
                (word,) = struct.unpack_from("<H", body, 2)
                records.append(Record(word & 0x7FFF, bool(word >> 15), body[4:]))
                at += size
            else:
                self.refused += 1
                at += 1
        del buffer[:at]
        return records

    def _standard(self) -> list[Record]:
        """Return valid samples; after damage, ``SURE`` consecutive valid samples are needed to resynchronise."""
        buffer, records = self._buffer, []
        while len(buffer) >= self._size * (1 if self._sound else SURE):
            whole = len(buffer) // self._size
            rows = np.frombuffer(bytes(buffer[: whole * self._size]), np.uint8).reshape(whole, self._size)
            angle = rows[:, 1].astype(np.uint16) >> 1 | rows[:, 2].astype(np.uint16) << 7
            sound = ((rows[:, 0] ^ rows[:, 0] >> 1) & 1 == 1) & (rows[:, 1] & 1 == 1) & (angle < TURN_Q6)
            run = whole if sound.all() else int(np.argmin(sound))
            if run >= (1 if self._sound else SURE):
                records.append(Record(None, False, rows[:run].tobytes()))
                del buffer[: run * self._size]
                self._sound = True
            if run < whole:
                self._sound = False
                self.refused += 1
                del buffer[:1]
        return records


class Decoded(NamedTuple):
    """Samples of a record."""

    turns: Array
    """Angles, shape (n,) (turns)."""
    ranges: Array
    """Ranges, shape (n,) (m); 0 = no return."""
    qualities: NDArray[np.uint8]
    """Qualities, shape (n,)."""


def decode_standard(data: bytes) -> Decoded:
    """Decode samples of five bytes each."""
    rows = np.frombuffer(data, np.uint8).reshape(-1, 5)
    angle = (rows[:, 1].astype(np.float64) // 2 + rows[:, 2] * 128.0) / TURN_Q6
    millimetres = (rows[:, 3] + rows[:, 4] * 256.0) / 4.0
    return Decoded(angle, millimetres / 1000.0, (rows[:, 0] >> 2).astype(np.uint8))


NO_QUALITY: Final = 47
"""Quality reported for every return of the forms without a quality, as in the manufacturer's library."""


def decode_capsule(kind: DataType, record: Record, following: Record) -> Decoded:
    """Decode a record; its samples are spread up to the start of the following record."""
    assert record.start is not None
    assert following.start is not None
    count = COUNTS[kind]
    span = (following.start - record.start) % TURN_Q6
    raw = (record.start + span / count * np.arange(count)) / TURN_Q6
    if kind is DataType.EXPRESS:
        millimetres, offsets = _express(record.data)
    elif kind is DataType.DENSE:
        millimetres, offsets = np.frombuffer(record.data, "<u2").astype(np.float64), np.zeros(count)
    else:
        millimetres = ultra_distances(record.data, following.data)
        offsets = ultra_offset(millimetres)
    strengths = np.where(millimetres > 0, NO_QUALITY, 0).astype(np.uint8)
    return Decoded(np.mod(raw - offsets, 1.0), millimetres / 1000.0, strengths)


def _express(data: bytes) -> tuple[Array, Array]:
    """Decode distances (mm) and angles to subtract (turns), each of shape (32,)."""
    rows = np.frombuffer(data, np.uint8).reshape(16, 5).astype(np.int64)
    first, second = rows[:, 0] | rows[:, 1] << 8, rows[:, 2] | rows[:, 3] << 8
    distances = np.stack((first >> 2, second >> 2), axis=1).ravel()
    offsets = np.stack((rows[:, 4] & 0xF | (first & 3) << 4, rows[:, 4] >> 4 | (second & 3) << 4), axis=1).ravel()
    return distances.astype(np.float64), offsets / 8.0 / 360.0


def build_express(millimetres: NDArray[np.int64], offsets: NDArray[np.int64]) -> bytes:
    """Encode the body of an express record: distances (mm, below 16384) and angles to subtract (1/8 degrees).

    Both have shape (32,).
    """
    words = millimetres << 2 | offsets >> 4
    rows = np.empty((16, 5), np.uint8)
    rows[:, 0], rows[:, 1] = words[::2] & 0xFF, words[::2] >> 8
    rows[:, 2], rows[:, 3] = words[1::2] & 0xFF, words[1::2] >> 8
    rows[:, 4] = offsets[::2] & 0xF | (offsets[1::2] & 0xF) << 4
    return rows.tobytes()


_LEVELS: Final = ((3328, 1 << 14, 4), (1792, 1 << 12, 3), (1280, 1 << 11, 2), (512, 1 << 9, 1), (0, 0, 0))
"""Levels of the ultra encoding: minimum code, its distance (mm), and the number of bits omitted from the distance."""


def ultra_decode(codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Decode distances (mm) from 12-bit codes, and the number of bits that each code omits."""
    distances, levels = np.zeros_like(codes), np.zeros_like(codes)
    for least, base, level in reversed(_LEVELS):
        there = codes >= least
        distances[there] = base + (codes[there] - least << level)
        levels[there] = level
    return distances, levels


def ultra_encode(millimetres: NDArray[np.int64]) -> NDArray[np.int64]:
    """Encode distances (mm) as 12-bit codes."""
    codes = np.zeros_like(millimetres)
    for least, base, level in reversed(_LEVELS):
        there = millimetres >= base
        codes[there] = least + (millimetres[there] - base >> level)
    return np.minimum(codes, 0xFFF)


_INVALID: Final = (-512, 511)
"""Differences that mark a beam without a return."""


def ultra_distances(data: bytes, following: bytes) -> Array:
    """Distances of an ultra record (mm), shape (96,); 0 = no return. The last ones depend on the following record."""
    words = np.frombuffer(data, "<u4").astype(np.int64)
    after = np.frombuffer(following, "<u4", 1).astype(np.int64)
    major, level = ultra_decode(np.append(words, after) & 0xFFF)
    base, base_level = major[:-1], level[:-1]
    lean = (base == 0) & (major[1:] > 0)
    base, base_level = np.where(lean, major[1:], base), np.where(lean, level[1:], base_level)
    differences = [_signed(words >> shift & 0x3FF) for shift in (12, 22)]
    one = np.where(np.isin(differences[0], _INVALID), 0, base + (differences[0] << base_level))
    two = np.where(np.isin(differences[1], _INVALID), 0, major[1:] + (differences[1] << level[1:]))
    return np.asarray(np.maximum(np.stack((major[:-1], one, two), axis=1).ravel(), 0), np.float64)


def build_ultra(millimetres: NDArray[np.int64]) -> bytes:
    """Encode the body of an ultra record from its distances and the one that follows, (97,) (mm); 0 = no return."""
    codes = ultra_encode(millimetres[::3])
    major, level = ultra_decode(codes)
    base, base_level = major[:-1], level[:-1]
    lean = (base == 0) & (major[1:] > 0)
    base, base_level = np.where(lean, major[1:], base), np.where(lean, level[1:], base_level)
    one = _difference(millimetres[1::3], base, base_level)
    two = _difference(millimetres[2::3], major[1:], level[1:])
    return (codes[:-1] | (one & 0x3FF) << 12 | (two & 0x3FF) << 22).astype("<u4").tobytes()


def _difference(millimetres: NDArray[np.int64], base: NDArray[np.int64], level: NDArray[np.int64]) -> NDArray[np.int64]:
    found = millimetres - base >> level
    return np.where((millimetres == 0) | (found <= -512) | (found >= 511), 511, found)


def _signed(ten_bits: NDArray[np.int64]) -> NDArray[np.int64]:
    return (ten_bits ^ 0x200) - 0x200


def ultra_offset(millimetres: Array) -> Array:
    """Angle to subtract (turns) at distances (n,), because the triangulating sensor is offset from its axis."""
    quarter = np.maximum(millimetres * 4.0, 1.0)
    part = np.floor(98361.0 / quarter)
    near = math.radians(8.0) * 65536.0 - part * 64.0 - part**3 / 98304.0
    offset: Array = np.where(quarter >= 200.0, near, math.radians(7.5) * 65536.0)
    return np.asarray(offset / (65536.0 * math.tau))


def build_capsule(start: int, body: bytes, *, fresh: bool) -> bytes:
    """Encode an express, ultra or dense record that starts at angle ``start`` (1/64 degrees)."""
    tail = struct.pack("<H", start % TURN_Q6 | fresh << 15) + body
    total = _xor(tail)
    return bytes((0xA0 | total & 0xF, 0x50 | total >> 4)) + tail


def build_standard(
    turns: Array, millimetres: NDArray[np.int64], qualities: NDArray[np.int64], starts: NDArray[np.bool_]
) -> bytes:
    """Encode standard samples: angles (turns), distances (mm), qualities below 64, start-of-turn flags; each (n,)."""
    angle = np.rint(turns * TURN_Q6).astype(np.int64) % TURN_Q6
    distance = np.minimum(millimetres * 4, 0xFFFF)
    rows = np.empty((len(turns), 5), np.uint8)
    rows[:, 0] = qualities << 2 | np.where(starts, 1, 2)
    rows[:, 1], rows[:, 2] = (angle & 0x7F) << 1 | 1, angle >> 7
    rows[:, 3], rows[:, 4] = distance & 0xFF, distance >> 8
    return rows.tobytes()
