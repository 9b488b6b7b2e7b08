"""``monstertruckd drill``: seeded faults on an emulated truck, and a scored report."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruckd.tools.cli.options import SimulatedOption
from monstertruckd.tools.cli.output import JsonOption, console, needs_extra, print_json, print_table, progress
from monstertruckd.tools.shipped import shipped

if TYPE_CHECKING:
    from monstertruckd.tools.drill.random_drill import Drill, DrillReport, FaultOutcome

FULL_CONFIG = shipped("configs/full.yaml")


@needs_extra("sim")
def drill(
    seed: Annotated[int, typer.Option(min=0, help="Which faults, when, for how long.")] = 1,
    count: Annotated[int, typer.Option(min=1, help="How many.")] = 50,
    config: SimulatedOption = FULL_CONFIG,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; default: all cores but one.")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers run it, such as tcp://HOST:8786."),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Resume the drill whose outcomes are in this file; new ones are added."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Inject random faults into the emulated robot while it drives, and score its reactions.

    Everything runs on a virtual clock, with the deadman line wired. Exit code 1 if any motion was unsafe or any service
    did not recover.
    """
    from monstertruckd.tools.drill.random_drill import Drill, default_jobs
    from monstertruckd.tools.simulation.config import load_simulated

    drill = Drill(seed, count, load_simulated(config))
    report = _run(drill, jobs or default_jobs(), cluster, resume)
    if json_output:
        print_json(report.as_json() | {"unguarded": drill.unguarded})
    else:
        _print(report)
        if drill.unguarded:
            names = ", ".join(drill.unguarded)
            console().print(
                f"no fault cut off {names}: without a deadman line nothing stops a motor that is not reached"
            )
    if report.unsafe or report.stuck:
        raise typer.Exit(1)


def _run(drill: "Drill", jobs: int, cluster: str | None, resume: Path | None) -> "DrillReport":
    finished = 0
    with progress("faults", drill.count) as done:

        def show(outcomes: "Sequence[FaultOutcome]") -> None:
            nonlocal finished
            finished += len(outcomes)
            done(finished)

        return drill.run(jobs=jobs, cluster=cluster, resume=resume, report=show)


def _print(report: "DrillReport") -> None:
    numbers = ("stop s", "still s", "metres", "back s", "score")
    rows = [_cells(outcome) for outcome in report.outcomes]
    print_table((*numbers, "reaction", "reason", "fault"), rows, right=numbers)
    out = console()
    for outcome in report.outcomes:
        for violation in outcome.violations:
            text = f"{outcome.fault}: after {violation.seconds:.2f} s {violation.rule}: {violation.text}"
            out.print(text, style="red")
        if outcome.stuck:
            out.print(f"{outcome.fault}: not recovered: {', '.join(outcome.stuck)}", style="yellow")
    out.print(
        f"{len(report.outcomes)} faults: {report.unsafe} with unsafe motion, {report.stuck} with something stuck, "
        f"{report.blocked} times moved by hand; "
        f"recovered after {_seconds(report.recovery(50))} s (p50), {_seconds(report.recovery(99))} s (p99); "
        f"score [bold]{report.score:.1f}[/bold] of 100"
    )


def _cells(outcome: "FaultOutcome") -> tuple[str, ...]:
    return (
        _seconds(outcome.stop_bytes_s),
        _seconds(outcome.standstill_s),
        f"{outcome.metres:.3f}",
        _seconds(outcome.recovered_s),
        str(outcome.score),
        outcome.reaction,
        outcome.reason or "-",
        outcome.fault,
    )


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
