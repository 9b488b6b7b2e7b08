"""``monstertruckd behave``: list, start and stop what reacts to sensors without a path."""

from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import NotFoundError
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, command_group, finish, print_json, print_table

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruckd.tools.cli.behave_session import BehaviourEnd

app = command_group("Behaviours: motion in reaction to sensors, without a path, such as following a wall.")

NameArgument = Annotated[str, typer.Argument(help="Name in the configuration.", show_default=False)]
STOP_ANY: Final = ""


@app.command("list")
def list_command(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Print the behaviours that the robot's configuration has."""
    from monstertruck_runtime.client import TruckClient

    async def main(clock: Clock) -> dict[str, Any]:
        async with TruckClient(robot, endpoint, clock=clock) as client:
            try:
                return await client.call("behaviours")
            except NotFoundError:
                if await client.alive():
                    return {}
                raise

    found = run_wall(main)
    if json_output:
        print_json(found)
    elif found:
        print_table(("name", "kind", "what it does"), [(name, row["kind"], row["doc"]) for name, row in found.items()])
    else:
        print("none: expected a section `behaviours` in the robot's configuration")


@app.command("start")
def start_command(
    name: NameArgument,
    arm: Annotated[bool, typer.Option("--arm", help="Arm the robot first; it drives off at once.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Start a behaviour and follow it to its end, whose reason is the exit code. Ctrl-C stops it."""
    from monstertruck_runtime.client import TruckClient
    from monstertruckd.tools.cli.behave_session import run_behaviour

    async def main(clock: Clock) -> "BehaviourEnd":
        async with TruckClient(robot, endpoint, clock=clock) as client:
            await _check(client, name)
            return await run_behaviour(client, name, arm=arm)

    end = run_wall(main)
    if json_output:
        print_json(end.as_json())
    elif not end.reason.exit_code:
        print(f"{end.reason.text}: {end.text}")
    finish(end.reason, f"{end.reason.text}: {end.text}")


@app.command("stop")
def stop_command(robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """Stop the behaviour that runs."""
    from monstertruck_runtime.client import TruckClient
    from monstertruck_schemas.req import BehaviourOrder

    async def main(clock: Clock) -> None:
        async with TruckClient(robot, endpoint, clock=clock) as client:
            await _check(client, STOP_ANY)
            await client.behave(BehaviourOrder.STOP)

    run_wall(main)


async def _check(client: "TruckClient", name: str) -> None:
    """Refuse a robot without behaviours, or without this one.

    Raises:
        NotFoundError: naming those there are.
    """
    known = (await client.call("config")).get("behaviours") or {}
    if not known:
        raise NotFoundError("the robot has no behaviours: expected a section `behaviours` in its configuration")
    if name and name not in known:
        raise NotFoundError(f"no behaviour {name!r}: expected one of {', '.join(known)}")
