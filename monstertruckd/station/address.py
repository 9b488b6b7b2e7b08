"""Addresses of the robots that a station shows."""

import re
from dataclasses import dataclass
from typing import Self

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.endpoints import is_endpoint, nearest, public
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.robots import only_robot
from monstertruck_runtime.stations import own_source, tls_for

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


def _option(robot: str, endpoint: str) -> str:
    return f"--robot {robot}@{public(endpoint)}"


@dataclass(frozen=True, slots=True)
class RobotAddress:
    """Name of a robot, and an endpoint at which the robot, or a router connected to it, listens."""

    name: str
    endpoint: str

    @classmethod
    def parse(cls, text: str) -> Self:
        """Parse ``NAME@ENDPOINT``; without an endpoint, use the robot of this name on this machine.

        Raises:
            InputError: the name is not valid in a key, the endpoint is invalid, or several robots on this machine have
                the name; the message lists these robots.
        """
        name, at, endpoint = text.partition("@")
        if not _NAME.fullmatch(name):
            raise InputError(f"robot {text!r}: expected NAME@ENDPOINT, the name of letters, digits, _ and -")
        if at and not is_endpoint(endpoint):
            raise InputError(f"robot {text!r}: expected an endpoint such as tcp/192.168.1.7:7447 after the @")
        return cls(name, nearest(endpoint) if at else only_robot(name, _option))

    @classmethod
    def default(cls) -> Self:
        """Return the default robot of a station.

        Raises:
            InputError: several robots on this machine match, or none answers at the default port; the message lists the
                robots.
        """
        return cls("truck", only_robot(None, _option))

    def session(self, program: str, clock: Clock, timeout: float) -> TruckClient:
        """Return a session with the robot for a program of the station; for ``timeout`` (s) see ``TruckClient``."""
        tls = tls_for(self.endpoint)
        source = own_source(None if tls is None else tls.owner(), program)
        return TruckClient(self.name, self.endpoint, source=source, clock=clock, timeout=timeout, tls=tls)
