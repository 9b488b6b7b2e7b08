"""Transfers over a kernel I2C bus; needs only the standard library, so that the stop script can use it.

Source: kernel documentation, i2c/dev-interface: ``I2C_RDWR`` joins messages with a repeated start.
"""

import ctypes
import fcntl


class I2cMessage(ctypes.Structure):
    """``struct i2c_msg``."""

    _fields_ = (
        ("address", ctypes.c_uint16),
        ("flags", ctypes.c_uint16),
        ("length", ctypes.c_uint16),
        ("buffer", ctypes.POINTER(ctypes.c_char)),
    )


class I2cMessages(ctypes.Structure):
    """``struct i2c_rdwr_ioctl_data``."""

    _fields_ = (("messages", ctypes.POINTER(I2cMessage)), ("count", ctypes.c_uint32))


def limit_waits(bus: int) -> None:
    """Limit how long the adapter waits for a device that stretches the clock.

    Raises:
        OSError: ``bus`` is not an I2C bus.
    """
    fcntl.ioctl(bus, 0x0702, 5)  # I2C_TIMEOUT of one transfer, in 10 ms


def transfer(bus: int, address: int, data: bytes, count: int = 0) -> bytes:
    """Write ``data``, then read ``count`` bytes after a repeated start.

    Args:
        bus: file descriptor of the bus.
        address: 7-bit address.
        data: bytes to write; if empty, only read.
        count: number of bytes to read; if 0, only write.

    Raises:
        OSError: ENXIO or EREMOTEIO if the device does not acknowledge, ETIMEDOUT if the bus is held.
    """
    written, read = ctypes.create_string_buffer(data, len(data)), ctypes.create_string_buffer(count)
    parts = [(0, written)] * bool(data) + [(0x0001, read)] * bool(count)  # I2C_M_RD
    pointer = ctypes.POINTER(ctypes.c_char)
    messages = (I2cMessage * len(parts))(
        *(I2cMessage(address, flags, len(buffer), ctypes.cast(buffer, pointer)) for flags, buffer in parts)
    )
    fcntl.ioctl(bus, 0x0707, I2cMessages(messages, len(parts)))  # I2C_RDWR
    return read.raw
