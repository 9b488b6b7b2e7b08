"""The service, its files, its rights, and who might get in its way."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path

from monstertruck_runtime.errors import TruckError
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient
from monstertruckd.tools.install.apply import Change, install
from monstertruckd.tools.install.plan import RULES, SERVICE, UNIT, USER, plan


async def service(patient: Patient) -> AsyncIterator[Finding]:
    """Whether it is installed, up to date and healthy."""
    if not patient.at(UNIT).is_file():
        seen = "not installed: nothing starts the daemon, and nothing stops the truck when it dies"
        yield warn("service", Reason.NOT_INSTALLED, seen, patient.install_command())
        return
    if stale := _stale(patient):
        seen = f"installed, but other than it would be now: {', '.join(path.name for path in stale)}"
        yield warn("service", Reason.NOT_INSTALLED, seen, patient.install_command())
    else:
        yield fine("service", f"installed, {UNIT}")
    state = await _state(patient)
    restarts = state.get("NRestarts", "0")
    journal = f"journalctl -u {SERVICE} -e"
    if state.get("ActiveState") == "failed":
        yield fail("service runs", Reason.SERVICE_FAILED, f"failed, {restarts} restarts", journal)
    elif restarts != "0":
        yield warn("service runs", Reason.SERVICE_FAILED, f"{state.get('ActiveState')}, {restarts} restarts", journal)
    elif state:
        yield fine("service runs", state.get("ActiveState", "unknown"))


def rules(patient: Patient) -> Iterator[Finding]:
    """The udev rules, and ModemManager, which sends AT commands to whatever it is not told to leave alone."""
    installed = patient.at(RULES).is_file()
    if not installed:
        seen = f"{RULES} is missing: no /dev/truck, no low latency, no rights"
        yield warn("udev rules", Reason.NOT_INSTALLED, seen, patient.install_command())
    elif RULES in _stale(patient):
        yield warn("udev rules", Reason.NOT_INSTALLED, f"{RULES} is older than the config", patient.install_command())
    else:
        yield fine("udev rules", f"{RULES}")
    if not patient.runs("ModemManager"):
        yield fine("ModemManager", "does not run")
    elif installed:
        yield fine("ModemManager", "runs, and is told to keep off")
    else:
        seen = "runs, and talks to serial ports it takes for modems"
        yield warn("ModemManager", Reason.NOT_INSTALLED, seen, patient.install_command())


def rights(patient: Patient) -> Iterator[Finding]:
    """What the daemon's user may do: groups, device nodes, the folder of the logs."""
    account = patient.account
    if account is None:
        seen = "the service's user does not exist"
        yield fail("user", Reason.NOT_PERMITTED, seen, patient.install_command())
        return
    lacking = [group for group in ("dialout", "video") if account.uid and group not in account.groups]
    usermod = f"sudo usermod -aG {','.join(lacking)} {account.name}"
    if lacking:
        seen = f"{account.name} is not in {' and '.join(lacking)} (counts after the next login)"
        yield fail("user", Reason.NOT_PERMITTED, seen, usermod)
    else:
        yield fine("user", f"{account.name}, groups {', '.join(account.groups) or 'all as root'}")
    for role, device in patient.config.devices.present().items() if patient.config is not None else ():
        node = patient.node(device.port, camera=device.kind.opens == "video")
        if node is not None and node.exists() and not account.may_use(node):
            mend = usermod if lacking else f"sudo chgrp dialout {node} && sudo chmod g+rw {node}"
            yield fail(f"{role} rights", Reason.NOT_PERMITTED, f"{account.name} may not use {node}", mend)
    if patient.config is not None and patient.config.recorder is not None:
        folder = _existing(patient.logs())
        if account.may_use(folder):
            yield fine("logs", f"{patient.logs()}")
        else:
            mend = f"sudo chown {account.name} {folder}"
            yield fail("logs", Reason.RECORDING_FAILED, f"{account.name} may not write into {folder}", mend)


def _stale(patient: Patient) -> list[Path]:
    """Installed files that differ from what would be installed now; none without a usable configuration."""
    user = patient.account.name if patient.account is not None else USER
    try:
        planned = plan(patient.config_file, user, patient.program, patient.system)
    except TruckError:
        return []
    changes = install(planned, patient.system, dry=True).changes
    return [path for path, change in changes.items() if change is not Change.SAME]


async def _state(patient: Patient) -> dict[str, str]:
    """What systemd says of the service; empty where there is no systemd."""
    try:
        code, said = await patient.computer.machine.run(["systemctl", "show", "-p", "ActiveState,NRestarts", SERVICE])
    except OSError:
        return {}
    return dict(line.split("=", 1) for line in said.splitlines() if "=" in line) if code == 0 else {}


def _existing(folder: Path) -> Path:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder
