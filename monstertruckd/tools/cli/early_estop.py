"""``monstertruckd estop``: the order is on its way before the command line is loaded."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from getopt import GetoptError, gnu_getopt
from typing import Final

import zenoh

from monstertruck_runtime.early_estop import send_estop
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, nearest
from monstertruck_runtime.errors import TruckError

TIMEOUT: Final = 0.5
"""Seconds to wait for the link; the ordinary command waits longer."""


@contextmanager
def early_estop(arguments: Sequence[str]) -> Iterator[None]:
    """Send an emergency stop by the arguments of ``estop``; the session is open while the context lasts.

    What goes wrong is left to the ordinary command, which orders again and says so.
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
    return send_estop(robot, nearest(endpoint), TIMEOUT)
