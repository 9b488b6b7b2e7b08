"""``monstertruckd dock`` and ``undock``: missions of one step."""

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.goto import ArmOption
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_end, print_words

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd

DockArgument = Annotated[
    str | None, typer.Argument(help="Name of the dock; not needed if the robot has one only.", show_default=False)
]


def dock(
    name: DockArgument = None,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive to a dock and charge. Ctrl-C stops the robot."""
    _run("dock", name, robot, endpoint, arm=arm, json_output=json_output)


def undock(
    name: DockArgument = None,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Leave a dock, back to its staging pose. Ctrl-C stops the robot."""
    _run("undock", name, robot, endpoint, arm=arm, json_output=json_output)


def _run(
    do: Literal["dock", "undock"], name: str | None, robot: str, endpoint: str, *, arm: bool, json_output: bool
) -> None:
    from monstertruck_schemas.mission import DockStep, Mission, UndockStep
    from monstertruckd.tools.cli.runs import run_mission

    step = DockStep(do="dock", dock=name) if do == "dock" else UndockStep(do="undock", dock=name)
    mission = Mission(version=2, name=do, steps=(step,))

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        await require_section(client, "docks", "has no docks")
        return await run_mission(client, mission, arm=arm, report=None if json_output else print_words)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)
