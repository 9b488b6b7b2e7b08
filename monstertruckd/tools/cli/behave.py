"""``monstertruckd behave``: list, start and stop behaviours."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import NotFoundError
from monstertruckd.tools.cli.connection import require_section, with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, command_group, print_end, print_json, print_table

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.cli.runs import RunEnd

app = command_group("Behaviours: motion controlled directly by sensors, without a path, such as wall following.")

NameArgument = Annotated[str, typer.Argument(help="Name in the configuration.", show_default=False)]
WITHOUT = "has no behaviours"


@app.command("list")
def list_command(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Print the configured behaviours of the robot."""

    async def main(client: "TruckClient", _: "Clock") -> dict[str, Any]:
        try:
            return await client.call("behaviours")
        except NotFoundError:
            if await client.alive():
                return {}
            raise

    found = with_robot(main, robot, endpoint, named=False)
    if json_output:
        print_json(found)
    elif found:
        print_table(("name", "kind", "what it does"), [(name, row["kind"], row["doc"]) for name, row in found.items()])
    else:
        print("none: add a section `behaviours` to the robot's configuration")


@app.command("start")
def start_command(
    name: NameArgument,
    arm: Annotated[
        bool, typer.Option("--arm", help="Arm the robot first; the robot starts to drive immediately.")
    ] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Start a behaviour and follow it to its end; the exit code is the reason of the end. Ctrl-C stops it."""
    from monstertruckd.tools.cli.runs import run_behaviour

    async def main(client: "TruckClient", _: "Clock") -> "RunEnd":
        known = await require_section(client, "behaviours", WITHOUT)
        if name not in known:
            raise NotFoundError(f"no behaviour {name!r}: expected one of {', '.join(known)}")
        return await run_behaviour(client, name, arm=arm)

    end = with_robot(main, robot, endpoint)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


@app.command("stop")
def stop_command(robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """Stop the running behaviour."""
    from monstertruck_schemas.req import BehaviourOrder

    async def main(client: "TruckClient", _: "Clock") -> None:
        await require_section(client, "behaviours", WITHOUT)
        await client.behave(BehaviourOrder.STOP)

    with_robot(main, robot, endpoint)
