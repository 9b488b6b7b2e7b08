"""An emergency stop that is sent before the program that waits for its outcome is loaded.

It is not authenticated, for the robot's nonce is not known yet: the robot takes emergency stops from everybody.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from getopt import GetoptError, gnu_getopt
from typing import Final

import zenoh

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, nearest
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.stations import own_source, session_config, tls_for

ENCODING: Final = "application/json;monstertruck.ControlRequest;v=1"


def estop_key(robot: str, source: str) -> str:
    """Key of a source's emergency stops, as in the topic table, which takes long to load."""
    return f"mt/{robot}/req/{source}/estop"


def estop_payload(source: str) -> bytes:
    """The order; its stamps and number are 0, for the robot trusts neither without its nonce."""
    header = {"stamp": 0, "received": 0, "seq": 0, "source": source, "role": "station", "lease": 1.0, "nonce": ""}
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


@contextmanager
def early_estop(arguments: Sequence[str]) -> Iterator[None]:
    """Send an emergency stop with the arguments of ``estop``; the session stays open inside the context.

    Failures are left to the ordinary command, which repeats the order and reports them.
    """
    session = None
    with suppress(GetoptError, TruckError, zenoh.ZError):
        session = _send(arguments)
    try:
        yield
    finally:
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]


def _send(arguments: Sequence[str]) -> zenoh.Session | None:
    options, others = gnu_getopt(list(arguments), "r:e:h", ["robot=", "endpoint=", "json", "help"])
    given = dict(options)
    if others or not given.keys().isdisjoint(("-h", "--help")):
        return None
    robot = given.get("-r") or given.get("--robot") or "truck"
    endpoint = given.get("-e") or given.get("--endpoint") or DEFAULT_ENDPOINT
    return send_estop(robot, nearest(endpoint), 0.5)  # seconds to wait for the link; the ordinary command waits longer
