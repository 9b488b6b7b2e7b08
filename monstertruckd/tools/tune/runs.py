"""Runs of a wall-following behaviour with gains of the recipe, each from a step of the distance wanted."""

import math
from collections.abc import Awaitable, Callable, Generator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

from pydantic import Field

from monstertruck_runtime.drives import taken_back
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.presence import while_it_runs
from monstertruck_runtime.requests import Operator
from monstertruck_schemas.base import Schema
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.topics import BEHAVIOUR
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.tune.recipe import RunVerdict, WallGains, judged, recipe

FOLLOWING: Final = "follow"
LOST: Final = 0.12
"""Maximum distance error before a run is aborted, m; the robot must not lose the wall. It means overshooting."""


Samples = Sequence[tuple[float, float]]
"""Times since following began, s, and measured distances, m."""


class Tuning(Schema):
    """Runs by which the gains are found."""

    first: Annotated[float, Field(ge=0.1, le=100)] = 6.0
    """K_p of the first run"""
    seconds: Annotated[float, Field(ge=4, le=60)] = 8.0
    """Time of following in each run, s"""


class TuningRun(NamedTuple):
    """One run."""

    gains: WallGains
    samples: tuple[tuple[float, float], ...]
    """Times since the step, s, and distance errors, m."""
    verdict: RunVerdict

    @property
    def text(self) -> str:
        """Result in one line."""
        gains, (overshoot, steady) = self.gains, self.verdict
        stayed = math.isfinite(overshoot)
        found = f"{100 * overshoot:.0f} % overshoot, steady error {1000 * steady:.1f} mm" if stayed else "left the wall"
        return f"K_p {gains.k_p:.3g}, K_d {gains.k_d:.3g}: {found}"


async def tune(
    client: Operator,
    name: str,
    distance: float,
    tuning: Tuning,
    pause: Callable[[], Awaitable[None]],
    report: Callable[[TuningRun], None],
) -> WallGains | None:
    """Run the recipe with a robot that stands along a wall: it is armed, and disarmed at the end, also after errors.

    Before each run the behaviour as configured, with its own gains, brings the robot along the wall.

    Args:
        client: client of the robot.
        name: name of a behaviour of kind ``wall_pd``.
        distance: the nearer one, m; every second run wants 5 cm more.
        tuning: first gain and length of the runs.
        pause: waits until the robot stands.
        report: called with every run.

    Raises:
        RequestRefusedError: arming or a start is refused, the behaviour ended before the run was complete, its service
            failed, or the robot restarted.
        NoAnswerError: the robot does not answer, or has been silent for a minute.
    """
    async with taken_back(client.disarm):
        await client.arm(hold=True)  # until the behaviour runs: a path that the robot has would be driven
    try:
        return await _tuned(client, name, distance, recipe(tuning.first), tuning.seconds, pause, report)
    finally:
        with suppress(TruckError):
            await client.disarm()


async def _tuned(
    client: Operator,
    name: str,
    distance: float,
    trials: Generator[WallGains, RunVerdict, WallGains | None],
    seconds: float,
    pause: Callable[[], Awaitable[None]],
    report: Callable[[TuningRun], None],
) -> WallGains | None:
    gains, number = next(trials), 0
    while True:
        # 0.05: change of the wanted distance from one run to the next, m
        before, wanted = (distance + 0.05 * (n % 2) for n in (number, number + 1))
        await _run(client, name, {"distance": before}, partial(_calm, before), held=number == 0)
        await pause()
        samples = await _run(client, name, {**gains._asdict(), "distance": wanted}, partial(_over, wanted, seconds))
        errors = tuple((at, measured - wanted) for at, measured in samples)
        lost = abs(errors[-1][1]) > LOST
        found = TuningRun(
            gains, errors, RunVerdict(math.inf, math.inf) if lost else judged([error for _, error in errors])
        )
        report(found)
        await pause()
        number += 1
        try:
            gains = trials.send(found.verdict)
        except StopIteration as end:
            best: WallGains | None = end.value
            return best


def _calm(wanted: float, samples: Samples) -> bool:
    """Return whether the robot keeps its distance."""
    calm_for = 2.0  # minimum time of the error below 2 cm, s
    newest = [measured for at, measured in samples if at >= samples[-1][0] - calm_for]
    # 0.02: distance error below which a robot is ready for a run, m
    return samples[-1][0] >= calm_for and max(abs(measured - wanted) for measured in newest) < 0.02


def _over(wanted: float, seconds: float, samples: Samples) -> bool:
    """Return whether a run is complete, or has to be broken off."""
    return samples[-1][0] >= seconds or abs(samples[-1][1] - wanted) > LOST


async def _run(
    client: Operator, name: str, settings: Mapping[str, Any], over: Callable[[Samples], bool], *, held: bool = False
) -> Samples:
    """One start of the behaviour: the first stretch of following that is over; a corner begins a new one.

    A robot that is ``held`` may drive from then on.
    """
    with client.subscribe(BEHAVIOUR, fifo(1024)) as states:
        try:
            number = int((await client.behave(BehaviourOrder.START, name, settings))["number"])
            if held:
                await client.arm()
            return await while_it_runs(client, _followed(states, number, over), ServiceName.BEHAVIOURS)
        finally:
            with suppress(TruckError):
                await client.behave(BehaviourOrder.STOP, name, own=True)


async def _followed(states: Mailbox[BehaviourState], number: int, over: Callable[[Samples], bool]) -> Samples:
    begun, samples = 0.0, list[tuple[float, float]]()
    limit = 120.0  # time limit of a run, s
    async for state in states:
        if state.number != number:
            continue
        if not state.running:
            raise RequestRefusedError(state.outcome, f"the run ended early: {state.text or state.outcome.text}")
        if state.elapsed > limit:
            text = f"{state.phase} for {limit:g} s: place the robot alongside a straight wall"
            raise RequestRefusedError(Reason.TIMEOUT, text)
        if state.phase != FOLLOWING or "distance" not in state.values:
            samples = []
            continue
        begun = begun if samples else state.elapsed
        samples.append((state.elapsed - begun, state.values["distance"]))
        if over(samples):
            return samples
    raise NoAnswerError("the link to the robot was closed")


def draw(runs: Sequence[TuningRun], path: Path) -> None:
    """Write the distance errors of all runs, in their order.

    Raises:
        InputError: the file cannot be written.
    """
    columns = 4
    rows = math.ceil(len(runs) / columns)
    figure = new_figure(3.2 * columns, 2.4 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flat
    for place, (number, run) in zip(axes, enumerate(runs, 1), strict=False):
        times, errors = zip(*run.samples, strict=True)
        place.plot(times, [1000 * error for error in errors])
        place.axhline(0.0, color="grey", linewidth=0.5)
        place.set_title(f"{number}. " + run.text.replace(": ", "\n"), fontsize=8)
    figure.supxlabel("time since the step, s")
    figure.supylabel("distance error, mm")
    write_figure(figure, path)
