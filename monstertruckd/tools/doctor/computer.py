"""Checks of the computer: clock, disk, temperature, memory, network, and access to the daemon."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from monstertruck_drivers.computer import disk_of
from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.host_health.readings import read_host
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.driver import LinkJudge
from monstertruck_drivers.link_quality.interfaces import choose, read_interfaces
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.endpoints import port_of
from monstertruck_runtime.errors import DeviceError, InputError
from monstertruck_runtime.small_files import text_of
from monstertruck_schemas.health import LinkLevel
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.context import Finding, HostContext, fail, fine, warn
from monstertruckd.tools.security.certificates import DAY, common_name, read_certificates, seconds_left

SYNCHRONIZED: Final = Path("/run/systemd/timesync/synchronized")
"""Made by systemd-timesyncd once the clock is synchronized."""
DAEMONS: Final = ("chronyd", "ntpd", "ntpsec")
NETWORKS: Final = Path("/etc/NetworkManager/system-connections")
SUPPLICANT: Final = Path("/etc/wpa_supplicant/wpa_supplicant.conf")
LISTEN: Final = "0A"
"""State of a listening socket in /proc/net/tcp."""


def calendar(context: HostContext) -> Iterator[Finding]:
    """Check that logs will have the right date."""
    clock = context.computer.machine.clock
    keeper = next((name for name in DAEMONS if context.runs(name)), None)
    set_ntp = "sudo timedatectl set-ntp true"
    if clock.now() + clock.real_offset() < 1_704_067_200 * SECOND:  # ns since 1970: a clock before it was never set
        yield fail("clock", Reason.CLOCK_UNSET, "is before 2024", set_ntp)
    elif context.at(SYNCHRONIZED).exists():
        yield fine("clock", "synchronized by systemd-timesyncd")
    elif keeper is not None:
        yield fine("clock", f"set by {keeper}")
    else:
        yield warn("clock", Reason.CLOCK_UNSET, "no time service sets it: logs may carry a wrong date", set_ntp)
    if any((context.computer.root / "sys/class/rtc").glob("rtc*")):
        yield fine("clock chip", "there")
    else:
        seen = "none: after a start without network the clock continues from the last shutdown until NTP sets it"
        yield fine("clock chip", seen)


def condition(context: HostContext) -> Iterator[Finding]:
    """Check disk, temperature and memory, by the limits of the host monitor."""
    config = context.config
    limits = (config.monitors.host if config is not None else None) or HostHealthConfig()
    folder = context.logs()
    try:
        host = read_host(context.computer.root, disk_of(folder))
    except DeviceError as error:
        yield warn("host", error.reason, str(error))
        return
    gigabyte = 1e9
    free = f"{host.disk.free / gigabyte:.1f} GB free for {folder}"
    if host.disk.free < limits.disk:
        yield fail("disk", Reason.DISK_LOW, free, f"du -xh {folder} | sort -h | tail")
    else:
        yield fine("disk", free)
    share = host.memory_available / host.memory_total
    memory = f"{share:.0%} of {host.memory_total / gigabyte:.1f} GB available"
    if share < limits.memory:
        yield warn("memory", Reason.MEMORY_LOW, memory, "ps -eo rss,comm --sort=-rss | head")
    else:
        yield fine("memory", memory)
    heat = "not measured" if host.temperature is None else f"{host.temperature:.0f} degrees"
    slow = host.frequency_share is not None and host.frequency_share < limits.slow
    if host.temperature is not None and host.temperature > limits.hot:
        yield warn("heat", Reason.HOST_HOT, f"{heat}: let it cool, improve its ventilation")
    elif host.firmware_throttled or slow:
        seen = f"{heat}, but the processor is throttled: check temperature and supply voltage"
        yield warn("heat", Reason.HOST_THROTTLED, seen, "grep . /sys/devices/system/cpu/cpu*/cpufreq/scaling_max_freq")
    else:
        yield fine("heat", heat)


def link(context: HostContext) -> Iterator[Finding]:
    """Check the network, chosen and rated as by the link monitor."""
    config = context.config
    wanted = (config.monitors.link if config is not None else None) or LinkQualityConfig()
    chosen = choose(read_interfaces(context.computer.root), wanted.interface)
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


def wireless(context: HostContext) -> Iterator[Finding]:
    """Find networks that the computer joins by itself without a key or with WEP, in readable files only."""
    found: dict[str, str] = {}
    for file in sorted(context.at(NETWORKS).glob("*.nmconnection")):
        text = text_of(file) or ""
        if "[wifi]" in text:
            found[file.stem] = _security(text, "key-mgmt=none", "[wifi-security]")
    text = text_of(context.at(SUPPLICANT)) or ""
    for block in re.findall(r"network=\{(.*?)\}", text, re.DOTALL):
        named = re.search(r'ssid="([^"]*)"', block)
        found[named[1] if named is not None else "network"] = _security(block, "wep_key0", "psk=")
    for name, kind in found.items():
        if kind:
            yield warn("wireless", Reason.LINK_OPEN, f"{name} is {kind}: anyone in range can listen and send; use WPA2")
    if found and not any(found.values()):
        yield fine("wireless", f"{', '.join(found)}: encrypted")


def _security(text: str, weak: str, keyed: str) -> str:
    """Return the fault of a network's protection; empty if there is none."""
    plain = text.replace(" ", "")
    if weak in plain:
        return "WEP"
    return "" if keyed in plain or "key_mgmt=WPA" in plain or "key_mgmt=SAE" in plain else "open"


