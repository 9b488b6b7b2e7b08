"""Read network interfaces from /sys/class/net and /proc/net/wireless; the functions block while they read small files.

Source: kernel documentation, ABI/testing/sysfs-class-net, and the output of the kernel's wireless extensions.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_runtime.small_files import number_of, text_of
from monstertruck_schemas.health import LinkMedium

ERROR_COUNTERS: Final = ("rx_errors", "tx_errors", "rx_dropped", "tx_dropped")


@dataclass(frozen=True, slots=True)
class Signal:
    """One row of /proc/net/wireless."""

    level: float | None
    """Signal level (dBm); None: not connected."""
    noise: float | None
    """Noise level (dBm); None: unknown."""


@dataclass(frozen=True, slots=True)
class Sample:
    """State of an interface at one instant."""

    name: str
    medium: LinkMedium
    connected: bool
    signal: Signal | None
    """None for a cable, and if the kernel lacks the wireless-extensions compatibility."""
    bit_rate: float | None
    """Bit rate (bit/s)."""
    received: int
    """Bytes received since the interface came up."""
    sent: int
    errors: int


def parse_wireless(text: str) -> dict[str, Signal]:
    """Parse the rows by interface, skipping header and damaged lines."""
    rows = {}
    for line in text.splitlines():
        name, colon, rest = line.partition(":")
        fields = rest.split()
        try:
            # status, link quality, level, noise: a dot behind a number means "new since the last look"
            level, noise = (int(field.rstrip(".")) for field in fields[2:4])
        except ValueError:
            continue
        if colon:
            rows[name.strip()] = Signal(_dbm(level), _dbm(noise))
    return rows


def _dbm(value: int) -> float | None:
    """Decode a level (dBm). Some drivers print the byte without its sign; 0 and -256 mean that there is no value."""
    if value in (0, -256):
        return None
    return float(value - 256 if value > 63 else value)


def read_interfaces(root: Path) -> list[Sample]:
    """Read all Wi-Fi and wired interfaces, excluding bridges and other virtual interfaces.

    Args:
        root: folder that holds ``proc`` and ``sys``.
    """
    signals = parse_wireless(text_of(root / "proc/net/wireless") or "")
    folders = sorted((root / "sys/class/net").glob("*"))
    return [sample for folder in folders if (sample := _read(folder, signals)) is not None]


def choose(samples: list[Sample], name: str | None) -> Sample | None:
    """Return the named interface; without a name, the interface that the truck most likely uses.

    Connected interfaces are preferred to unconnected ones, then Wi-Fi to cable, because only Wi-Fi can become weak.
    """
    if name is not None:
        return next((sample for sample in samples if sample.name == name), None)
    return min(samples, key=lambda sample: (not sample.connected, sample.medium is not LinkMedium.WIFI), default=None)


def _read(folder: Path, signals: dict[str, Signal]) -> Sample | None:
    name = folder.name
    wifi = name in signals or (folder / "wireless").exists() or (folder / "phy80211").exists()
    physical = wifi or (folder / "device").exists()
    if not physical or number_of(folder / "type") != 1:  # ``type`` of Ethernet and Wi-Fi
        return None
    signal = signals.get(name) if wifi else None
    connected = text_of(folder / "operstate") in ("up", "unknown") and number_of(folder / "carrier") == 1
    speed = number_of(folder / "speed")
    statistics = folder / "statistics"
    return Sample(
        name=name,
        medium=LinkMedium.WIFI if wifi else LinkMedium.ETHERNET,
        connected=connected,
        signal=signal,
        bit_rate=speed * 1e6 if speed is not None and speed > 0 else None,
        received=number_of(statistics / "rx_bytes") or 0,
        sent=number_of(statistics / "tx_bytes") or 0,
        errors=sum(number_of(statistics / counter) or 0 for counter in ERROR_COUNTERS),
    )
