"""Endpoints of the robot on Zenoh, and access to them."""

import ipaddress
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, host_of, is_endpoint, local_endpoint, protocol_of
from monstertruck_schemas.base import Schema
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import owner_of
from monstertruckd.bus.access import EVERYTHING, OBSERVING, Grant, access_rules

OWNER_NAME: Final = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.@-]{0,31}")
"""Common names of certificates: one part of a key, without the colon that begins the name of one of its programs, and
without a leading dot: the name also names a folder."""
OwnerName = Annotated[str, Field(pattern=f"^{OWNER_NAME.pattern}$")]
Owners = Annotated[tuple[OwnerName, ...], Field(strict=False)]


class TlsConfig(Schema):
    """Mutual TLS for ``tls/...`` endpoints; identities are the common names of the clients' certificates."""

    ca: Path
    """Certificates of the authorities, or of the single stations, that may connect."""
    certificate: Path
    """The robot's own certificate; must name every address a client dials."""
    key: Path
    """Its private key."""
    pilots: Owners = ()
    """Common names that may observe, call and drive."""
    observers: Owners = ()
    """Common names that may observe, and order an emergency stop."""
    engineers: Owners = ()
    """Common names that may do all a pilot may, and save and undo calibrations."""
    routers: Owners = ()
    """Common names of a fleet's routers, which bind names to certificates and forward requests of others."""
    ranks: dict[OwnerName, Literal[Role.GAMEPAD, Role.KEYBOARD, Role.STATION]] = {}
    """Highest role a name may claim; by default station."""
    pilots_ca: Path | None = None
    """Like ``ca``, of pilots and engineers only, for ``listen_pilots``."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        names = (*self.pilots, *self.observers, *self.engineers)
        everybody = (*names, *self.routers)
        if not self.pilots and not self.engineers:
            raise ValueError("tls: expected a name in pilots or engineers: no station could drive")
        if twice := sorted({name for name in everybody if everybody.count(name) > 1}):
            raise ValueError(f"tls: {', '.join(twice)}: expected one role each")
        if unknown := sorted(set(self.ranks) - set(names)):
            raise ValueError(f"tls.ranks: {', '.join(unknown)}: expected names of pilots, observers or engineers")
        return self

    def grants(self) -> dict[str, Grant]:
        """Permissions by name."""
        roles = (
            (AccessRole.PILOT, self.pilots),
            (AccessRole.OBSERVER, self.observers),
            (AccessRole.ENGINEER, self.engineers),
        )
        return {name: Grant(role, self.ranks.get(name, Role.STATION)) for role, names in roles for name in names}


class ZenohConfig(Schema):
    """The robot's Zenoh sessions; the default is reachable from this machine only."""

    mode: Literal["router", "peer"] = "router"
    """Zenoh's mode: a router also connects stations with each other."""
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    """Endpoints stations connect to."""
    listen_pilots: tuple[str, ...] = ()
    """``tls/...`` endpoints of a separate session, so that observers do not use up the connections of pilots."""
    local_socket: bool = True
    """A separate session on a Unix socket for the robot's own command line, which no station can use up."""
    connect: tuple[str, ...] = ()
    """Routers of a fleet to connect to; retried until connected."""
    tls: TlsConfig | None = None
    insecure: bool = False
    """Allow endpoints on a network without TLS, to listen at or to connect to: every program there may drive the
    truck."""
    access_control: bool = False
    """Refuse state published by others in this robot's name; always on with ``tls``. Subscribers must then subscribe to
    one group (``mt/truck/state/**``): wider expressions receive nothing."""
    max_sessions: int = Field(default=64, ge=1)
    """Stations that may be connected at once; the same number again at ``listen_pilots``."""
    gather_seconds: float = Field(default=0.04, ge=0, le=0.1)
    """Messages of regular topics (1 Hz and more) leave for network and log together, each about this late
    at most; 0: at once."""

    @field_validator("listen", "listen_pilots", "connect")
    @classmethod
    def _endpoints(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        for endpoint in given:
            if not is_endpoint(endpoint):
                raise ValueError(f"{endpoint!r} is not an endpoint: expected tcp/HOST:PORT or tls/HOST:PORT")
        return given

    @property
    def open_endpoints(self) -> tuple[str, ...]:
        """Network endpoints without TLS, to listen on or to connect to."""
        return tuple(endpoint for endpoint in (*self.listen, *self.connect) if _open_to_network(endpoint))

    @property
    def certified_endpoints(self) -> tuple[str, ...]:
        """Endpoints that require a certificate."""
        return tuple(end for end in (*self.listen, *self.listen_pilots, *self.connect) if protocol_of(end) == "tls")

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if self.open_endpoints and not self.insecure:
            raise ValueError(
                f"zenoh: {', '.join(self.open_endpoints)}: anyone on the network could drive the robot; "
                "expected tls/... endpoints with zenoh.tls (monstertruckd security init), or "
                "zenoh.insecure: true"
            )
        if self.certified_endpoints and self.tls is None:
            raise ValueError(f"zenoh: {', '.join(self.certified_endpoints)} needs zenoh.tls")
        plain = [end for end in self.listen_pilots if protocol_of(end) != "tls"]
        if self.listen_pilots and (plain or self.tls is None or self.tls.pilots_ca is None):
            raise ValueError("zenoh.listen_pilots: expected tls/... endpoints, and zenoh.tls.pilots_ca")
        return self


class PeerConfig(Schema):
    """Another robot whose poses are received."""

    endpoint: str
    """Its endpoint, e.g. tcp/192.168.1.8:7447"""
    length: Annotated[float, Field(gt=0, le=10)] | None = None
    """Length of its outline (m); null: the length of this robot"""
    width: Annotated[float, Field(gt=0, le=10)] | None = None
    """Width of its outline (m); null: the width of this robot"""


@dataclass(frozen=True, slots=True)
class Listener:
    """One Zenoh session of the robot: its endpoints, its number of connections, and the rights of its sources."""

    listen: tuple[str, ...]
    places: int
    """Maximum number of simultaneous client sessions."""
    connect: tuple[str, ...] = ()
    ca: Path | None = None
    """Who may connect; None: everybody."""
    grants: dict[str, Grant] | None = None
    """Rights by name on the certificate; None: all rights to everybody."""
    routers: tuple[str, ...] = ()
    """Names on the certificates of a fleet's routers."""
    guarded: bool = False
    """Whether forged state is refused."""

    def grant(self, source: str) -> Grant:
        """Rights of a source in this session."""
        return EVERYTHING if self.grants is None else self.grants.get(owner_of(source), OBSERVING)


def listeners(config: ZenohConfig) -> list[Listener]:
    """Return the sessions of a robot; the first one serves all stations and the fleet."""
    tls = config.tls
    guarded = config.access_control or tls is not None
    grants = None if tls is None else tls.grants()
    ca, routers = (None, ()) if tls is None else (tls.ca, tls.routers)
    found = [Listener(config.listen, config.max_sessions, config.connect, ca, grants, routers, guarded)]
    if config.listen_pilots and tls is not None and grants is not None:
        driving = {name: grant for name, grant in grants.items() if grant.role.covers(AccessRole.PILOT)}
        found.append(Listener(config.listen_pilots, config.max_sessions, (), tls.pilots_ca, driving, guarded=guarded))
    if config.local_socket and (local := local_endpoint(config.listen)) is not None:
        found.append(Listener((local,), 16, guarded=guarded))  # sessions of the command line on the robot
    return found


def session_config(robot: str, config: ZenohConfig, listener: Listener, *, probe: bool = False) -> str:
    """Return Zenoh's JSON configuration for one of the robot's sessions, or for a client that probes its endpoints.

    Discovery is off because fixed endpoints connect within milliseconds. A full transmit queue drops messages
    immediately (``wait_before_drop`` 0) because a put happens on the event loop; each queue is deep enough for the
    largest message. Shared memory is off: it needs 20 MB and a thread, and is slower for scans.
    """
    # 2_000_000: time limit before a station is disconnected that does not take an answer (us), or a message that must
    # not be dropped. Zenoh's own 5 s are too long for requests that wait behind it; a large map needs some time as
    # well.
    transport: dict[str, Any] = {
        "unicast": {"max_sessions": listener.places},
        "shared_memory": {"enabled": False},
        "link": {
            "tx": {
                "queue": {
                    "size": {"data_high": 16, "data": 16, "data_low": 16},
                    "congestion_control": {
                        "drop": {"wait_before_drop": 0},
                        "block": {"wait_before_close": 2_000_000},
                    },
                }
            },
        },
    }
    session: dict[str, Any] = {
        "mode": "client" if probe else config.mode,
        "listen": {"endpoints": () if probe else listener.listen, "exit_on_failure": True},
        "connect": {"endpoints": listener.connect, "timeout_ms": 500, "exit_on_failure": probe},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "adminspace": {"enabled": False},
        "transport": transport,
    }
    if config.tls is not None and listener.ca is not None:
        transport["link"]["tls"] = {
            "root_ca_certificate": str(listener.ca),
            "listen_certificate": str(config.tls.certificate),
            "listen_private_key": str(config.tls.key),
            "connect_certificate": str(config.tls.certificate),
            "connect_private_key": str(config.tls.key),
            "enable_mtls": True,
            "close_link_on_expiration": True,
        }
    if listener.guarded:
        owners: Iterable[str] | None = listener.grants
        session["access_control"] = access_rules(robot, owners, listener.routers)
    return json.dumps(session)


def _open_to_network(endpoint: str) -> bool:
    """Return whether an endpoint requires no certificate and is reachable from other machines."""
    if protocol_of(endpoint) in ("tls", "unixsock-stream", "serial"):
        return False
    host = host_of(endpoint)
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"
