"""``arm``, ``disarm``, ``estop``, ``reset``: one order each; the gate's answer is the exit code."""

from monstertruck_runtime.clock import Clock, run_wall
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.options import ENDPOINT, EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, finish, print_json


def _run(name: str, robot: str, endpoint: str, *, json_output: bool) -> None:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_schemas.req import Order
    from monstertruckd.tools.cli.answer import Answer, give

    async def main(clock: Clock) -> Answer:
        async with TruckClient(robot, endpoint, clock=clock) as client:
            return await give(client, clock, Order(name))

    answer = run_wall(main)
    if json_output:
        print_json(answer.as_json())
    elif answer.reason is Reason.OK:
        held = ", ".join(r.text for r in answer.state.reasons if r not in (Reason.DISARMED, Reason.ESTOPPED))
        print(answer.state.mode.value + (f"; {held}" if held else ""))
    finish(answer.reason, f"{name} refused: {answer.text}")


def arm(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT, json_output: JsonOption = False) -> None:
    """Allow the truck to move: whoever asks for it drives from now on, a configured path too."""
    _run("arm", robot, endpoint, json_output=json_output)


def disarm(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT, json_output: JsonOption = False) -> None:
    """Stop the truck by its ordinary ramp, and allow no motion until it is armed again."""
    _run("disarm", robot, endpoint, json_output=json_output)


def estop(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT, json_output: JsonOption = False) -> None:
    """Emergency stop: at once, latched over restarts of the daemon until `reset`."""
    _run("estop", robot, endpoint, json_output=json_output)


def reset(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT, json_output: JsonOption = False) -> None:
    """Clear an emergency stop; the truck must stand and stays disarmed."""
    _run("reset", robot, endpoint, json_output=json_output)
