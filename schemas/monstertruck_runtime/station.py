"""How a station reaches a robot: its Zenoh session, and for ``tls/...`` endpoints its certificate."""

import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.errors import NotFoundError, NotPermittedError
from monstertruck_schemas.base import Schema

VARIABLE: Final = "MONSTERTRUCKD_TLS"
"""Names the folder of the station's certificate."""


class ClientTls(Schema):
    """Files of a station with its own certificate."""

    ca: Path
    """Certificate of the authority that signed the robot's."""
    certificate: Path
    key: Path


def station_tls(environment: Mapping[str, str] = os.environ) -> ClientTls:
    """The certificate of this user's station: ``ca.pem``, ``station.pem`` and ``station.key`` of one folder.

    The folder is that of ``MONSTERTRUCKD_TLS``, else ``monstertruckd/tls`` in the user's configuration.

    Raises:
        NotFoundError: a file is missing.
        NotPermittedError: others may read the key.
    """
    home = Path(environment.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    folder = Path(environment.get(VARIABLE) or home / "monstertruckd" / "tls")
    files = ClientTls(ca=folder / "ca.pem", certificate=folder / "station.pem", key=folder / "station.key")
    for file in (files.ca, files.certificate, files.key):
        if not file.is_file():
            raise NotFoundError(f"{file}: not there; tls/... endpoints want it ({VARIABLE} names another folder)")
    if files.key.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise NotPermittedError(f"{files.key}: others may read this key; expected mode 600 (chmod 600 {files.key})")
    return files


def session_config(endpoint: str, timeout: float, tls: ClientTls | None) -> dict[str, Any]:
    """Of a Zenoh session that dials one endpoint, and neither listens nor discovers.

    Args:
        endpoint: of the robot.
        timeout: for the link, s.
        tls: for ``tls/...`` endpoints.
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
