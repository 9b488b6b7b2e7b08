"""Clock, disk, heat, memory and network of the computer."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.host_health.readings import disk_of, read_host
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.driver import LinkJudge
from monstertruck_drivers.link_quality.interfaces import choose, read_interfaces
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceError
from monstertruck_schemas.health import LinkLevel
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient

SYNCHRONIZED: Final = Path("/run/systemd/timesync/synchronized")
"""Made by systemd-timesyncd once it has the time."""
DAEMONS: Final = ("chronyd", "ntpd", "ntpsec")
YEAR_2024: Final = 1_704_067_200 * SECOND
"""Nanoseconds since 1970: before it, nobody can have set the clock."""
GIGABYTE: Final = 1e9


def calendar(patient: Patient) -> Iterator[Finding]:
    """Whether logs will carry the right date."""
    clock = patient.computer.machine.clock
    keeper = next((name for name in DAEMONS if patient.runs(name)), None)
    set_ntp = "sudo timedatectl set-ntp true"
    if clock.now() + clock.real_offset() < YEAR_2024:
        yield fail("clock", Reason.CLOCK_UNSET, "stands before 2024", set_ntp)
    elif patient.at(SYNCHRONIZED).exists():
        yield fine("clock", "synchronized by systemd-timesyncd")
    elif keeper is not None:
        yield fine("clock", f"kept by {keeper}")
    else:
        yield warn("clock", Reason.CLOCK_UNSET, "nothing synchronizes it: logs may carry a wrong date", set_ntp)
    if any((patient.computer.root / "sys/class/rtc").glob("rtc*")):
        yield fine("clock chip", "there")
    else:
        seen = "none: after a start without network the date is that of the last shutdown, until NTP steps it"
        yield fine("clock chip", seen)


def condition(patient: Patient) -> Iterator[Finding]:
    """Disk, heat and memory, by the limits of the host monitor."""
    config = patient.config
    limits = (config.monitors.host if config is not None else None) or HostHealthConfig()
    folder = patient.logs()
    try:
        host = read_host(patient.computer.root, disk_of(folder))
    except DeviceError as error:
        yield warn("host", error.reason, str(error))
        return
    free = f"{host.disk.free / GIGABYTE:.1f} GB free for {folder}"
    if host.disk.free < limits.disk:
        yield fail("disk", Reason.DISK_LOW, free, f"du -xh {folder} | sort -h | tail")
    else:
        yield fine("disk", free)
    share = host.memory_available / host.memory_total
    memory = f"{share:.0%} of {host.memory_total / GIGABYTE:.1f} GB available"
    if share < limits.memory:
        yield warn("memory", Reason.MEMORY_LOW, memory, "ps -eo rss,comm --sort=-rss | head")
    else:
        yield fine("memory", memory)
    heat = "not told" if host.temperature is None else f"{host.temperature:.0f} degrees"
    slow = host.frequency_share is not None and host.frequency_share < limits.slow
    if host.temperature is not None and host.temperature > limits.hot:
        yield warn("heat", Reason.HOST_HOT, heat)
    elif host.firmware_throttled or slow:
        seen = f"{heat}, but the processor is held back: heat or supply"
        yield warn("heat", Reason.HOST_THROTTLED, seen, "grep . /sys/devices/system/cpu/cpu*/cpufreq/scaling_max_freq")
    else:
        yield fine("heat", heat)


def link(patient: Patient) -> Iterator[Finding]:
    """The network, as the link monitor would choose and judge it."""
    config = patient.config
    wanted = (config.monitors.link if config is not None else None) or LinkQualityConfig()
    chosen = choose(read_interfaces(patient.computer.root), wanted.interface)
    level = LinkJudge(wanted).update(0, chosen)
    seen = level.value if chosen is None else f"{chosen.name} ({chosen.medium.value}): {level.value}"
    if chosen is not None and chosen.signal is not None and chosen.signal.level is not None:
        seen += f", {chosen.signal.level:.0f} dBm"
    if level is LinkLevel.DOWN:
        yield warn("link", Reason.LINK_DOWN, seen, "ip -brief link")
    elif level in (LinkLevel.POOR, LinkLevel.UNUSABLE):
        yield warn("link", Reason.LINK_WEAK, seen, "iw dev | grep -A9 Interface")
    else:
        yield fine("link", seen)
