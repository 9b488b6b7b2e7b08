"""Checks of Python, packages, configuration, the installed service and its rights."""

import platform
import sys
from collections.abc import AsyncIterator, Iterator, Sequence
from importlib import metadata
from pathlib import Path

from monstertruck_estimation.consistency.config import SCAN_LIBRARIES
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.extras import DISTRIBUTION, Requirement, pip_command
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import COMPASS, SCAN
from monstertruckd.tools.doctor.context import Finding, HostContext, fail, fine, warn
from monstertruckd.tools.install.apply import Change, install
from monstertruckd.tools.install.plan import RULES, SERVICE, UNIT, USER, plan

MACHINES = ("x86_64", "aarch64")
OURS = ("bench", "dev", "docs")
"""Extras for work on the project itself: dozens of packages that no robot and no station lacks."""
NEEDED = "robot"
"""Extra that every device requires."""


def python(context: HostContext, machine: str = platform.machine()) -> Iterator[Finding]:
    """Check the interpreter and the processor."""
    version = ".".join(map(str, sys.version_info[:3]))
    seen = f"{version} on {machine}, {context.program.python}"
    if machine in MACHINES:
        yield fine("python", seen)
    else:
        text = f"{seen}: wheels of numpy, scipy and numba exist for {' and '.join(MACHINES)} only"
        yield warn("python", Reason.NOT_SUPPORTED, text, "uname -m")


def packages(context: HostContext, requirements: list[str] | None = None) -> Iterator[Finding]:
    """Check the packages of every extra; those that a robot needs must be installed."""
    if requirements is None:
        requirements = metadata.requires(DISTRIBUTION) or []
    missing = _missing(context, requirements)
    if lacking := [*missing.pop("", []), *missing.pop(NEEDED, [])]:
        seen = f"missing: {', '.join(row.name for row in lacking)}"
        yield fail("packages", Reason.NOT_INSTALLED, seen, _install_command(context, lacking))
    else:
        yield fine("packages", f"all for a {NEEDED}")
    whole = sorted(extra for extra, rows in missing.items() if not rows)
    rest = [
        f"{extra} ({', '.join(row.name for row in rows)})"
        for extra, rows in sorted(missing.items())
        if rows and extra not in OURS
    ]
    ours = sorted(extra for extra in OURS if missing.get(extra))
    seen = f"installed: {', '.join(extra for extra in whole if extra not in OURS) or 'none'}"
    seen += f"; incomplete: {'; '.join(rest)}" if rest else ""
    yield fine("extras", f"{seen}; incomplete, needed for development only: {', '.join(ours)}" if ours else seen)


def configuration(context: HostContext) -> Iterator[Finding]:
    """Check that a valid configuration exists."""
    file = context.config_file
    if file is None:
        seen = "no configuration given or installed: devices were not checked"
        yield warn("config", Reason.NOT_FOUND, seen, context.command("doctor", "--config", "FILE"))
    elif context.refusal is not None:
        yield fail("config", Reason.BAD_CONFIG, context.refusal, context.command("config", "show", str(file)))
    else:
        yield fine("config", str(file))
    if context.config is not None and (weaker := context.config.weakened()):
        show = context.command("config", "show", str(file))
        yield warn("safety", Reason.WEAKENED, "; ".join(weaker), show)


