"""``plan-server``: computes for a robot that places its planner or tracker on another machine."""

from monstertruck_runtime.clock import Clock
from monstertruckd.tools.cli.options import ENDPOINT, EndpointOption, RobotOption
from monstertruckd.tools.cli.output import until_stopped


def plan_server(robot: RobotOption = "truck", endpoint: EndpointOption = ENDPOINT) -> None:
    """Plan and track for a robot whose configuration says `placement: remote`, until Ctrl-C.

    It dials the robot, and again whenever the robot restarts; what it knows comes from there.
    """
    from monstertruck_planners.steps import CODEC, STEPS
    from monstertruck_runtime.actors.server import serve

    async def main(clock: Clock) -> None:
        await serve(clock, robot, endpoint, STEPS, CODEC)

    until_stopped(main)
