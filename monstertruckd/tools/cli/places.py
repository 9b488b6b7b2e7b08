"""Robots that answer on this computer: which one a command means that names no endpoint."""

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, local_endpoints, nearest, public
from monstertruck_runtime.errors import InputError


def robots_here() -> list[tuple[str, str]]:
    """Robots of this computer's daemons with their endpoints, the default port first; asking takes up to a second."""
    from monstertruckd.bus.port_holder import robots_at

    return [(robot, endpoint) for endpoint in local_endpoints() for robot in robots_at(endpoint)]


def options_for(robot: str, endpoint: str) -> str:
    """Options that choose a robot."""
    return f"--robot {robot} --endpoint {public(endpoint)}"


def only_robot(name: str | None) -> str:
    """Endpoint of a command that names none: the default port, unless several robots answer on this computer.

    Args:
        name: robot that the command names; None if it names none either.

    Raises:
        InputError: several answer to what the command says; lists them.
    """
    default = nearest(DEFAULT_ENDPOINT)
    endpoints = local_endpoints()
    if default not in endpoints or len(endpoints) < 2:
        return default
    there = [row for row in robots_here() if name in (None, row[0])]
    if len(there) > 1:
        rows = ", ".join(options_for(*row) for row in there)
        raise InputError(f"{len(there)} robots answer on this computer; choose one: {rows}")
    return there[0][1] if there else default
