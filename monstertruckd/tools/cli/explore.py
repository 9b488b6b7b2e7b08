"""``monstertruckd explore``: let the robot explore unknown ground, and follow its progress."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.model_options import ModelCommand, field_parameters
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_end, print_words

if TYPE_CHECKING:
    import inspect

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd


class ExploreCommand(ModelCommand):
    """Command with the settings of an exploration as options."""

    def added(self) -> Iterator["inspect.Parameter"]:
        """Yield the options of an order to explore."""
        from monstertruck_schemas.req import ExploreRequest

        return field_parameters(ExploreRequest, "home", "budget", "find", switches={"home": "--home/--stay"})


def explore(
    context: typer.Context,
    stop: Annotated[bool, typer.Option("--stop", help="End the exploration that runs.")] = False,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the robot first; it drives off at once.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Explore: drive to the frontiers of the map until no unknown ground is left, then home, and save the map.

    Prints the progress until the end; the exit code is the reason of the end. Ctrl-C stops it.
    """
    from monstertruck_schemas.req import ExploreOrder
    from monstertruckd.tools.cli.runs import run_exploration

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd | None":
        await require_section(client, "explorer", "does not explore")
        if stop:
            await client.explore(ExploreOrder.STOP)
            return None
        report = None if json_output else print_words
        return await run_exploration(client, arm=arm, report=report, **context.obj)

    end = with_robot(main, robot, endpoint)
    if end is None:
        return
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)
