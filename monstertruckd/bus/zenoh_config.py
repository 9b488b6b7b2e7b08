"""Where and how the robot is reachable over Zenoh."""

import json
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema
from monstertruckd.bus.access import access_rules

HANG_UP_US: Final = 2_000_000
"""A station to which an answer, or another one's message that must not be lost, does not get through in this time is
hung up on. Zenoh's own 5 s are long for those whose requests wait behind it; a large map takes its time, too."""


class TlsConfig(Schema):
    """Mutual TLS for ``tls/...`` endpoints; identities are the common names of the clients' certificates."""

    ca: Path
    """Certificate of the authority that signed all others."""
    certificate: Path
    """The robot's own certificate; must name every address a client dials."""
    key: Path
    """Its private key."""
    pilots: tuple[str, ...] = Field(min_length=1)
    """Common names that may see, ask and drive."""
    observers: tuple[str, ...] = ()
    """Common names that may only see."""


class ZenohConfig(Schema):
    """The robot's Zenoh session; the default is reachable from this machine only."""

    mode: Literal["router", "peer"] = "router"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """Endpoints stations connect to."""
    connect: tuple[str, ...] = ()
    """Routers of a fleet to connect to; tried again for ever."""
    tls: TlsConfig | None = None
    access_control: bool = False
    """Refuse forged state from everybody who can connect; always on with ``tls``. Subscribers must then ask for
    one group (``mt/truck/state/**``): wider expressions get nothing."""
    max_sessions: int = Field(default=64, ge=1)
    gather_seconds: float = Field(default=0.04, ge=0, le=0.1)
    """Messages of regular topics (1 Hz and more) leave for network and log together, each about this late
    at most; 0: at once."""


def session_config(robot: str, config: ZenohConfig, *, probe: bool = False) -> str:
    """Zenoh's own JSON configuration of the robot's session, or of a client that looks whom it would meet.

    No discovery at all, for fixed endpoints connect in milliseconds. A full transmit queue drops at once
    (``wait_before_drop`` 0) because a put happens on the event loop; each is deep enough for the largest message.
    No shared memory: it takes 20 MB and a thread of its own, and for scans it is the slower way.
    """
    transport: dict[str, Any] = {
        "unicast": {"max_sessions": config.max_sessions},
        "shared_memory": {"enabled": False},
        "link": {
            "tx": {
                "queue": {
                    "size": {"data_high": 16, "data": 16, "data_low": 16},
                    "congestion_control": {
                        "drop": {"wait_before_drop": 0},
                        "block": {"wait_before_close": HANG_UP_US},
                    },
                }
            },
        },
    }
    session: dict[str, Any] = {
        "mode": "client" if probe else config.mode,
        "listen": {"endpoints": () if probe else config.listen, "exit_on_failure": True},
        "connect": {"endpoints": config.connect, "timeout_ms": 500, "exit_on_failure": probe},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": True},
        "adminspace": {"enabled": False},
        "transport": transport,
    }
    if config.tls is not None:
        transport["link"]["tls"] = {
            "root_ca_certificate": str(config.tls.ca),
            "listen_certificate": str(config.tls.certificate),
            "listen_private_key": str(config.tls.key),
            "connect_certificate": str(config.tls.certificate),
            "connect_private_key": str(config.tls.key),
            "enable_mtls": True,
            "close_link_on_expiration": True,
        }
        session["access_control"] = access_rules(robot, config.tls.pilots, config.tls.observers)
    elif config.access_control:
        session["access_control"] = access_rules(robot)
    return json.dumps(session)