def motion(context: HostContext) -> Iterator[Finding]:
    """List the independent measures of the robot's motion, and the missing ones that could reveal a wrong one."""
    config = context.config
    if config is None or config.missing_actuators() is not None:
        return
    devices, compared = config.devices, config.consistency
    scans = None if devices.lidar is None or compared is None else compared.scans
    ways = [name for name, there in (("scans", scans), ("free wheels", devices.encoders)) if there is not None]
    turns = [name for name, there in (("compass", devices.compass), ("gyroscope", devices.imu)) if there is not None]
    if compared is None or not (ways or turns):
        seen = "only the wheels measure the motion: speed limits are halved; add a lidar, a compass or an IMU"
        yield warn("motion", Reason.UNWITNESSED, seen)
        return
    seen = f"measured by wheels, {', '.join((*ways, *turns))}"
    if not ways:
        seen += (
            "; distance is measured by the wheels only: a lidar or encoders of free wheels would detect "
            "wrong wheel counts"
        )
    elif not turns:
        seen += "; if two sensors disagree, the faulty one cannot be identified: add a compass or an IMU"
    yield fine("motion", seen)
    if scans == "kiss" and context.versions("kiss-icp") is None:
        text = "kiss-icp is not installed: this repository's own scan odometry measures the motion"
        kiss = [Requirement.parse("kiss-icp")]
        yield warn("scan odometry", Reason.NOT_INSTALLED, text, _install_command(context, kiss))
    missing = [name for name in SCAN_LIBRARIES if context.versions(name) is None]
    if scans is not None and missing:
        text = f"{', '.join(missing)} not installed: the motion is not measured by scans"
        lacking = [Requirement.parse(name) for name in missing]
        yield warn("scan odometry", Reason.NOT_INSTALLED, text, _install_command(context, lacking))


def contact(context: HostContext) -> Iterator[Finding]:
    """List the measures that reveal a contact, or the force and speed of a push without one."""
    config = context.config
    if config is None or config.missing_actuators() is not None:
        return
    devices, compared = config.devices, config.consistency
    scans = devices.lidar is not None and compared is not None and compared.scans is not None
    current = all(device.kind.current for device in devices.shafts().values())
    measures = (("motor current", current), ("free wheels", devices.encoders is not None), ("scans", scans))
    shown = [name for name, there in measures if there and config.gate.contact is not None]
    if shown:
        yield fine("contact", f"shown by {', '.join(shown)}")
        return
    seen = (
        "no sensor shows wheels slipping at an obstacle: the robot hits it at up to "
        f"{config.gate.speed:g} m/s and pushes with up to {config.geometry.pull:g} N; add free wheels or "
        "a lidar"
    )
    yield warn("contact", Reason.CONTACT, seen)


def sensors(context: HostContext) -> Iterator[Finding]:
    """Find sensors that the gate requires but the configuration lacks: the robot could never be armed."""
    config = context.config
    if config is None or config.missing_actuators() is not None:
        return
    gate, devices = config.gate, config.devices
    if gate.attitude is not None and gate.attitude.critical and not devices.measures(COMPASS):
        seen = "no device measures the attitude, so the robot cannot be armed; without a compass: gate.attitude: null"
        yield fail("attitude", Reason.ATTITUDE_STALE, seen)
    if gate.scan.critical and not devices.measures(SCAN):
        seen = "no lidar, so the robot cannot be armed; to drive without one: gate.scan.critical: false"
        yield fail("scan", Reason.SCAN_STALE, seen)


def _missing(context: HostContext, requirements: list[str]) -> dict[str, list[Requirement]]:
    """Return missing distributions by extra; "": always required."""
    missing: dict[str, list[Requirement]] = {}
    for row in map(Requirement.parse, requirements):
        if row.name == DISTRIBUTION:
            continue
        absent = missing.setdefault(row.extra, [])
        if context.versions(row.name) is None:
            absent.append(row)
    return missing


def _install_command(context: HostContext, lacking: Sequence[Requirement]) -> str:
    folder = context.program.neutral.parents[1]
    if (folder / "pyproject.toml").is_file():
        return f"cd {folder} && python3 -m monstertruckd.bootstrap sync"
    return pip_command(str(context.program.python), lacking)


