"""Commands of the robot: run the daemon or its remote planner, print the tables of topics and reasons."""

from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.options import ConfigOption, EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_json, print_table, until_stopped

if TYPE_CHECKING:
    from monstertruck_runtime.clock import Clock

VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Also log debug messages.")]


@needs_extra("robot")
def run(config: ConfigOption, verbose: VerboseOption = False) -> None:
    """Run the daemon until SIGTERM or Ctrl-C: neutral first, then everything is closed in order."""
    from monstertruckd.run import run_daemon

    raise typer.Exit(run_daemon(config, verbose=verbose).exit_code)


def topics(json_output: JsonOption = False) -> None:
    """Print the topic table: every key with its message, rate, writer and retention."""
    from monstertruck_schemas.topics import TOPICS

    if json_output:
        rows = [
            {
                "name": topic.name,
                "key": topic.key("<robot>"),
                "schema": topic.schema_name,
                "rate_hz": topic.rate,
                "stale_after_s": topic.stale_after,
                "writer": topic.writer.value,
                "logged": topic.logged,
                "retained": topic.retained,
                "doc": topic.doc,
            }
            for topic in TOPICS
        ]
        print_json(rows)
        return
    print_table(
        ("name", "schema", "Hz", "stale s", "writer", "kept", "what"),
        [
            (
                topic.name,
                topic.schema_name,
                "" if topic.rate is None else f"{topic.rate:g}",
                "" if topic.stale_after is None else f"{topic.stale_after:g}",
                topic.writer.value,
                " ".join(word for word, is_so in (("logged", topic.logged), ("retained", topic.retained)) if is_so),
                topic.doc,
            )
            for topic in TOPICS
        ],
        right=("Hz", "stale s"),
        title="Topics: mt/<robot>/<name>",
    )


def plugins(json_output: JsonOption = False) -> None:
    """List the kinds that a configuration can choose, and the topics, with the distribution each comes from.

    Loads kinds of other distributions to test them; broken ones are listed with the error.
    """
    from monstertruckd.assembly.catalogs import plugins

    found = list(plugins())
    if json_output:
        print_json([row._asdict() for row in found])
        return
    print_table(
        ("group", "name", "from", "what"),
        [
            (row.group.removeprefix("monstertruck."), row.name, row.origin, row.doc if row.error is None else row.error)
            for row in found
        ],
        title="Plug-ins",
    )


def reasons(json_output: JsonOption = False) -> None:
    """Print the reasons of events, refusals and ends, each with its exit code."""
    from monstertruck_schemas.reasons import Reason

    if json_output:
        print_json([{"reason": reason, "exit_code": reason.exit_code, "text": reason.text} for reason in Reason])
        return
    rows = [(reason.value, str(reason.exit_code), reason.text) for reason in Reason]
    print_table(("reason", "exit code", "what"), rows, right=("exit code",))


def plan_server(robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """Plan and track for a robot with `placement: remote` in its configuration, until Ctrl-C.

    It dials the robot, and again whenever the robot restarts; all its data comes from the robot.
    """
    from monstertruck_planners.steps import CODEC, STEPS
    from monstertruck_runtime.actors.remote import POLL, serve
    from monstertruck_runtime.client import TruckClient

    async def main(clock: "Clock") -> None:
        connect = partial(TruckClient, robot, endpoint, clock=clock, timeout=2 * POLL)
        await serve(clock, connect, STEPS, CODEC)

    until_stopped(main)
