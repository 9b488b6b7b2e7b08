"""A router of a fleet: its certificate, admitted clients and access rules, derived from its robots' folders.

::

    authority.pem authority.key     certifies only the router; the key stays here
    router/                         for the router: zenoh.json5, its certificate and key, admitted issuers

Robots and stations then trust the router's authority: their folders are rewritten.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from monstertruck_runtime.endpoints import endpoint_of
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import make_folder, replace_file
from monstertruckd.bus.access import router_rules
from monstertruckd.tools.security.certificates import DAY, issue, load, new_authority
from monstertruckd.tools.security.folder import AUTHORITY_DAYS, PORT, ROBOT_DAYS, Folder, require_address

ROUTER: Final = "router"
"""Common name of its certificate."""
PLACE: Final = Path("/etc/zenohd")
"""Folder of the router's files."""


def make_router(
    path: Path, robots: Sequence[Folder], addresses: Sequence[str], now: int, place: Path = PLACE, port: int = PORT
) -> None:
    """Create or renew a router's files, and make its robots and their stations trust it.

    Args:
        path: folder of the router's authority.
        robots: folders of the robots' authorities.
        addresses: addresses of the router, for robots and stations; robots use the first one.
        now: real time (s).
        place: folder of the router's files.
        port: its port.

    Raises:
        InputError: two of them have the same name, or an address is invalid.
        NotFoundError: a folder contains no authority.
    """
    for address in addresses:
        try:
            require_address(address)
        except ValueError as error:
            raise InputError(f"--address {error}") from None
    registers = [folder.register() for folder in robots]
    names = [ROUTER, *(register.robot for register in registers), *{n for each in registers for n in each.stations}]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{', '.join(twice)}: expected a different name for each robot and station behind one router")
    target = path / "router"
    make_folder(target, 0o700)
    files = path / "authority.pem", path / "authority.key"
    if not files[0].exists():  # written after its key
        new_authority(f"Authority of {ROUTER}", now, AUTHORITY_DAYS).save(*files)
    authority = load(*files)
    issue(authority, ROUTER, now, ROBOT_DAYS * DAY, server=addresses).save(target / "router.pem", target / "router.key")
    # One certificate that is behind the others is enough: stations send their issuer's certificate along.
    replace_file(target / "ca.pem", b"".join(folder.authority().pem for folder in robots))
    fleet = {register.robot: tuple(register.stations) for register in registers}
    replace_file(target / "zenoh.json5", json.dumps(router_session(place, port, fleet), indent=2).encode() + b"\n")
    for folder in robots:
        folder.join(ROUTER, endpoint_of("tls", addresses[0], port), authority.pem)


def router_session(place: Path, port: int, fleet: dict[str, tuple[str, ...]]) -> dict[str, Any]:
    """Return Zenoh's configuration of the router.

    Args:
        place: folder of its files.
        port: its port.
        fleet: common names of the stations known to each robot, by its name.
    """
    return {
        "mode": "router",
        "listen": {"endpoints": [f"tls/0.0.0.0:{port}"], "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": False},
        "transport": {
            "unicast": {"max_sessions": 512},  # robots and stations that may be connected at once
            "link": {
                "tls": {
                    "root_ca_certificate": str(place / "ca.pem"),
                    "listen_certificate": str(place / "router.pem"),
                    "listen_private_key": str(place / "router.key"),
                    "enable_mtls": True,
                    "close_link_on_expiration": True,
                }
            },
        },
        "access_control": router_rules(fleet),
    }
