"""``monstertruckd move``: one basic move under a motion profile."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.model_options import ModelCommand, field_parameters
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_end

if TYPE_CHECKING:
    import inspect

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd


class MoveCommand(ModelCommand):
    """Command with the settings of a move as options."""

    def added(self) -> Iterator["inspect.Parameter"]:
        """Yield the settings that describe one move."""
        from monstertruck_planners.behave.move import MoveConfig

        return field_parameters(
            MoveConfig,
            "radius",
            "length",
            "angle",
            "bearing",
            "profile",
            "speed",
            "acceleration",
            "turn_rate",
            "turn_acceleration",
        )


def move(
    context: typer.Context,
    arm: Annotated[
        bool, typer.Option("--arm", help="Arm the robot first; the robot starts to drive immediately.")
    ] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive an arc, straight, sideways or on the spot, given by --length or --angle.

    Omitted options take the values of the behaviour `move` in the configuration. The command ends with the move, or
    with the reason why it was refused or abandoned. Ctrl-C stops it.
    """
    from monstertruck_planners.behave.move import MoveConfig
    from monstertruckd.tools.cli.runs import run_behaviour

    settings: dict[str, Any] = context.obj
    if "length" not in settings and "angle" not in settings:
        raise InputError("expected --length 0.5, or --radius 0 --angle 90, for example")
    spot = settings.get("radius") == 0.0
    for name in ("speed", "acceleration") if spot else ("turn_rate", "turn_acceleration"):
        if name in settings:
            right = ("--turn-rate", "--turn-acceleration") if spot else ("--speed", "--acceleration")
            wrong = f"--{name.replace('_', '-')}"
            motion = "a turn on the spot" if spot else "a move that is not a turn on the spot"
            raise InputError(f"{wrong} does not apply to {motion}: expected {' or '.join(right)}")
    MoveConfig.model_validate(settings)

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        return await run_behaviour(client, "move", arm=arm, settings=settings)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)
