"""``monstertruckd drill``: seeded faults on an emulated truck, and a scored report."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.options import SimulatedOption
from monstertruckd.tools.cli.output import JsonOption, console, print_json, print_table, progress
from monstertruckd.tools.shipped import shipped

if TYPE_CHECKING:
    from monstertruckd.tools.drill.campaign import CampaignReport
    from monstertruckd.tools.drill.random_drill import DrillReport, FaultOutcome

Report = TypeVar("Report", "DrillReport", "CampaignReport")
FULL_CONFIG = shipped("configs/full.yaml")


@needs_extra("sim")
def drill(
    seed: Annotated[int, typer.Option(min=0, help="Seed of the faults, their times and durations.")] = 1,
    count: Annotated[int, typer.Option(min=1, help="Number of faults.")] = 50,
    config: SimulatedOption = FULL_CONFIG,
    families: Annotated[
        bool, typer.Option(help="Falsify any signal of any device and ignore commands, one at a time and in pairs.")
    ] = False,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of processes; default: all cores but one.")] = None,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Resume the drill that wrote this file; new outcomes are appended."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Inject random faults into the emulated robot while it drives, and score its reactions.

    Everything runs on a virtual clock, with the deadman line wired. With --families an operator drives at random, and
    only the simulated world judges. Exit code 1 if any motion was unsafe or any service did not recover.
    """
    from monstertruckd.tools.drill.campaign import Campaign
    from monstertruckd.tools.drill.legs import default_jobs
    from monstertruckd.tools.drill.random_drill import Drill
    from monstertruckd.tools.simulation.config import load_simulated

    truck = load_simulated(config)
    if families:
        found = _run("trials", Campaign(seed, count, truck).run, count, jobs or default_jobs(), resume)
        _show_families(found, json_output=json_output)
        unsafe, stuck = found.unsafe, found.stuck
    else:
        drill = Drill(seed, count, truck)
        report = _run("faults", drill.run, count, jobs or default_jobs(), resume)
        _show(report, drill.unguarded, json_output=json_output)
        unsafe, stuck = report.unsafe, report.stuck
    if unsafe or stuck:
        raise typer.Exit(1)


def _run(what: str, run: Callable[..., Report], count: int, jobs: int, resume: Path | None) -> Report:
    finished = 0
    with progress(what, count) as done:

        def show(outcomes: Sequence[Any]) -> None:
            nonlocal finished
            finished += len(outcomes)
            done(finished)

        return run(jobs=jobs, resume=resume, report=show)


def _show_families(report: "CampaignReport", *, json_output: bool) -> None:
    from monstertruckd.tools.drill.summary import by_family, troubles, without_reason

    if json_output:
        print_json(report.as_json())
        return
    summaries = by_family(report.outcomes)
    numbers = ("trials", "noticed", "p50 s", "max s", "unsafe", "stuck")
    rows = [
        (
            *map(str, (row.trials, row.noticed)),
            *map(_seconds, (row.reason_p50_s, row.reason_max_s)),
            *map(str, (row.unsafe, row.stuck)),
            row.reason or "-",
            row.family,
        )
        for row in summaries
    ]
    print_table((*numbers, "reason", "family"), rows, right=numbers)
    out, figures = console(), report.figures()
    for line in without_reason(summaries):
        out.print(line)
    for line in troubles(report.outcomes):
        out.print(line, style="red")
    out.print(
        f"{figures['trials']} trials, {figures['pairs']} of two faults, {figures['reverse']} in reverse: "
        f"{report.unsafe} with unsafe motion, {report.stuck} not recovered; "
        f"recovered after {_seconds(figures['recovery_p50_s'])} s (p50), {_seconds(figures['recovery_p99_s'])} s (p99)"
    )


def _show(report: "DrillReport", unguarded: Sequence[str], *, json_output: bool) -> None:
    if json_output:
        print_json(report.as_json() | {"unguarded": unguarded})
        return
    _print(report)
    if unguarded:
        names = ", ".join(unguarded)
        console().print(
            f"no fault disconnected {names}: without a deadman line, an unreachable motor cannot be stopped"
        )


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
        f"{len(report.outcomes)} faults: {report.unsafe} with unsafe motion, {report.stuck} not "
        f"recovered, {report.blocked} times moved by hand; recovered after "
        f"{_seconds(report.recovery(50))} s (p50), {_seconds(report.recovery(99))} s (p99); score "
        f"[bold]{report.score:.1f}[/bold] of 100"
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
