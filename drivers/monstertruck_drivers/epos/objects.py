"""Object dictionary, error codes and fault codes of the EPOS 24/1 (maxon Firmware Specification).

Standard library only, like ``protocol``.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class ObjectEntry:
    """One object: address, width in bits, signedness and access (``ro``, ``wo``, ``rw``)."""

    name: str
    index: int
    sub: int
    width: int
    signed: bool = False
    access: str = "rw"

    @property
    def limits(self) -> tuple[int, int]:
        """Minimum and maximum value."""
        return (-(1 << (self.width - 1)), (1 << (self.width - 1)) - 1) if self.signed else (0, (1 << self.width) - 1)

    def encode(self, value: int) -> int:
        """Encode ``value`` as unsigned 32 bits, sign- or zero-extended.

        Raises:
            ValueError: ``value`` does not fit.
        """
        low, high = self.limits
        if not low <= value <= high:
            raise ValueError(f"{self}: {value} is outside {low}..{high}")
        return value & 0xFFFFFFFF

    def decode(self, raw: int) -> int:
        """Decode a value from 32 bits, truncated to the object's size."""
        value = raw & ((1 << self.width) - 1)
        return value - (1 << self.width) if self.signed and value >> (self.width - 1) else value

    def __str__(self) -> str:
        return f"0x{self.index:04X}/{self.sub} ({self.name})"


ERROR_REGISTER = ObjectEntry("error register", 0x1001, 0, 8, access="ro")
ERROR_COUNT = ObjectEntry("number of errors", 0x1003, 0, 8)
HISTORY_SIZE = 5
ERROR_HISTORY = tuple(
    ObjectEntry(f"error history {sub}", 0x1003, sub, 32, access="ro") for sub in range(1, HISTORY_SIZE + 1)
)
STORE = ObjectEntry("save all parameters", 0x1010, 1, 32)
RESTORE = ObjectEntry("restore default parameters", 0x1011, 1, 32)
NODE_ID = ObjectEntry("node id", 0x2000, 0, 8)
RS232_RATE = ObjectEntry("RS232 rate code", 0x2002, 0, 16)
SOFTWARE_VERSION = ObjectEntry("software version", 0x2003, 1, 16, access="ro")
HARDWARE_VERSION = ObjectEntry("hardware version", 0x2003, 2, 16, access="ro")
SERIAL_NUMBER = ObjectEntry("serial number", 0x2004, 0, 64, access="ro")
RS232_TIMEOUT = ObjectEntry("RS232 frame timeout", 0x2005, 0, 16)
CURRENT_AVERAGED = ObjectEntry("current averaged", 0x2027, 0, 16, signed=True, access="ro")
VELOCITY_AVERAGED = ObjectEntry("velocity averaged", 0x2028, 0, 32, signed=True, access="ro")
DIGITAL_INPUTS = ObjectEntry("digital input state", 0x2071, 1, 16, access="ro")
INPUT_MASK = ObjectEntry("digital input mask", 0x2071, 2, 16)
INPUT_POLARITY = ObjectEntry("digital input polarity", 0x2071, 3, 16)
INPUT_EXECUTION = ObjectEntry("digital input execution mask", 0x2071, 4, 16)
ENCODER_PULSES = ObjectEntry("encoder pulses per turn", 0x2210, 1, 16)
SENSOR_TYPE = ObjectEntry("position sensor type", 0x2210, 2, 16)
SENSOR_POLARITY = ObjectEntry("position sensor polarity", 0x2210, 4, 16)
CONTROLWORD = ObjectEntry("controlword", 0x6040, 0, 16)
STATUSWORD = ObjectEntry("statusword", 0x6041, 0, 16, access="ro")
MODE = ObjectEntry("mode of operation", 0x6060, 0, 8, signed=True)
MODE_DISPLAY = ObjectEntry("mode of operation display", 0x6061, 0, 8, signed=True, access="ro")
POSITION = ObjectEntry("position actual", 0x6064, 0, 32, signed=True, access="ro")
VELOCITY_DEMAND = ObjectEntry("velocity demand", 0x606B, 0, 32, signed=True, access="ro")
VELOCITY = ObjectEntry("velocity actual", 0x606C, 0, 32, signed=True, access="ro")
CURRENT = ObjectEntry("current actual", 0x6078, 0, 16, signed=True, access="ro")
MAX_VELOCITY = ObjectEntry("maximal profile velocity", 0x607F, 0, 32)
MARK = ObjectEntry("profile velocity", 0x6081, 0, 32)
"""Object of profile position mode, without effect in profile velocity mode: its value lasts until the controller
restarts, and so reveals a restart."""
ACCELERATION = ObjectEntry("profile acceleration", 0x6083, 0, 32)
DECELERATION = ObjectEntry("profile deceleration", 0x6084, 0, 32)
QUICK_STOP_DECELERATION = ObjectEntry("quick stop deceleration", 0x6085, 0, 32)
PROFILE_TYPE = ObjectEntry("motion profile type", 0x6086, 0, 16, signed=True)
VELOCITY_NOTATION = ObjectEntry("velocity notation", 0x608B, 0, 8, signed=True)
TARGET_VELOCITY = ObjectEntry("target velocity", 0x60FF, 0, 32, signed=True)
MOTOR_TYPE = ObjectEntry("motor type", 0x6402, 0, 16)
CONTINUOUS_CURRENT = ObjectEntry("continuous current limit", 0x6410, 1, 16)
PEAK_CURRENT = ObjectEntry("output current limit", 0x6410, 2, 16)
POLE_PAIRS = ObjectEntry("pole pairs", 0x6410, 3, 8)
MOTOR_MAX_SPEED = ObjectEntry("maximal motor speed", 0x6410, 4, 16)
THERMAL_TIME = ObjectEntry("thermal time constant", 0x6410, 5, 16)

