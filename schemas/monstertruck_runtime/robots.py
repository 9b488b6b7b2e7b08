"""Robots that answer on this computer; used to choose one if no endpoint is given."""

import json
from collections.abc import Callable

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, announced, local_endpoints, nearest, public
from monstertruck_runtime.errors import InputError


def robots_at(endpoint: str, timeout: float = 0.5) -> list[str]:  # timeout of a liveliness query (s)
    """Names of the robots that answer at an endpoint; empty if none does, or if it requires a certificate."""
    import zenoh  # noqa: PLC0415 - takes longer than a command's other work, and is rarely needed

    from monstertruck_runtime.stations import session_config  # noqa: PLC0415
    from monstertruck_schemas.topics import alive_key  # noqa: PLC0415

    config = session_config(endpoint, timeout, None)
    try:
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            replies = session.liveliness().get(alive_key("*"), timeout=timeout)
            return sorted({str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None})
    except zenoh.ZError:
        return []


def robots_here(near: str = DEFAULT_ENDPOINT) -> list[tuple[str, str]]:
    """Robots of this computer's daemons with their endpoints, ``near`` first; takes up to a second.

    All are queried at once; robots that require a certificate are listed by their announced names.
    """
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415 - most commands need no thread

    endpoints = local_endpoints(near=near)
    certified = {one.endpoint: [one.robot] for one in announced() if one.protocol == "tls"}
    with ThreadPoolExecutor(max(1, len(endpoints))) as pool:
        names = pool.map(lambda endpoint: certified.get(endpoint) or robots_at(endpoint), endpoints)
        return [(robot, endpoint) for endpoint, found in zip(endpoints, names, strict=True) for robot in found]


def only_robot(name: str | None, choice: Callable[[str, str], str]) -> str:
    """Endpoint if none is given: the default port, unless several robots, or one at another port, answer.

    Args:
        name: name of the robot; None if it is not given either.
        choice: text that describes how to choose a robot, from its name and endpoint.

    Raises:
        InputError: several robots are possible, or none answers at the default port; the message lists those that
            answer.
    """
    default = nearest(DEFAULT_ENDPOINT)
    endpoints = local_endpoints()
    if not endpoints or (name is not None and endpoints == [default]):
        return default
    there = [row for row in robots_here() if name in (None, row[0])]
    rows = ", ".join(choice(robot, public(endpoint)) for robot, endpoint in there)
    if len(there) > 1:
        raise InputError(f"{len(there)} robots answer on this computer; choose one: {rows}")
    if name is None and there and there[0][1] != default:
        raise InputError(f"no robot answers at {DEFAULT_ENDPOINT}; another one does on this computer: {rows}")
    return there[0][1] if there else default
