"""A command's connection to one robot."""

import json
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeVar

from monstertruck_runtime.endpoints import robot_on_host
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruckd.tools.cli.output import remark

SOON: Final = 0.7
"""Usual timeout for a robot's answer; after it the command reports that it is waiting (s)."""


if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.config.truck import TruckConfig

T = TypeVar("T")


def with_robot(
    main: "Callable[[TruckClient, Clock], Coroutine[Any, Any, T]]",
    robot: str,
    endpoint: str,
    timeout: float = 2.5,
    *,
    named: bool = True,
) -> T:
    """Connect, run ``main(client, clock)``, and return its result; report a slow connection.

    Args:
        main: coroutine that uses the robot.
        robot: name of the robot.
        endpoint: address of the robot.
        timeout: timeout for the link and for answers (s).
        named: whether to print the robot's name and host first; False for commands that only read or print it
            themselves.

    Raises:
        NotFoundError: no robot answers at this address.
    """
    import asyncio

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import run_wall

    async def session(clock: "Clock") -> T:
        waiting = asyncio.create_task(_say_waiting(robot, endpoint, clock))
        try:
            async with TruckClient(robot, endpoint, clock=clock, timeout=timeout) as client:
                waiting.cancel()
                if named:
                    remark(f"robot: {robot_on_host(robot, endpoint)}")
                return await main(client, clock)
        finally:
            waiting.cancel()

    return run_wall(session)


async def _say_waiting(robot: str, endpoint: str, clock: "Clock") -> None:
    await clock.sleep(SOON)
    remark(f"waiting for robot {robot!r} at {endpoint} ...")


async def robot_config(client: "TruckClient") -> "TruckConfig":
    """Return the robot's configuration without the section ``sim``: no tool may use the true state of the world."""
    from monstertruckd.config.truck import TruckConfig

    running = await client.call("config")
    running.pop("sim", None)
    return TruckConfig.model_validate_json(json.dumps(running))


async def not_ready(client: "TruckClient") -> str:
    """List the faulty services of the robot with reasons, as an addition to a message about missing data.

    Empty if all are ready.
    """
    from monstertruck_schemas.health import ServiceState
    from monstertruck_schemas.topics import HEALTH

    table = None
    with suppress(TruckError):
        table = await client.get_retained(HEALTH)
    rows = [row for row in (() if table is None else table.services) if row.state is not ServiceState.READY]
    named = ", ".join(f"{row.name} ({(row.detail or row.state.value).partition(chr(10))[0]})" for row in rows)
    return f"; not ready: {named}" if named else ""


EXAMPLES = {"explorer": "explore", "planner": "goals", "points": "points", "zones": "zones"}
"""Bundled configurations that have this section."""


async def require_section(client: "TruckClient", section: str, lacks: str) -> Any:
    """Return a section of the robot's configuration, as JSON.

    Args:
        client: client of the robot.
        section: name of the section.
        lacks: capability that the robot lacks without it, such as "does not explore".

    Raises:
        NotFoundError: the configuration does not contain it.
    """
    found = (await client.call("config")).get(section)
    if not found:
        example = f", like the bundled `{EXAMPLES[section]}`" if section in EXAMPLES else ""
        text = f"{lacks}: add a section `{section}` to its configuration{example}"
        raise NotFoundError(f"robot {client.robot!r} {text}")
    return found
