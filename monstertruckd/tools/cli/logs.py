"""Commands on logs: inspect, repair, export, play back."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.extras import needs_extra
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, complete_topic
from monstertruckd.tools.cli.output import JsonOption, command_group, finish, print_json, print_table, progress, remark

if TYPE_CHECKING:
    from monstertruckd.recorder.reader import LogReader
    from monstertruckd.tools.logs.messages import Progress, Selection

app = command_group("Inspect, repair and export logs (MCAP).")

TopicsOption = Annotated[
    list[str] | None, typer.Option("--topic", "-t", help="Only these topics.", autocompletion=complete_topic)
]
StartOption = Annotated[float, typer.Option("--start", min=0.0, help="Seconds after the start of the log.")]
EndOption = Annotated[float | None, typer.Option("--end", min=0.0, help="Seconds after the start of the log.")]


RECOVER: Final = "`monstertruckd log recover` repairs it"


class ExportFormat(StrEnum):
    """Export formats of a log."""

    CSV = "csv"
    NPZ = "npz"
    ROS2 = "ros2"
    MCAP = "mcap"
    PARQUET = "parquet"
    ROSBAG2 = "rosbag2"
    TUM = "tum"
    KITTI = "kitti"
    LEROBOT = "lerobot"


LogArgument = Annotated[Path, typer.Argument(help="MCAP file, finished or not.", show_default=False)]


@app.command("list")
def list_command(
    folder: Annotated[Path, typer.Argument(help="Folder of logs, including subfolders.")] = Path("logs"),
    json_output: JsonOption = False,
) -> None:
    """List the logs of a folder, latest last: date, robot, duration, size, finished or not."""
    from monstertruckd.tools.logs.summary import LogState, list_logs

    logs = list_logs(folder)
    if json_output:
        print_json([asdict(log) for log in logs])
        return
    if not logs:
        remark(f"{folder}: no logs")
        return
    print_table(
        ("begins (UTC)", "robot", "seconds", "messages", "MB", "state", "log"),
        [
            (
                log.started or "-",
                log.robot or "-",
                "-" if log.duration is None else f"{log.duration:.1f}",
                "-" if log.messages is None else str(log.messages),
                f"{log.size / 1e6:.2f}",
                log.state.value,
                str(log.path),
            )
            for log in logs
        ],
        right=("seconds", "messages", "MB"),
    )
    if any(log.state in {LogState.UNFINISHED, LogState.DAMAGED} for log in logs):
        remark("`monstertruckd log recover FILE` repairs unfinished and damaged logs")


@app.command("info")
def info_command(log: LogArgument, json_output: JsonOption = False) -> None:
    """Show the content of a log: topics, counts, rates, attachments, damage."""
    from monstertruckd.recorder.repair import in_use
    from monstertruckd.tools.logs.summary import info

    summary = info(log)
    damaged = summary["damage"] is not None and not in_use(log)
    if json_output:
        print_json(summary)
    else:
        _show_info(log, summary)
    if damaged:
        raise typer.Exit(Reason.LOG_DAMAGED.exit_code)


def _show_info(log: Path, summary: "dict[str, Any]") -> None:
    from monstertruckd.recorder.repair import in_use

    size = f"{summary['size'] / 1e6:.2f} MB"
    print(f"{log}  {size}, {summary['duration']:.1f} s, {summary['messages']} messages")
    if summary["damage"]:
        repair = "the recorder is writing it" if in_use(log) else RECOVER
        print(f"damaged: {summary['damage']}; {repair}")
    rows = [
        (
            name,
            row["schema"],
            str(row["messages"]),
            "" if row["rate"] is None else f"{row['rate']:.1f}",
            f"{row['bytes'] / 1e3:.1f}",
        )
        for name, row in summary["topics"].items()
    ]
    print_table(("topic", "schema", "messages", "Hz", "kB unpacked"), rows, right=("messages", "Hz", "kB unpacked"))
    for name, bytes_ in summary["attachments"].items():
        print(f"attached: {name} ({bytes_} bytes)")


@app.command("fetch")
def fetch_command(
    name: Annotated[str | None, typer.Argument(help="Recording on the robot; omit it to list them.")] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write; default: the name on the robot.")
    ] = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Fetch a recording from a running robot; resumes an earlier download.

    The robot sends at most 1 MB/s, and one recording at a time.
    """
    from monstertruckd.station.recordings import fetch_recording

    if name is None:
        answer = with_robot(lambda client, _: client.call("recordings"), robot, endpoint, named=False)
        _show_recordings(answer["recordings"], json_output=json_output)
        if left_out := answer.get("left_out"):
            remark(f"{left_out} older logs are not listed")
        return
    to = output or Path(Path(name).name)
    with progress(f"fetching {name}", 1.0) as shown:
        fetched = with_robot(
            lambda client, _: fetch_recording(client, name, to, shown), robot, endpoint, 5.0, named=False
        )
    if json_output:
        print_json({"name": name, "file": str(to), "bytes": fetched.bytes})
    else:
        print(f"{to}  {fetched.bytes / 1e6:.2f} MB")


