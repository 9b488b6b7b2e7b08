"""Read the computer's health from /proc and /sys; the functions block while they read small files.

Source: kernel documentation, proc(5), ABI/testing/sysfs-class-thermal, admin-guide/pm/cpufreq, and
ABI/testing/sysfs-devices-system-cpu for the x86 throttle counters. ``get_throttled`` is the Raspberry Pi firmware's
word: bits 0 to 3 are the current under-voltage, capped, throttled and soft temperature limit states.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from monstertruck_drivers.computer import Disk
from monstertruck_runtime.errors import DeviceError, ProtocolError
from monstertruck_runtime.small_files import number_of, text_of

FIRMWARE_THROTTLED: Final = "sys/devices/platform/soc/soc:firmware/get_throttled"


@dataclass(frozen=True, slots=True)
class Times:
    """Processor time of all cores since boot, in kernel ticks."""

    busy: int
    total: int


@dataclass(frozen=True, slots=True)
class Reading:
    """State of the computer at one instant; None for values that are not available."""

    load: float
    cores: int
    times: Times
    temperature: float | None
    """Temperature of the hottest zone (degrees Celsius)."""
    frequency: float | None
    """Clock of the fastest core (Hz)."""
    frequency_share: float | None
    """Ratio of allowed to maximum clock of the most limited core."""
    throttle_events: int
    """Number of thermal throttle events since the start."""
    firmware_throttled: bool
    memory_total: int
    memory_available: int
    disk: Disk
    daemon_memory: int
    daemon_files: int


def read_host(root: Path, disk: Disk) -> Reading:
    """Read everything once.

    Args:
        root: folder that holds ``proc`` and ``sys``.
        disk: the monitored file system.

    Raises:
        DeviceError: /proc cannot be read.
        ProtocolError: a /proc file that exists on every Linux system differs from proc(5).
    """
    cores, times = parse_stat(_required(root / "proc/stat"))
    total, available = parse_meminfo(_required(root / "proc/meminfo"))
    cpus = root / "sys/devices/system/cpu"
    return Reading(
        load=_load(_required(root / "proc/loadavg")),
        cores=cores,
        times=times,
        temperature=max(_temperatures(root / "sys/class/thermal"), default=None),
        frequency=max(_frequencies(cpus), default=None),
        frequency_share=min(_shares(cpus), default=None),
        throttle_events=sum(number_of(f) or 0 for f in cpus.glob("cpu[0-9]*/thermal_throttle/*_throttle_count")),
        firmware_throttled=_firmware_throttled(root / FIRMWARE_THROTTLED),
        memory_total=total,
        memory_available=available,
        disk=disk,
        daemon_memory=_resident(_required(root / "proc/self/statm")),
        daemon_files=sum(1 for _ in (root / "proc/self/fd").glob("*")),
    )


def parse_stat(text: str) -> tuple[int, Times]:
    """Parse the number of cores and the processor times from /proc/stat; waiting for a disk counts as idle.

    Raises:
        ProtocolError: the line ``cpu`` is missing or too short.
    """
    lines = [line.split() for line in text.splitlines() if line.startswith("cpu")]
    try:
        name, *fields = lines[0]
        # user nice system idle iowait irq softirq steal; guest time is contained in user time
        ticks = [int(field) for field in fields[:8]]
        idle = ticks[3] + (ticks[4] if len(ticks) > 4 else 0)
    except (IndexError, ValueError):
        raise ProtocolError(f"/proc/stat: expected a line of processor times, got {text[:60]!r}") from None
    cores = sum(1 for line in lines if line[0] != name)
    return max(cores, 1), Times(sum(ticks) - idle, sum(ticks))


def parse_meminfo(text: str) -> tuple[int, int]:
    """Parse total and available memory (bytes) from /proc/meminfo.

    Raises:
        ProtocolError: a row is missing.
    """
    rows = {}
    for line in text.splitlines():
        name, _, rest = line.partition(":")
        value, *_ = rest.split() or [""]
        if value.isdecimal():
            rows[name] = int(value) * 1024
    try:
        return rows["MemTotal"], rows["MemAvailable"]
    except KeyError as error:
        raise ProtocolError(f"/proc/meminfo: no row {error}") from None


def busy_share(before: Times, now: Times) -> float | None:
    """Busy fraction of the processor time between two readings; None if no time passed."""
    total = now.total - before.total
    return min(max((now.busy - before.busy) / total, 0.0), 1.0) if total > 0 else None


def _required(file: Path) -> str:
    text = text_of(file)
    if text is None:
        raise DeviceError(f"{file} cannot be read")
    return text


def _load(text: str) -> float:
    try:
        return float(text.split(maxsplit=1)[0])
    except (IndexError, ValueError):
        raise ProtocolError(f"/proc/loadavg: expected three means, got {text[:60]!r}") from None


def _resident(text: str) -> int:
    try:
        return int(text.split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (IndexError, ValueError):
        raise ProtocolError(f"/proc/self/statm: expected seven numbers, got {text[:60]!r}") from None


def _temperatures(folder: Path) -> Iterator[float]:
    low, high = (-40.0, 150.0)  # zones without a sensor report values outside of this
    for file in folder.glob("thermal_zone*/temp"):
        if (milli := number_of(file)) is not None and low < milli / 1000 < high:
            yield milli / 1000


def _frequencies(cpus: Path) -> Iterator[float]:
    for file in cpus.glob("cpu[0-9]*/cpufreq/scaling_cur_freq"):
        if kilohertz := number_of(file):
            yield kilohertz * 1e3


def _shares(cpus: Path) -> Iterator[float]:
    for folder in cpus.glob("cpu[0-9]*/cpufreq"):
        allowed, possible = number_of(folder / "scaling_max_freq"), number_of(folder / "cpuinfo_max_freq")
        if allowed and possible:
            yield min(allowed / possible, 1.0)


def _firmware_throttled(file: Path) -> bool:
    try:
        return bool(int(text_of(file) or "0", 16) & 0xF)  # bits of the current conditions
    except ValueError:
        return False