def card(context: HostContext) -> Iterator[Finding]:
    """Check the wear of eMMC storage, if reported (JEDEC: tenths of its life; 2 and 3: end of life near)."""
    for folder in sorted((context.computer.root / "sys/block").glob("mmcblk*")):
        life = (text_of(folder / "device/life_time") or "").split()
        end = text_of(folder / "device/pre_eol_info") or ""
        try:
            tenths = max((int(word, 16) for word in life), default=0)
            worn = int(end.strip() or "0", 16)
        except ValueError:
            continue
        if not tenths:
            continue
        seen = f"{folder.name}: {10 * (tenths - 1)} to {10 * tenths} % of its life is used"
        if tenths >= 8 or worn > 1:  # wear before a card should be replaced, tenths of its life
            yield warn("card", Reason.RECORDING_FAILED, f"{seen}: copy it to a new card")
        else:
            yield fine("card", seen)


def access(context: HostContext) -> Iterator[Finding]:
    """Check endpoints, certificates, admitted sources, and other processes on a port."""
    if context.config is None:
        return
    zenoh = context.config.zenoh
    if zenoh.open_endpoints:
        seen = (
            f"{', '.join(zenoh.open_endpoints)}: anyone on the network may drive the robot; use tls/... with zenoh.tls"
        )
        yield fail("access", Reason.LINK_OPEN, seen)
    elif zenoh.certified_endpoints:
        yield fine("access", f"{', '.join(zenoh.certified_endpoints)}, by certificate")
    else:
        yield fine("access", "from this computer only")
    if zenoh.tls is not None:
        names = ", ".join(f"{name} ({grant.role})" for name, grant in zenoh.tls.grants().items())
        seen = (
            f"{names}; Zenoh silently drops requests under names that the certificate lacks; "
            "`monstertruckd security check` tests the rights of each role"
        )
        yield fine("names", seen)
        for file in dict.fromkeys((zenoh.tls.ca, zenoh.tls.pilots_ca, zenoh.tls.certificate, zenoh.tls.key)):
            if file is not None:
                yield from _file(context, file, private=file == zenoh.tls.key)
    for endpoint in (*zenoh.listen, *zenoh.listen_pilots) if context.daemon() is None else ():
        port = port_of(endpoint)
        if port in _listening(context):
            yield fail("port", Reason.BUSY, f"{endpoint} is taken", f"sudo ss -ltnp 'sport = :{port}'")


def _file(context: HostContext, file: Path, *, private: bool) -> Iterator[Finding]:
    place = context.at(file) if file.is_absolute() else file
    try:
        status = place.stat()
    except FileNotFoundError:
        yield fail("tls", Reason.NOT_FOUND, f"{file}: no such file", context.command("security", "show"))
        return
    except PermissionError:
        yield _not_checked(context, file)
        return
    if context.account is not None and not context.account.may_read(place):
        fix = f"sudo chown {context.account.name} {file}"
        yield fail("tls", Reason.NOT_PERMITTED, f"{context.account.name} may not read {file}", fix)
    elif private and status.st_mode & 0o077:
        yield warn("tls", Reason.LINK_OPEN, f"{file}: other users may read the private key", f"sudo chmod 600 {file}")
    if not private:
        yield _expiry(context, file, place) if os.access(place, os.R_OK) else _not_checked(context, file)


def _expiry(context: HostContext, file: Path, place: Path) -> Finding:
    """Check the certificate of a file, or the admitted station's certificate that expires first."""
    clock = context.computer.machine.clock
    now = (clock.now() + clock.real_offset()) // SECOND
    show = context.command("security", "show")
    try:
        days, name = min((seconds_left(one, now) // DAY, common_name(one)) for one in read_certificates(place))
    except InputError:
        return fail("certificate", Reason.BAD_INPUT, f"{file}: expected certificates", show)
    if days < 0:
        return fail(
            "certificate", Reason.NOT_PERMITTED, f"{file}: certificate of {name} expired {-days} days ago", show
        )
    if days < 30:  # days
        return warn("certificate", Reason.NOT_PERMITTED, f"{file}: certificate of {name} expires in {days} days", show)
    return fine("certificate", f"{file}: valid for {days} days")


def _not_checked(context: HostContext, file: Path) -> Finding:
    seen = f"{file}: not checked, because this user may not read it"
    return warn("tls", Reason.NOT_PERMITTED, seen, context.command("doctor", sudo=True))


def _listening(context: HostContext) -> set[int]:
    """Return the local TCP ports with a listening process."""
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in (text_of(context.system / "proc/net" / name) or "").splitlines()[1:]
    ]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if len(row) > 3 and row[3] == LISTEN}