OBJECTS: dict[tuple[int, int], ObjectEntry] = {
    (entry.index, entry.sub): entry
    for value in list(globals().values())
    for entry in (value if isinstance(value, tuple) else (value,))
    if isinstance(entry, ObjectEntry)
}
"""Every object of this module by (index, subindex)."""

PROFILE_VELOCITY = 3
"""Value of ``MODE``: profile velocity mode."""
RPM = 0
"""Value of ``VELOCITY_NOTATION``."""
SAVE = 0x65766173
LOAD = 0x64616F6C

COUNTS_PER_PULSE = 4
"""Position counts per encoder pulse (both edges of both channels)."""

QUICK_STOP_INPUT = 1 << 5
"""Bit of the digital inputs: function "quick stop"."""

ABORT_TEXTS: dict[int, str] = {
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO timeout",
    0x05040001: "unknown command",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "access not supported",
    0x06010001: "read of a write-only object",
    0x06010002: "write of a read-only object",
    0x06020000: "no such object",
    0x06040041: "object cannot be mapped",
    0x06040042: "PDO length exceeded",
    0x06040043: "parameter incompatibility",
    0x06040047: "internal incompatibility",
    0x06060000: "hardware error",
    0x06070010: "length mismatch",
    0x06070012: "too long",
    0x06070013: "too short",
    0x06090011: "no such subindex",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum below minimum",
    0x08000000: "general error",
    0x08000020: "cannot be stored",
    0x08000021: "local control",
    0x08000022: "wrong device state",
    0x0F00FFB9: "wrong node id",
    0x0F00FFBC: "not in service mode",
    0x0F00FFBE: "wrong password",
    0x0F00FFBF: "illegal RS232 command",
    0x0F00FFC0: "wrong NMT state",
}
"""Communication errors, by the first two words of an answer."""

READ_OF_WRITE_ONLY = 0x06010001
WRITE_OF_READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NO_SUBINDEX = 0x06090011
LENGTH_MISMATCH = 0x06070010
TOO_HIGH = 0x06090031
TOO_LOW = 0x06090032
CANNOT_STORE = 0x08000020
TOGGLE_ERROR = 0x05030000
WRONG_STATE = 0x08000022
ILLEGAL_COMMAND = 0x0F00FFBF
WRONG_NODE = 0x0F00FFB9

FAULT_TEXTS: dict[int, str] = {
    0x1000: "generic error",
    0x2310: "over-current",
    0x3210: "over-voltage",
    0x3220: "under-voltage",
    0x4210: "over-temperature",
    0x5113: "logic supply too low",
    0x5114: "output stage supply too low",
    0x6100: "internal software error",
    0x6320: "software parameter error",
    0x7320: "position sensor error",
    0x8110: "CAN overrun (objects lost)",
    0x8111: "CAN overrun",
    0x8120: "CAN passive mode",
    0x8130: "CAN life guard error",
    0x8150: "CAN transmit COB-ID collision",
    0x81FD: "CAN bus off",
    0x81FE: "CAN receive queue overrun",
    0x81FF: "CAN transmit queue overrun",
    0x8210: "CAN PDO length error",
    0x8611: "following error",
    0xFF01: "Hall sensor error",
    0xFF02: "index processing error",
    0xFF03: "encoder resolution error",
    0xFF04: "Hall sensor not found",
    0xFF06: "negative limit",
    0xFF07: "positive limit",
    0xFF08: "Hall angle detection error",
    0xFF09: "software position limit",
    0xFF0A: "position sensor breach",
    0xFF0B: "system overloaded",
}
"""Device faults, by the low 16 bits of an error history entry."""

OVER_CURRENT = 0x2310
OVER_VOLTAGE = 0x3210
UNDER_VOLTAGE = 0x3220
POSITION_SENSOR = 0x7320
FOLLOWING_ERROR = 0x8611


def abort_text(code: int) -> str:
    """Meaning of a communication error."""
    return f"0x{code:08X} ({ABORT_TEXTS.get(code, 'not documented')})"


def fault_text(code: int) -> str:
    """Meaning of a device fault."""
    return f"0x{code:04X} ({FAULT_TEXTS.get(code, 'not documented')})"