def _show_recordings(rows: "list[dict[str, Any]]", *, json_output: bool) -> None:
    if json_output:
        print_json(rows)
        return
    import numpy as np

    if not rows:
        remark("the robot has no recordings")
        return
    print_table(
        ("changed (UTC)", "MB", "kind", "recording"),
        [
            (
                str(np.datetime64(int(row["modified"]), "s")).replace("T", " "),
                f"{row['bytes'] / 1e6:.2f}",
                f"{row['kind']}{', being written' * row['open']}",
                row["name"],
            )
            for row in rows
        ],
        right=("MB",),
    )


@app.command("recover")
def recover_command(
    log: LogArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Default: the log's own name.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Repair an unfinished or damaged log: every intact chunk is kept; the original is renamed to LOG.damaged."""
    from monstertruckd.recorder.repair import recover

    done = recover(log, output or log)
    if json_output:
        print_json(asdict(done))
    else:
        print(done)


@app.command("report")
def report_command(
    log: LogArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="HTML file; default: next to the log.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Write one HTML page about a log: path, states, events, signals, health, losses. It needs no network."""
    from monstertruckd.tools.logs.report import report

    with reading_log("report", log) as done:
        written = report(log, output, done)
    if json_output:
        print_json(written.figures())
    else:
        typer.echo(str(written.file))
    finish_log(log, written.run.damage)


@app.command("export")
def export_command(
    log: LogArgument,
    output: Annotated[
        Path, typer.Argument(help="Folder of the tables, new folder of the bag, or new MCAP file.", show_default=False)
    ],
    form: Annotated[ExportFormat, typer.Option("--format", "-f", help="Output format.")] = ExportFormat.CSV,
    topics: TopicsOption = None,
    start: StartOption = 0.0,
    end: EndOption = None,
    json_output: JsonOption = False,
) -> None:
    """Write a log as tables (csv, npz, parquet), bag, MCAP with dates, trajectories or data set (lerobot)."""
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.tools.logs.messages import Selection

    selection = Selection(tuple(topics or ()), start, math.inf if end is None else end)
    with needs_extra({ExportFormat.PARQUET: "tables", ExportFormat.LEROBOT: "lerobot"}.get(form, "logs")):
        export = _exporter(form)
    reader = open_log(log)
    with reading_log("export", log) as done:
        files = export(reader, output, selection, done)
    if not files:
        remark(f"{log}: {selection.nothing}")
    if json_output:
        print_json(files)
    else:
        for topic, file in files.items():
            typer.echo(f"{topic:20} {file}")
    finish_log(log, reader.fault)


@app.command("animate")
def animate_command(
    log: LogArgument,
    output: Annotated[Path, typer.Argument(help="GIF file.", show_default=False)],
    speed: Annotated[float, typer.Option(min=0.1, max=1000.0, help="Seconds of the log per second.")] = 8.0,
    width: Annotated[int, typer.Option(min=64, max=1920, help="Pixels.")] = 560,
    json_output: JsonOption = False,
) -> None:
    """Write a drive as an animation: the robot from above, its path, and the echoes of its lidar or sonars."""
    from monstertruckd.recorder.reader import open_log

    with needs_extra("logs"):
        from monstertruckd.tools.logs.animation import animate
    reader = open_log(log)
    with reading_log("animate", log) as done:
        figures = animate(reader, output, speed=speed, width=width, report=done)
    if json_output:
        print_json({"file": str(output), **figures})
    else:
        typer.echo(f"{output}: {figures['seconds']:g} s, {figures['bytes'] / 1e6:.2f} MB")
    finish_log(log, reader.fault)


@app.command("view")
def view_command(
    log: LogArgument,
    save: Annotated[
        Path | None, typer.Option("--save", help="Write this rerun file (.rrd) instead of showing the log.")
    ] = None,
    topics: TopicsOption = None,
    start: StartOption = 0.0,
    end: EndOption = None,
) -> None:
    """Show a log in the rerun viewer, with a prepared layout and without network access (extra `view`)."""
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.tools.logs.messages import Selection

    selection = Selection(tuple(topics or ()), start, math.inf if end is None else end)
    with needs_extra("view"):
        from monstertruckd.tools.logs.rerun_view import convert, show
    reader = open_log(log)
    with TemporaryDirectory(prefix="monstertruckd-") as scratch:
        recording = save or Path(scratch) / f"{log.stem}.rrd"
        with reading_log("convert", log) as done:
            convert(reader, recording, selection, done)
        if save is None:
            show(recording)
        else:
            typer.echo(str(save))
    finish_log(log, reader.fault)


def finish_log(log: Path, fault: str | None) -> None:
    """End a command that used a log; if the log is damaged, print one sentence and use its exit code.

    A log that is still being written is treated as complete up to its end.

    Raises:
        Exit: the log is damaged.
    """
    from monstertruckd.recorder.repair import in_use

    if fault is not None and not in_use(log):
        finish(Reason.LOG_DAMAGED, f"{log}: {fault}; the intact part was used ({RECOVER})")


@contextmanager
def reading_log(what: str, log: Path) -> "Iterator[Progress]":
    """Show progress over the bytes of a log, and convert errors of its content."""
    from monstertruck_runtime.outside import reading

    with progress(what, log.stat().st_size if log.is_file() else None) as done:
        try:
            yield done
        except (OSError, ImportError, typer.Exit):  # of the output, of an extra, of the command
            raise
        except Exception as error:
            with reading(log, f"a log of this program, to {what}"):
                raise error


def _exporter(form: ExportFormat) -> "Callable[[LogReader, Path, Selection, Progress], dict[str, Path]]":
    match form:
        case ExportFormat.CSV:
            from monstertruckd.tools.logs.export import export_csv as export
        case ExportFormat.NPZ:
            from monstertruckd.tools.logs.export import export_npz as export
        case ExportFormat.ROS2 | ExportFormat.ROSBAG2:
            from monstertruckd.tools.logs.ros2 import export_ros2 as export
        case ExportFormat.MCAP:
            from monstertruckd.tools.logs.export import export_mcap as export
        case ExportFormat.PARQUET:
            from monstertruckd.tools.logs.arrow import export_parquet as export
        case ExportFormat.TUM:
            from monstertruckd.tools.logs.pose_files import export_tum as export
        case ExportFormat.KITTI:
            from monstertruckd.tools.logs.pose_files import export_kitti as export
        case ExportFormat.LEROBOT:
            from monstertruckd.tools.logs.lerobot import export_lerobot as export
    return export
