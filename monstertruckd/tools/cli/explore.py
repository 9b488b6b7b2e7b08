"""``monstertruckd explore``: have the robot explore unknown ground, and follow it."""

import re
from typing import TYPE_CHECKING, Annotated, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_end, print_words

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd

UNITS: Final = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


def seconds_of(text: str) -> float:
    """Seconds of a duration such as 90, 90s, 20min or 1.5h.

    Raises:
        InputError: it is none.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|min|h|)\s*", text)
    seconds = 0.0 if found is None else float(found[1]) * UNITS[found[2]]
    if seconds <= 0.0:
        raise InputError(f"duration {text!r}: expected a number above 0 with s, min or h, such as 20min")
    return seconds


def explore(
    home: Annotated[
        bool | None,
        typer.Option(
            "--home/--stay", help="Drive back to the start at the end; else as configured.", show_default=False
        ),
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="Time limit, such as 20min; else as configured.", metavar="TIME")
    ] = None,
    find: Annotated[
        int | None,
        typer.Option(min=1, help="Look for tags on walls, too; ends when the map has so many.", show_default=False),
    ] = None,
    stop: Annotated[bool, typer.Option("--stop", help="End the exploration that runs.")] = False,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the robot first; it drives off at once.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Explore: drive to the edges of the map until nothing is left to be seen, then home, and save the map.

    Prints its progress, and ends with it; its reason is the exit code. Ctrl-C stops it.
    """
    from monstertruck_schemas.req import ExploreOrder
    from monstertruckd.tools.cli.runs import run_exploration

    seconds = None if budget is None else seconds_of(budget)

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd | None":
        await require_section(client, "explorer", "does not explore")
        if stop:
            await client.explore(ExploreOrder.STOP)
            return None
        report = None if json_output else print_words
        return await run_exploration(client, home=home, budget=seconds, find=find, arm=arm, report=report)

    end = with_robot(main, robot, endpoint)
    if end is None:
        return
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)
