"""`replay`: publish a log on Zenoh again, or recompute its outputs and compare."""

import math
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd.tools.cli.logs import LogArgument, TopicsOption, finish_log, reading_log
from monstertruckd.tools.cli.output import JsonOption, finish, print_json, print_table, progress, remark

if TYPE_CHECKING:
    from monstertruckd.tools.replay_check.comparison import GreatestDifference, TopicComparison
    from monstertruckd.tools.replay_check.result import CheckedReplay

CHECK = "Recompute the log's outputs from its sensor data and compare them."
CONFIG = "With --check: compute with this configuration and show the differences."
TOLERANCE = "With --check: maximum accepted difference, in m, rad and so on; 0: outputs must be identical."

ROUNDED = "only the last digits differ, as between processors with different maths routines"


def replay(
    log: LogArgument,
    robot: Annotated[str, typer.Option("--robot", "-r", help="Robot name to replay under.")] = "truck",
    endpoint: Annotated[str, typer.Option("--endpoint", "-e", help="Address to listen on.")] = DEFAULT_ENDPOINT,
    speed: Annotated[float, typer.Option(min=0.01, max=1000, help="Speed, as a multiple of real time.")] = 1.0,
    topics: TopicsOption = None,
    check: Annotated[bool, typer.Option("--check", help=CHECK)] = False,
    config: Annotated[Path | None, typer.Option("--config", "-c", help=CONFIG)] = None,
    tolerance: Annotated[float | None, typer.Option("--tolerance", min=0, help=TOLERANCE)] = None,
    json_output: JsonOption = False,
) -> None:
    """Publish a log on Zenoh in its original timing, for `status`, `echo` and other subscribers; or check it.

    Ends after the last message, or by Ctrl-C or SIGTERM, with exit code 0. With --check no message is published: the
    outputs are recomputed from the recorded sensor data and compared with the recorded outputs.
    """
    if check:
        _check(log, config, tolerance, json_output=json_output)
        return
    if config is not None or tolerance is not None or json_output:
        raise typer.BadParameter("--config, --tolerance and --json need --check")
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.tools.logs.replay import replay_log

    with suppress(KeyboardInterrupt), reading_log("replay", log) as done:
        reader = open_log(log)
        count = replay_log(reader, robot, endpoint, speed, topics, done)
        remark(f"{count} messages replayed")
        finish_log(log, reader.fault)


def _check(log: Path, config: Path | None, tolerance: float | None, *, json_output: bool) -> None:
    from monstertruckd.tools.replay_check import check_log, parts_of, run_of

    run, until = run_of(log)
    if until is not None:
        remark(f"{log}: is a black box; run {run} is recomputed up to its last message")
    with progress("check", sum(part.stat().st_size for part in parts_of(run))) as done:
        result = check_log(log, config, tolerance, done)
    if json_output:
        print_json(result.figures())
    else:
        _show(result)
    finish(result.reason, _verdict(result))


def _show(result: "CheckedReplay") -> None:
    whose = "the log's own configuration" if result.config is None else str(result.config)
    parts = f" (a run of {len(result.parts)} parts)" if len(result.parts) > 1 else ""
    print(f"{result.log}{parts}  {result.duration:.1f} s with {whose}")
    print_table(
        ("topic", "compared", "equal", "missing", "extra", "maximum difference"),
        [
            (
                row.topic.name,
                str(row.compared),
                str(row.equal),
                str(row.missing),
                str(row.surplus(result.end)),
                _greatest(row),
            )
            for row in result.topics
        ],
        right=("compared", "equal", "missing", "extra"),
    )
    print(f"{result.equal} of {result.compared} outputs identical")
    if result.first is not None:
        first = result.first
        fields = ", ".join(first.fields) or "header"
        print(f"first difference: {first.topic} number {first.sequence} at {first.at:.2f} s: {fields}")
    if result.rounded:
        remark(f"{ROUNDED}: try --tolerance {result.sufficient:g}")
    for message in result.unreadable:
        remark(f"{message.topic} number {message.sequence} at {message.at:.2f} s was skipped: {message.error}")
    if result.left_out is not None:
        remark(f"goals and tracker are not recomputed: {result.left_out}")
    for topic, count in result.lost.items():
        remark(f"{count} messages of {topic} were lost before the log")


def _greatest(row: "TopicComparison") -> str:
    from monstertruckd.tools.replay_check.comparison import Kind

    known = (row.greatest[kind] for kind in Kind if kind in row.greatest)
    parts = [f"{_amount(one)} at {one.at:.1f} s" for one in known]
    return ", ".join(parts) or ("" if row.equal == row.compared else "header")


def _amount(one: "GreatestDifference") -> str:
    from monstertruckd.tools.replay_check.comparison import Kind

    match one.kind:
        case _ if math.isinf(one.value):
            return f"other {one.field}"
        case Kind.LENGTH:
            return f"{one.value * 100:.2g} cm"
        case Kind.ANGLE:
            return f"{math.degrees(one.value):.2g}°"
        case _:
            return f"{one.field} {one.value:.2g}"


def _verdict(result: "CheckedReplay") -> str:
    from monstertruck_schemas.reasons import Reason

    if result.reason is Reason.LOG_DAMAGED:
        return f"{result.log}: {result.damage}"
    if result.reason is Reason.REPLAY_DIFFERS:
        return f"{result.log}: {Reason.REPLAY_DIFFERS.text}"
    return ""
