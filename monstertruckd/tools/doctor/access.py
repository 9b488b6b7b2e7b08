"""Who may reach the daemon over the network."""

from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Final

from monstertruck_runtime.small_files import text_of
from monstertruck_schemas.reasons import Reason
from monstertruckd.bus.zenoh_config import TlsConfig
from monstertruckd.tools.doctor.finding import Finding, fail, fine, warn
from monstertruckd.tools.doctor.patient import Patient

MONTH: Final = 30 * 24 * 3600
LOOPBACK: Final = ("127.", "localhost", "[::1]")
LISTEN: Final = "0A"
"""State of a listening socket in /proc/net/tcp."""


async def access(patient: Patient) -> AsyncIterator[Finding]:
    """Endpoints, certificates, and whether somebody else has the port."""
    if patient.config is None:
        return
    zenoh = patient.config.zenoh
    outside = [endpoint for endpoint in zenoh.listen if not _address(endpoint).startswith(LOOPBACK)]
    opened = [endpoint for endpoint in outside if not endpoint.startswith("tls/")]
    if opened:
        seen = f"zenoh.listen {', '.join(opened)}: whoever reaches it may drive the truck; use tls/... with zenoh.tls"
        yield fail("access", Reason.LINK_OPEN, seen)
    elif outside:
        yield fine("access", f"{', '.join(outside)}, by certificate")
    else:
        yield fine("access", "from this computer only")
    if zenoh.tls is not None:
        for finding in _files(patient, zenoh.tls):
            yield finding
        async for finding in _expiry(patient, zenoh.tls.certificate):
            yield finding
    for endpoint in zenoh.listen if patient.daemon() is None else ():
        port = _address(endpoint).rpartition(":")[2]
        if port.isdigit() and int(port) in _listening(patient):
            yield fail("port", Reason.BUSY, f"{endpoint} is taken", f"sudo ss -ltnp 'sport = :{port}'")


def _address(endpoint: str) -> str:
    return endpoint.partition("/")[2]


def _files(patient: Patient, tls: TlsConfig) -> Iterator[Finding]:
    for file in (tls.ca, tls.certificate, tls.key):
        place = patient.at(file) if file.is_absolute() else file
        if not place.is_file():
            yield fail("tls", Reason.NOT_FOUND, f"{file}: no such file")
        elif patient.account is not None and not patient.account.may_read(place):
            mend = f"sudo chown {patient.account.name} {file}"
            yield fail("tls", Reason.NOT_PERMITTED, f"{patient.account.name} may not read {file}", mend)
        elif file == tls.key and place.stat().st_mode & 0o077:
            yield warn("tls", Reason.LINK_OPEN, f"{file}: others may read the private key", f"sudo chmod 600 {file}")


async def _expiry(patient: Patient, certificate: Path) -> AsyncIterator[Finding]:
    file = patient.at(certificate) if certificate.is_absolute() else certificate
    try:
        code, _ = await patient.computer.machine.run(
            ["openssl", "x509", "-noout", "-checkend", str(MONTH), "-in", str(file)]
        )
    except OSError:  # no openssl here
        return
    if code == 0:
        yield fine("certificate", "good for a month at least")
    elif file.is_file():
        mend = f"openssl x509 -noout -dates -in {certificate}"
        yield warn("certificate", Reason.LINK_OPEN, f"{certificate} runs out within a month, or is none", mend)


def _listening(patient: Patient) -> set[int]:
    """Local TCP ports on which somebody listens."""
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in (text_of(patient.system / "proc/net" / name) or "").splitlines()[1:]
    ]
    return {int(row[1].rpartition(":")[2], 16) for row in rows if len(row) > 3 and row[3] == LISTEN}
