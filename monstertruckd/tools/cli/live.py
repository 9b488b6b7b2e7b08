"""Commands that watch a running robot: the live screen, and plain messages."""

import math
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import NoAnswerError
from monstertruckd.tools.cli.connection import not_ready
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, TopicArgument
from monstertruckd.tools.cli.output import JsonOption, on_terminal, print_json, remark, until_stopped

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_schemas.topics import Topic


def status(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    once: Annotated[bool, typer.Option("--once", help="Print the state once and exit.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Machine-readable output; implies --once.")] = False,
) -> None:
    """Show a live screen of a running robot. In a pipe or with --once, print the state once."""
    from monstertruckd.tools.status.watch import print_once, watch

    if once or json_output or not on_terminal(sys.stdout):
        until_stopped(lambda clock: print_once(clock, robot, endpoint, json_output=json_output))
    else:
        until_stopped(lambda clock: watch(clock, robot, endpoint))


def echo(
    topic: TopicArgument,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    count: Annotated[
        int | None, typer.Option("--count", "-n", min=1, help="Exit after this number of messages.")
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(min=0.0, help="Give up after this number of seconds without a message; exit code 5.")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Print the messages of a topic as they arrive, one JSON object per line.

    On a terminal long lists are truncated.
    """
    import asyncio

    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.mailbox import fifo
    from monstertruck_schemas.topics import BY_NAME
    from monstertruckd.tools.logs.messages import require_topics

    require_topics(topic)
    row = BY_NAME[topic]
    short = on_terminal(sys.stdout) and not json_output

    async def main(clock: "Clock") -> None:
        async with TruckClient(robot, endpoint, clock=clock) as client:
            with client.subscribe(row, fifo(256)) as messages:
                waiting = asyncio.create_task(_explain_silence(client, clock, row))
                seen = 0
                try:
                    while seen != count:
                        async with clock.deadline(math.inf if timeout is None else timeout):
                            message = await messages.next()
                        waiting.cancel()
                        print_json(shortened(message.model_dump(mode="json")) if short else message, indent=None)
                        seen += 1
                except TimeoutError:
                    raise NoAnswerError(f"no message of {topic} received within {timeout:g} s") from None
                finally:
                    waiting.cancel()

    until_stopped(main)


async def _explain_silence(client: "TruckClient", clock: "Clock", topic: "Topic[Any]") -> None:
    from monstertruck_schemas.topics import Writer

    await clock.sleep(2.0)  # seconds without a message before `echo` reports the awaited topic
    if not await client.alive():
        remark(f"robot {client.robot!r} not found at {client.endpoint}; waiting for {topic.name}")
    elif topic.writer is Writer.STAND:
        remark(f"robot {client.robot!r} only records {topic.name}, if `stand:` is set, and never publishes it; waiting")
    else:
        why = await not_ready(client)
        remark(f"robot {client.robot!r} is running but does not publish {topic.name} yet; waiting{why}")


def shortened(value: Any) -> Any:
    """Return ``value`` with long lists and texts truncated, each with its original length."""
    short = 16  # maximum number of list values on a terminal; texts are truncated at four times as many characters
    match value:
        case dict():
            return {name: shortened(inner) for name, inner in value.items()}
        case list() if len(value) > short:
            return [*map(shortened, value[: short // 2]), f"... {len(value)} values"]
        case list():
            return [shortened(inner) for inner in value]
        case str() if len(value) > 4 * short:
            return f"{value[: 4 * short]}... {len(value)} characters"
        case _:
            return value