async def service(context: HostContext) -> AsyncIterator[Finding]:
    """Check that the service is installed, up to date and running."""
    if not context.at(UNIT).is_file():
        seen = "not installed: the daemon is not started at boot, and the robot is not stopped when it dies"
        yield warn("service", Reason.NOT_INSTALLED, seen, context.install_command())
        return
    if stale := _stale(context):
        seen = f"installed, but differs from a new installation: {', '.join(path.name for path in stale)}"
        yield warn("service", Reason.NOT_INSTALLED, seen, context.install_command())
    else:
        yield fine("service", f"installed, {UNIT}")
    state = await _state(context)
    restarts = state.get("NRestarts", "0")
    journal = f"journalctl -u {SERVICE} -e"
    if state.get("ActiveState") == "failed":
        yield fail("service runs", Reason.SERVICE_FAILED, f"failed, {restarts} restarts", journal)
    elif restarts != "0":
        yield warn("service runs", Reason.SERVICE_FAILED, f"{state.get('ActiveState')}, {restarts} restarts", journal)
    elif state:
        yield fine("service runs", state.get("ActiveState", "unknown"))


def rules(context: HostContext) -> Iterator[Finding]:
    """Check the udev rules, and ModemManager, which sends AT commands to serial ports that no rule excludes."""
    installed = context.at(RULES).is_file()
    if not installed:
        seen = f"{RULES} is missing: no /dev/truck, no low latency, no rights"
        yield warn("udev rules", Reason.NOT_INSTALLED, seen, context.install_command())
    elif RULES in _stale(context):
        yield warn("udev rules", Reason.NOT_INSTALLED, f"{RULES} is older than the config", context.install_command())
    else:
        yield fine("udev rules", f"{RULES}")
    if not context.runs("ModemManager"):
        yield fine("ModemManager", "does not run")
    elif installed:
        yield fine("ModemManager", "runs, but ignores the robot's ports")
    else:
        seen = "runs, and sends modem commands to serial ports"
        yield warn("ModemManager", Reason.NOT_INSTALLED, seen, context.install_command())


def rights(context: HostContext) -> Iterator[Finding]:
    """Check the rights of the daemon's user: groups, device nodes, the folder of the logs."""
    account = context.account
    if account is None:
        seen = "the service's user does not exist"
        yield fail("user", Reason.NOT_PERMITTED, seen, context.install_command())
        return
    devices = context.config.devices.present() if context.config is not None else {}
    buses = ["i2c"] if any(device.kind.opens == "i2c" for device in devices.values()) else []
    lacking = [group for group in ("dialout", *buses, "video") if account.uid and group not in account.groups]
    usermod = f"sudo usermod -aG {','.join(lacking)} {account.name}"
    if lacking:
        seen = f"{account.name} is not in {' and '.join(lacking)} (takes effect at the next login)"
        yield fail("user", Reason.NOT_PERMITTED, seen, usermod)
    else:
        yield fine("user", f"{account.name}, groups {', '.join(account.groups) or 'all as root'}")
    for role, device in devices.items():
        node = context.node(device.port, camera=device.kind.opens == "video")
        if node is not None and node.exists() and not account.may_use(node):
            group = "i2c" if device.kind.opens == "i2c" else "dialout"
            fix = usermod if lacking else f"sudo chgrp {group} {node} && sudo chmod g+rw {node}"
            yield fail(f"{role} rights", Reason.NOT_PERMITTED, f"{account.name} may not use {node}", fix)
    if context.config is not None and context.config.recorder is not None:
        folder = _existing(context.logs())
        if account.may_use(folder):
            yield fine("logs", f"{context.logs()}")
        else:
            fix = f"sudo chown {account.name} {folder}"
            yield fail("logs", Reason.RECORDING_FAILED, f"{account.name} may not write into {folder}", fix)


def _stale(context: HostContext) -> list[Path]:
    """Return installed files that differ from a new installation's; none without a valid configuration."""
    user = context.account.name if context.account is not None else USER
    try:
        planned = plan(context.config_file, user, context.program, context.system)
    except TruckError:
        return []
    changes = install(planned, context.system, dry=True).changes
    return [path for path, change in changes.items() if change is not Change.SAME]


async def _state(context: HostContext) -> dict[str, str]:
    """Return the state of the service according to systemd; empty without systemd."""
    try:
        code, said = await context.computer.machine.run(["systemctl", "show", "-p", "ActiveState,NRestarts", SERVICE])
    except OSError:
        return {}
    return dict(line.split("=", 1) for line in said.splitlines() if "=" in line) if code == 0 else {}


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder
