"""Python, packages, and the configuration."""

import platform
import re
import sys
from collections.abc import Iterator
from importlib import metadata

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient

MACHINES = ("x86_64", "aarch64")
NEEDED = "robot"
"""Extra without which no device can be used."""


def python(patient: Patient, machine: str = platform.machine()) -> Iterator[Finding]:
    """The interpreter and the processor."""
    version = ".".join(map(str, sys.version_info[:3]))
    seen = f"{version} on {machine}, {patient.program.python}"
    if machine in MACHINES:
        yield fine("python", seen)
    else:
        text = f"{seen}: numpy, scipy and numba come ready-made for {' and '.join(MACHINES)} only"
        yield warn("python", Reason.NOT_SUPPORTED, text, "uname -m")


def packages(patient: Patient, requirements: list[str] | None = None) -> Iterator[Finding]:
    """Packages of every extra; those a robot needs must be there."""
    if requirements is None:
        requirements = metadata.requires("monstertruckd") or []
    missing = _missing(patient, requirements)
    if lacking := [*missing.pop("", []), *missing.pop(NEEDED, [])]:
        seen = f"missing: {', '.join(lacking)}"
        yield fail("packages", Reason.NOT_INSTALLED, seen, _install_command(patient))
    else:
        yield fine("packages", f"all for a {NEEDED}")
    whole = sorted(extra for extra, names in missing.items() if not names)
    rest = [f"{extra} ({', '.join(names)})" for extra, names in sorted(missing.items()) if names]
    seen = f"installed: {', '.join(whole) or 'none'}"
    yield fine("extras", f"{seen}; incomplete: {'; '.join(rest)}" if rest else seen)


def configuration(patient: Patient) -> Iterator[Finding]:
    """Whether there is one, and it is accepted."""
    file = patient.config_file
    if file is None:
        seen = "none named and none installed: devices were not looked at"
        yield warn("config", Reason.NOT_FOUND, seen, patient.command("doctor", "--config", "FILE"))
    elif patient.complaint is not None:
        yield fail("config", Reason.BAD_CONFIG, patient.complaint, patient.command("config", "show", str(file)))
    else:
        yield fine("config", str(file))


def _missing(patient: Patient, requirements: list[str]) -> dict[str, list[str]]:
    """Absent distributions by extra; "" = needed always."""
    missing: dict[str, list[str]] = {}
    for requirement in requirements:
        name = re.match(r"[\w.-]+", requirement)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", requirement)
        if name is None or name[0] == "monstertruckd":
            continue
        absent = missing.setdefault(extra[1] if extra is not None else "", [])
        if patient.versions(name[0]) is None:
            absent.append(name[0])
    return missing


def _install_command(patient: Patient) -> str:
    checkout = patient.program.neutral.parents[1]
    if (checkout / "pyproject.toml").is_file():
        return f"cd {checkout} && python3 -m monstertruckd.bootstrap sync"
    return f"{patient.program.python} -m pip install 'monstertruckd[{NEEDED}]'"
