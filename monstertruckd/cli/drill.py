"""``monstertruckd drill``: seeded faults on an emulated truck, and a scored report."""

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruckd.cli.output import JsonOption

if TYPE_CHECKING:
    from monstertruckd.sim.drill import Drill, Outcome, Report

FULL_CONFIG = Path(__file__).resolve().parents[2] / "configs" / "full.yaml"


def drill(
    seed: Annotated[int, typer.Option(min=0, help="Which faults, when, for how long.")] = 1,
    count: Annotated[int, typer.Option(min=1, help="How many.")] = 50,
    config: Annotated[Path, typer.Option("--config", "-c", help="Simulated truck to drill.")] = FULL_CONFIG,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; default: one per core.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Break the emulated truck again and again while it drives, and score how it takes it.

    Everything runs on a virtual clock, with the deadman line wired. Exit code 1 if any motion was unsafe or any service
    did not come back.
    """
    from monstertruckd.config.validate import load_config
    from monstertruckd.sim.config import SimulatedTruckConfig
    from monstertruckd.sim.drill import Drill

    truck = load_config(config, SimulatedTruckConfig)[0]
    report = _run(Drill(seed, count, truck), jobs or os.cpu_count() or 1)
    if json_output:
        typer.echo(json.dumps(report.as_json(), indent=2))
    else:
        _print(report)
    if report.unsafe or report.stuck:
        raise typer.Exit(1)


def _run(drill: "Drill", jobs: int) -> "Report":
    if not sys.stderr.isatty():
        return drill.run(jobs=jobs)
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=Console(stderr=True)) as progress:
        bar = progress.add_task("faults", total=drill.count)
        return drill.run(jobs=jobs, tell=lambda outcomes: progress.advance(bar, len(outcomes)))


def _print(report: "Report") -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 120)
    table = Table(box=box.SIMPLE)
    for column in ("fault", "reaction", "reason"):
        table.add_column(column)
    for column in ("stop bytes s", "standstill s", "metres", "back s", "score"):
        table.add_column(column, justify="right")
    for outcome in report.outcomes:
        table.add_row(*_cells(outcome))
    console.print(table)
    for outcome in report.outcomes:
        for violation in outcome.violations:
            text = f"{outcome.fault}: after {violation.seconds:.2f} s {violation.rule}: {violation.text}"
            console.print(text, style="red")
        if outcome.stuck:
            console.print(f"{outcome.fault}: not back: {', '.join(outcome.stuck)}", style="yellow")
    console.print(
        f"{len(report.outcomes)} faults: {report.unsafe} with unsafe motion, {report.stuck} with something stuck, "
        f"{report.blocked} times set back by hand; "
        f"back after {_seconds(report.recovery(50))} s (p50), {_seconds(report.recovery(99))} s (p99); "
        f"score [bold]{report.score:.1f}[/bold] of 100"
    )


def _cells(outcome: "Outcome") -> tuple[str, ...]:
    return (
        outcome.fault,
        outcome.reaction,
        outcome.reason or "-",
        _seconds(outcome.stop_bytes_s),
        _seconds(outcome.standstill_s),
        f"{outcome.metres:.3f}",
        _seconds(outcome.recovered_s),
        str(outcome.score),
    )


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
