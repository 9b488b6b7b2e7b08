"""``plan-server``: computes for a robot that places its planner or tracker on another machine."""

from functools import partial

from monstertruck_runtime.clock import Clock
from monstertruckd.tools.cli.options import ENDPOINT, EndpointOption, RobotOption
from monstertruckd.tools.cli.output import until_stopped


def plan_server(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT) -> None:
    """Plan and track for a robot whose configuration says `placement: remote`, until Ctrl-C.

    It dials the robot, and again whenever the robot restarts; what it knows comes from there.
    """
    from monstertruck_planners.steps import CODEC, STEPS
    from monstertruck_runtime.actors.remote import POLL, serve
    from monstertruck_runtime.client import TruckClient

    async def main(clock: Clock) -> None:
        connect = partial(TruckClient, robot, endpoint, clock=clock, timeout=2 * POLL)
        await serve(clock, connect, STEPS, CODEC)

    until_stopped(main)
