"""Commands that watch a running robot: the live screen, and plain messages."""

import asyncio
import json
import sys
from contextlib import suppress
from typing import Annotated

import typer

from monstertruck_runtime.clock import WallClock, run_wall

RobotOption = Annotated[str, typer.Option("--robot", "-r", help="Name of the robot.")]
EndpointOption = Annotated[str, typer.Option("--endpoint", "-e", help="Where the robot listens.")]
ENDPOINT = "tcp/127.0.0.1:7447"


def status(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = ENDPOINT,
    once: Annotated[bool, typer.Option("--once", help="Print the state once and end.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Machine-readable output; implies --once.")] = False,
) -> None:
    """Live screen of a running robot. Piped or with --once it prints the state once."""
    from monstertruckd.cli.watch import print_once, watch

    with suppress(KeyboardInterrupt):
        if once or json_output or not sys.stdout.isatty():
            run_wall(lambda clock: print_once(clock, robot, endpoint, json_output=json_output))
        else:
            run_wall(lambda clock: watch(clock, robot, endpoint))


def echo(
    topic: Annotated[str, typer.Argument(help="Name from `monstertruckd topics`, e.g. state/pose.")],
    robot: RobotOption = "truck",
    endpoint: EndpointOption = ENDPOINT,
    count: Annotated[int | None, typer.Option("--count", "-n", help="End after so many messages.")] = None,
) -> None:
    """Print a topic's messages as JSON, one per line."""
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.errors import NotFoundError
    from monstertruck_runtime.mailbox import fifo
    from monstertruck_schemas.topics import BY_NAME

    row = BY_NAME.get(topic)
    if row is None:
        raise NotFoundError(f"no topic {topic!r}; known: {', '.join(BY_NAME)}")

    async def main(clock: WallClock) -> None:
        async with TruckClient(robot, endpoint, clock=clock) as client:
            with client.subscribe(row, fifo(256)) as messages:
                seen = 0
                async for message in messages:
                    print(json.dumps(message.model_dump(mode="json"), allow_nan=True), flush=True)
                    seen += 1
                    if seen == count:
                        return

    with suppress(KeyboardInterrupt, asyncio.CancelledError):
        run_wall(main)
