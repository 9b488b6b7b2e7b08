"""An emergency stop that is sent before the program that waits for its outcome is loaded.

It is not authenticated, for the robot's nonce is not known yet: the robot takes emergency stops from everybody.
"""

import json
from typing import Final

import zenoh

from monstertruck_runtime.stations import own_source, session_config, tls_for

ENCODING: Final = "application/json;monstertruck.ControlRequest;v=1"
LEASE: Final = 1.0


def estop_key(robot: str, source: str) -> str:
    """Key of a source's emergency stops; as that of the topic table, which takes long to load."""
    return f"mt/{robot}/req/{source}/estop"


def estop_payload(source: str) -> bytes:
    """The order; its stamps and number are 0, for the robot trusts neither without its nonce."""
    header = {"stamp": 0, "received": 0, "seq": 0, "source": source, "role": "station", "lease": LEASE, "nonce": ""}
    return json.dumps(header | {"order": "estop"}).encode()


def send_estop(robot: str, endpoint: str, timeout: float) -> zenoh.Session:
    """Send an emergency stop; returns the session, which has to stay open until the order is known to have arrived.

    Args:
        robot: name in its keys.
        endpoint: where it listens.
        timeout: for the link, s.

    Raises:
        TruckError: the certificate's files are missing or wrong.
        zenoh.ZError: nothing answers there.
    """
    tls = tls_for(endpoint)
    source = own_source(None if tls is None else tls.owner())
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(endpoint, timeout, tls))))
    session.put(
        estop_key(robot, source),
        estop_payload(source),
        encoding=ENCODING,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
    )
    return session
