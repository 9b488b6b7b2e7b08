"""Commands on logs: look inside, repair, export, play back."""

import json
from pathlib import Path
from typing import Annotated

import typer

from monstertruckd.cli.options import ENDPOINT
from monstertruckd.cli.output import JsonOption, print_json, progress

app = typer.Typer(help="Look inside, repair and export logs (MCAP).", no_args_is_help=True)

LogArgument = Annotated[Path, typer.Argument(help="MCAP file, finished or not.", show_default=False)]


@app.command("info")
def info_command(log: LogArgument, json_output: Annotated[bool, typer.Option("--json")] = False) -> None:
    """What a log holds: topics, counts, rates, attachments, damage."""
    from rich.console import Console
    from rich.table import Table

    from monstertruckd.logs import info

    summary = info(log)
    if json_output:
        typer.echo(json.dumps(summary, indent=2))
        return
    console = Console()
    console.print(f"[bold]{log}[/bold]  {summary['size'] / 1e6:.2f} MB, {summary['duration']:.1f} s, ", end="")
    console.print(f"{summary['messages']} messages")
    if summary["damage"]:
        console.print(f"[yellow]damaged: {summary['damage']}; `monstertruckd log recover` repairs it[/yellow]")
    table = Table(box=None, header_style="bold")
    for heading in ("topic", "schema", "messages", "Hz", "kB"):
        table.add_column(heading, justify="left" if heading in ("topic", "schema") else "right")
    for name, row in summary["topics"].items():
        rate = "" if row["rate"] is None else f"{row['rate']:.1f}"
        table.add_row(name, row["schema"], str(row["messages"]), rate, f"{row['bytes'] / 1e3:.1f}")
    console.print(table)
    for name, size in summary["attachments"].items():
        console.print(f"attached: {name} ({size} bytes)")


@app.command("recover")
def recover_command(
    log: LogArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Default: repaired in place.")] = None,
) -> None:
    """Repair an unfinished or truncated log: everything up to the first error is kept."""
    from monstertruckd.logs import recover

    done = recover(log, output or log)
    typer.echo(f"{done.path}: {done.messages} messages kept" + (f"; {done.damage}" if done.damage else ", was sound"))


@app.command("report")
def report_command(
    log: LogArgument,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="HTML file; default: beside the log.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Write one HTML page about a log: way, states, events, signals, health, losses. It needs no network."""
    from monstertruckd.logs.report import report

    with progress("report", log.stat().st_size if log.exists() else None) as done:
        written = report(log, output, done)
    if json_output:
        print_json(written.figures())
    else:
        typer.echo(str(written.file))


@app.command("export")
def export_command(
    log: LogArgument,
    directory: Annotated[Path, typer.Argument(help="Folder for one file per topic.", show_default=False)],
    form: Annotated[str, typer.Option("--format", "-f", help="csv or npz.")] = "csv",
) -> None:
    """Write every topic of a log as CSV or as NumPy arrays."""
    from monstertruck_runtime.errors import InputError
    from monstertruckd.logs import export_csv, export_npz

    exporters = {"csv": export_csv, "npz": export_npz}
    if form not in exporters:
        raise InputError(f"--format {form}: expected one of {', '.join(exporters)}")
    for topic, file in exporters[form](log, directory).items():
        typer.echo(f"{topic:20} {file}")


def replay(
    log: LogArgument,
    robot: Annotated[str, typer.Option("--robot", "-r", help="Name to replay under.")] = "truck",
    endpoint: Annotated[str, typer.Option("--endpoint", "-e", help="Where to listen.")] = ENDPOINT,
    speed: Annotated[float, typer.Option(min=0.01, max=1000, help="Multiple of real time.")] = 1.0,
    topics: Annotated[list[str] | None, typer.Option("--topic", "-t", help="Only these topics.")] = None,
) -> None:
    """Publish a log on Zenoh at its own times, for `status`, `echo` and any other subscriber."""
    from monstertruckd.replay import replay_log

    count = replay_log(log, robot, endpoint, speed, topics)
    typer.echo(f"{count} messages replayed")
