"""Voltages from Linux Industrial-IO converters, read from sysfs; every function blocks and must run in a thread.

Source: kernel documentation, ABI/testing/sysfs-bus-iio: a voltage in millivolts is (raw + offset) * scale, where
offset and scale may be given per channel or for all.
"""

import errno
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceTimeoutError,
    PortBusyError,
    ProtocolError,
)

CONVERTERS: Final = "sys/bus/iio/devices"
"""Folder of the kernel's converters, below a computer's root."""
ROOT: Final = Path("/", CONVERTERS)
_GONE: Final = frozenset({errno.ENOENT, errno.ENODEV, errno.ENXIO})
_SCAN_TYPE: Final = re.compile(r"[bl]e:([su])(\d+)/")


@dataclass(frozen=True, slots=True)
class Converter:
    """One converter."""

    path: Path
    name: str

    def channels(self) -> list[int]:
        """Numbers of the converter's voltage inputs."""
        return sorted(
            int(file.name[10:-4]) for file in self.path.glob("in_voltage[0-9]*_raw") if file.name[10:-4].isdecimal()
        )


@dataclass(frozen=True, slots=True)
class Channel:
    """One voltage input, prepared for reading."""

    file: Path
    scale: float
    """Millivolts per count."""
    offset: float
    """Offset, counts."""
    full_scale: int | None
    """Maximum reading, counts; None: unknown."""

    def read(self) -> int:
        """Read the raw value (counts).

        Raises:
            DeviceError: see ``read_text``.
            ProtocolError: the file contains no number.
        """
        return int(_number(self.file))

    def volts(self, raw: int) -> float:
        """Voltage at the pin (V)."""
        return (raw + self.offset) * self.scale / 1000

    def at_limit(self, raw: int) -> bool:
        """Whether a raw reading is 0 or full scale."""
        return raw <= 0 or (self.full_scale is not None and raw >= self.full_scale)


def converters(root: Path = ROOT) -> list[Converter]:
    """All converters known to the kernel."""
    found = []
    for path in sorted(root.glob("iio:device*")):
        try:
            found.append(Converter(path, read_text(path / "name")))
        except DeviceError:
            continue
    return [converter for converter in found if converter.channels()]


def find(root: Path, name: str) -> Converter:
    """Find the converter with that name, or the only one if ``name`` is empty.

    Raises:
        DeviceLostError: no converter found.
        DeviceMismatchError: several converters, and no name is configured.
    """
    known = converters(root)
    fitting = [converter for converter in known if name in ("", converter.name)]
    names = ", ".join(converter.name for converter in known) or "none"
    if not fitting:
        raise DeviceLostError(f"{root}: no converter {name or 'at all'}; found: {names}")
    if len(fitting) > 1:
        raise DeviceMismatchError(f"{root}: expected one converter {name}, found: {names}; select one by its name")
    return fitting[0]


def channel(converter: Converter, number: int, full_scale: int | None = None) -> Channel:
    """Prepare a channel.

    Raises:
        DeviceMismatchError: the converter has no such channel or scale.
        DeviceError: see ``read_text``.
    """
    stem = f"in_voltage{number}"
    file = converter.path / f"{stem}_raw"
    if number not in converter.channels():
        raise DeviceMismatchError(f"{converter.name}: no channel {number}; available: {converter.channels()}")
    scale = _shared(converter.path, stem, "scale")
    if scale is None or scale <= 0:
        raise DeviceMismatchError(
            f"{converter.name}: channel {number} has scale {scale}, expected millivolts per count"
        )
    offset = _shared(converter.path, stem, "offset") or 0.0
    return Channel(file, scale, offset, full_scale or _full_scale(converter.path / "scan_elements" / f"{stem}_type"))


def read_text(file: Path) -> str:
    """Read the contents of a small file.

    Raises:
        DeviceLostError: the file or its device is gone.
        PortBusyError: the converter streams to another process.
        DeviceTimeoutError: the converter does not answer the kernel.
        DeviceError: any other failure.
    """
    try:
        return file.read_text(encoding="ascii", errors="backslashreplace").strip()
    except OSError as error:
        text = f"{file}: {error.strerror}"
        if error.errno in _GONE:
            raise DeviceLostError(text) from error
        if error.errno == errno.EBUSY:
            raise PortBusyError(text) from error
        if error.errno in (errno.EIO, errno.EREMOTEIO, errno.ETIMEDOUT, errno.EAGAIN):
            raise DeviceTimeoutError(text) from error
        raise DeviceError(text) from error


def _number(file: Path) -> float:
    text = read_text(file)
    try:
        return float(text)
    except ValueError:
        raise ProtocolError(f"{file}: expected a number, got {text[:40]!r}") from None


def _shared(folder: Path, stem: str, attribute: str) -> float | None:
    """Return a channel's own attribute, or the one that all voltage channels share."""
    for file in (folder / f"{stem}_{attribute}", folder / f"in_voltage_{attribute}"):
        if file.exists():
            return _number(file)
    return None


def _full_scale(file: Path) -> int | None:
    """Parse the maximum reading from a scan element's type, such as ``le:s12/16>>4``."""
    match = _SCAN_TYPE.match(read_text(file)) if file.exists() else None
    if match is None:
        return None
    bits = int(match[2]) - (match[1] == "s")
    return (1 << bits) - 1
