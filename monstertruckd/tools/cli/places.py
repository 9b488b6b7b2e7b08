"""Robots that answer on this computer: selects the robot of a command without an endpoint."""

from monstertruck_runtime import robots
from monstertruck_runtime.endpoints import public


def options_for(robot: str, endpoint: str) -> str:
    """Options that choose a robot."""
    return f"--robot {robot} --endpoint {public(endpoint)}"


def only_robot(name: str | None) -> str:
    """Return the endpoint of a command without one; see ``robots.only_robot``."""
    return robots.only_robot(name, options_for)
