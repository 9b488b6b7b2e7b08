"""PCA9685 registers and pulse arithmetic.

Source: NXP, PCA9685 product data sheet: addresses, register definitions (table 3), restart, prescaler, software reset.
The data sheet gives only a typical oscillator frequency, without a tolerance; board makers report 23 to 27 MHz
(Adafruit PWM servo driver library).
"""

from enum import IntEnum, IntFlag
from typing import Final

ADDRESS: Final = 0x40
"""Address with all address pins low, which an INA219 also uses."""
ADDRESSES: Final = range(0x40, 0x80)
"""Addresses that the six pins select."""
CHANNELS: Final = 16
COUNTS: Final = 4096
"""Counts per cycle."""
OSCILLATOR: Final = 25e6
"""Typical frequency of the internal oscillator (Hz)."""
PRESCALES: Final = range(3, 256)
"""Valid prescaler values."""
PRESCALE_RESET: Final = 0x1E
WAKE_UP: Final = 500e-6
"""Start-up time of the oscillator after sleep (s)."""
OWN_ADDRESSES: Final = bytes((0xE2, 0xE4, 0xE8, 0xE0))
"""Values of ``SUBADR1`` to ``ALLCALLADR`` after power-up, left-aligned: they are the chip's only identification."""
GENERAL_CALL: Final = 0x00
RESET_BYTE: Final = 0x06
"""Byte that resets every PCA9685 when it is written to the general call address."""
FULL: Final = 0x10
"""Bit of ``ON_H`` and ``OFF_H``: always on, or always off; off takes precedence."""


class PwmRegister(IntEnum):
    """Registers by address."""

    MODE1 = 0x00
    MODE2 = 0x01
    SUBADR1 = 0x02
    ALLCALLADR = 0x05
    LED0_ON_L = 0x06
    ALL_LED_ON_L = 0xFA
    PRE_SCALE = 0xFE


LAST_OF_BLOCK: Final = 0x45
"""``LED15_OFF_H``: auto-increment continues at ``MODE1``, as it does after ``PRE_SCALE``."""


class PwmMode1(IntFlag):
    """Bits of ``MODE1``."""

    RESTART = 0x80
    EXTCLK = 0x40
    AI = 0x20
    SLEEP = 0x10
    SUB1 = 0x08
    SUB2 = 0x04
    SUB3 = 0x02
    ALLCALL = 0x01


class PwmMode2(IntFlag):
    """Bits of ``MODE2``."""

    INVRT = 0x10
    OCH = 0x08
    OUTDRV = 0x04


MODE1_RESET: Final = PwmMode1.SLEEP | PwmMode1.ALLCALL
MODE2_RESET: Final = PwmMode2.OUTDRV


def prescale(frequency: float, oscillator: float = OSCILLATOR) -> int:
    """Return the prescaler value for a pulse rate (Hz).

    Raises:
        ValueError: the prescaler cannot reach this rate.
    """
    value = round(oscillator / (COUNTS * frequency)) - 1
    if value not in PRESCALES:
        raise ValueError(f"{frequency:g} Hz needs a prescaler of {value}; expected {PRESCALES[0]} to {PRESCALES[-1]}")
    return value


def count_us(prescaler: int, oscillator: float = OSCILLATOR) -> float:
    """Return the duration of a count (us)."""
    return (prescaler + 1) / oscillator * 1e6


def register_of(channel: int) -> int:
    """Return the first of a channel's four registers."""
    return PwmRegister.LED0_ON_L + 4 * channel


def pulse(channel: int, counts: int) -> bytes:
    """Return the register and values for a pulse that starts with the cycle; 0 counts mean no pulse.

    Raises:
        ValueError: the pulse is longer than a cycle.
    """
    if not 0 <= counts < COUNTS:
        raise ValueError(f"{counts} counts do not fit a cycle of {COUNTS}")
    low, high = (counts & 0xFF, counts >> 8) if counts else (0, FULL)
    return bytes((register_of(channel), 0, 0, low, high))


def counts_of(values: bytes) -> int:
    """Return the pulse length in counts from a channel's four registers; 0 means no pulse."""
    on, off = int.from_bytes(values[:2], "little"), int.from_bytes(values[2:4], "little")
    if off & FULL << 8:
        return 0
    if on & FULL << 8:
        return COUNTS
    return (off - on) % COUNTS
