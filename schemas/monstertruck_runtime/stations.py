"""Sessions of stations: Zenoh configuration, certificates and names of sources.

This module has no heavy imports, so that an emergency stop can be sent before the rest of the program is loaded.
"""

import getpass
import os
import re
import socket
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.endpoints import host_of, port_of
from monstertruck_runtime.errors import NotFoundError, NotPermittedError

TLS_VARIABLE: Final = "MONSTERTRUCKD_TLS"
"""Environment variable with the folder of the station's certificate."""


@dataclass(frozen=True, slots=True)
class ClientTls:
    """Certificate files of a station."""

    ca: Path
    """Certificate of the authority that signed the robot's certificate"""
    certificate: Path
    key: Path

    def owner(self) -> str:
        """Common name of the certificate.

        Raises:
            InputError: the file contains no certificate with a common name.
        """
        from cryptography import x509  # noqa: PLC0415 - only for certificates
        from cryptography.x509.oid import NameOID  # noqa: PLC0415

        from monstertruck_runtime.outside import contents, reading  # noqa: PLC0415
        from monstertruck_runtime.small_files import MEGABYTE  # noqa: PLC0415

        expected = "a certificate with a common name"
        with reading(self.certificate, expected):
            certificate = x509.load_pem_x509_certificate(contents(self.certificate, expected, MEGABYTE))
            return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def station_tls(environment: Mapping[str, str] = os.environ) -> ClientTls:
    """The certificate of this user's station: ``ca.pem``, ``station.pem`` and ``station.key`` of one folder.

    The folder is ``MONSTERTRUCKD_TLS``, else ``monstertruckd/tls`` in the user's configuration.

    Raises:
        NotFoundError: a file is missing.
        NotPermittedError: other users may read the key.
    """
    home = Path(environment.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    folder = Path(environment.get(TLS_VARIABLE) or home / "monstertruckd" / "tls")
    files = ClientTls(ca=folder / "ca.pem", certificate=folder / "station.pem", key=folder / "station.key")
    for file in (files.ca, files.certificate, files.key):
        if not file.is_file():
            raise NotFoundError(f"{file}: not there; tls/... endpoints want it ({TLS_VARIABLE} names another folder)")
    if files.key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise NotPermittedError(f"{files.key}: others may read this key; expected mode 600 (chmod 600 {files.key})")
    return files


def session_config(endpoint: str, timeout: float, tls: ClientTls | None) -> dict[str, Any]:
    """Configuration of a Zenoh session that connects to one endpoint, and neither listens nor discovers.

    Args:
        endpoint: endpoint of the robot.
        timeout: timeout for the link, s.
        tls: certificate files for ``tls/...`` endpoints.
    """
    config: dict[str, Any] = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": round(timeout * 1000), "exit_on_failure": True},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    if tls is not None:
        config["transport"]["link"] = {
            "tls": {
                "root_ca_certificate": str(tls.ca),
                "connect_certificate": str(tls.certificate),
                "connect_private_key": str(tls.key),
                "enable_mtls": True,
            }
        }
    return config


def link_refusal(endpoint: str, ca: Path, tls: ClientTls | None, timeout: float) -> str:
    """Why either side rejects a ``tls/...`` link, which Zenoh does not report; empty if it is accepted.

    Args:
        endpoint: endpoint of the robot.
        ca: certificate of the robot's authority.
        tls: certificate of this station, if any.
        timeout: timeout of each step, s.

    Raises:
        OSError: no process listens there, or the files cannot be used.
    """
    import ssl  # noqa: PLC0415 - only for certificates

    context = ssl.create_default_context(cafile=str(ca))
    if tls is not None:
        context.load_cert_chain(tls.certificate, tls.key)
    try:
        with (
            socket.create_connection((host_of(endpoint), port_of(endpoint) or 0), timeout) as raw,
            context.wrap_socket(raw, server_hostname=host_of(endpoint)) as link,
        ):
            link.recv(1)  # in TLS 1.3 the robot checks the certificate after the handshake
    except TimeoutError:
        return ""
    except ssl.SSLError as error:
        return str(getattr(error, "verify_message", "") or error.reason or error).lower().replace("_", " ")
    return ""


def require_certificates(endpoint: str, tls: ClientTls | None) -> None:
    """Raise an error if the link fails because a certificate is rejected.

    Raises:
        NotPermittedError: a certificate is rejected.
    """
    if tls is None:
        return
    with suppress(OSError):
        # 1.0: timeout of a step of the diagnostic handshake (s)
        if why := link_refusal(endpoint, tls.ca, tls, 1.0):
            text = "its certificate or this station's is refused"
            raise NotPermittedError(f"{endpoint}: {text}: {why} (`monstertruckd security show` lists dates)")


def own_source(owner: str | None = None, program: str = "") -> str:
    """Name of this program in requests: the certificate's owner or the user, with host and process id.

    Args:
        owner: common name of the certificate, never shortened.
        program: distinguishes several programs of one process. A long name is shortened at the end of the host, then at
            the start of the program.
    """
    end = f"{os.getpid()}{'-' * bool(program)}{program}"
    host = _plain(socket.gethostname())
    longest_source = 64  # maximum length of a source's name
    if owner is not None:
        room = longest_source - len(owner) - 1
        return f"{owner}:{host[: max(room - len(end) - 1, 0)]}-{end[-max(room - 1, 0) :]}"[:longest_source]
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        user = str(os.getuid())
    return f"{_plain(user)}@{host}"[: longest_source - len(end) - 1] + f":{end}"


def tls_for(endpoint: str) -> ClientTls | None:
    """Certificate of this user's station, for an endpoint that needs one. Raises the errors of ``station_tls``."""
    return station_tls() if endpoint.startswith("tls/") else None


def _plain(name: str) -> str:
    """Remove characters not allowed in a key."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name)
