"""``monstertruckd move``: one basic move under a motion profile."""

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, parse_angle
from monstertruckd.tools.cli.output import JsonOption, print_end

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd


class MoveProfile(StrEnum):
    """How the speed grows and falls."""

    TRAPEZOID = "trapezoid"
    CUBIC = "cubic"
    RAMP = "ramp"


def move(
    radius: Annotated[
        float | None,
        typer.Option(help="Radius of the arc, m; centre on the left positive, 0 = on the spot, left out = straight."),
    ] = None,
    length: Annotated[float | None, typer.Option(help="Distance, m; backwards negative.")] = None,
    angle: Annotated[
        float | None,
        typer.Option(parser=parse_angle, metavar="DEGREES", help="Turn, counter-clockwise positive; or 1.57rad."),
    ] = None,
    bearing: Annotated[
        float | None,
        typer.Option(
            parser=parse_angle, metavar="DEGREES", help="Direction of travel; 0 = ahead, 90 = sideways to the left."
        ),
    ] = None,
    profile: Annotated[
        MoveProfile | None, typer.Option(help="Default: that of the configuration's behaviour `move`.")
    ] = None,
    speed: Annotated[float | None, typer.Option(help="Maximum speed, m/s; on the spot rad/s.")] = None,
    acceleration: Annotated[float | None, typer.Option(help="Maximum acceleration, m/s^2 or rad/s^2.")] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the robot first; it drives off at once.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive an arc, straight on, sideways or round on the spot, by --length or by --angle.

    Ends at the end of the move, or with the reason why it was refused or given up. Ctrl-C stops it.
    """
    from monstertruckd.tools.cli.runs import run_behaviour

    if length is None and angle is None:
        raise InputError("expected --length 0.5, or --radius 0 --angle 90, for example")
    spot = radius == 0.0
    given = {
        "radius": radius,
        "length": length,
        "angle": angle,
        "bearing": bearing,
        "profile": None if profile is None else profile.value,
        "turn_rate" if spot else "speed": speed,
        "turn_acceleration" if spot else "acceleration": acceleration,
    }
    settings = {name: value for name, value in given.items() if value is not None}
    _check(settings)

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        return await run_behaviour(client, "move", arm=arm, settings=settings)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


def _check(settings: dict[str, Any]) -> None:
    """Refuse invalid moves before contacting any robot.

    Raises:
        InputError: names the expectation.
    """
    from pydantic import ValidationError

    from monstertruck_planners.behave.move import MoveConfig

    try:
        MoveConfig.model_validate(settings)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        where = "".join(f"--{name}: " for name in detail["loc"])
        message = detail["msg"].removeprefix("Value error, ").replace("Input should be ", "expected ")
        raise InputError(where + message) from None
