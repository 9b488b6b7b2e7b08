"""The demo, and the emulated robot it drives."""

import itertools
import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from monstertruckd.cli.options import ConfigOption
from monstertruckd.cli.output import JsonOption

DEMO_CONFIG = Path(__file__).resolve().parents[2] / "configs" / "demo.yaml"


def demo(
    fast: Annotated[bool, typer.Option("--fast", help="Virtual clock: as fast as it computes, reproducible.")] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of world and devices; default: the configuration's.")] = None,
    config: Annotated[Path, typer.Option("--config", "-c", help="Simulated truck to drive.")] = DEMO_CONFIG,
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder for log, map and outputs.")] = Path(
        "runs/demo"
    ),
    json_output: JsonOption = False,
) -> None:
    """The emulated truck drives a lap: real drivers, real bytes, real log."""
    from monstertruck_runtime.clock import run_wall
    from monstertruck_schemas.reasons import Reason
    from monstertruckd.demo.fast import run_fast_demo
    from monstertruckd.demo.wall import run_wall_demo

    folder = _fresh(output)
    if fast:
        summary = run_fast_demo(config, folder, seed)
    else:
        screen = sys.stdout.isatty() and not json_output
        summary = run_wall(lambda clock: run_wall_demo(clock, config, folder, seed, screen=screen))
    if json_output:
        typer.echo(json.dumps(summary.as_json(), indent=2))
    else:
        _print(summary.rows(), summary.messages)
    if summary.lap.outcome is not Reason.GOAL_REACHED:
        raise typer.Exit(summary.lap.outcome.exit_code or Reason.INTERNAL.exit_code)


def _fresh(folder: Path) -> Path:
    """``folder``, or the first of ``folder-2``, ``folder-3`` ... that is not there yet: no run overwrites another."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{n}") for n in itertools.count(2)))
    return next(name for name in names if not name.exists())


def _print(rows: list[tuple[str, str]], messages: dict[str, int]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for name, value in rows:
        console.print(f"[bold]{name:20}[/bold] {value}", soft_wrap=True, highlight=False)
    counts = Table(box=None, header_style="bold", title="messages per topic", title_justify="left")
    counts.add_column("topic")
    counts.add_column("messages", justify="right")
    for name, count in sorted(messages.items()):
        counts.add_row(name, str(count))
    console.print(counts)


def simulate(
    config: ConfigOption,
    truth: Annotated[Path | None, typer.Option("--truth", help="Write what really happened (npz) at the end.")] = None,
) -> None:
    """Serve a simulated truck's devices behind ptys at the ports its configuration names.

    Faults are read from standard input as with `emulate`, each line beginning with the device's role, the monitor's
    name, or `usb` (an unknown word lists what it knows).
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.sim.host import serve

    run_wall(lambda clock: serve(clock, config, truth))
