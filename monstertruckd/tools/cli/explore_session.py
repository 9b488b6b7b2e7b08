"""One exploration, as a client of the robot."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Final, Protocol

from monstertruck_runtime.errors import NoAnswerError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.requests import Operator
from monstertruck_schemas.plan import ExplorationState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.topics import EXPLORE

EVERY: Final = 5.0
"""Seconds between two lines without a change of what is done."""


class ExploringClient(Operator, Protocol):
    """Client of a robot that explores."""

    async def explore(
        self, order: ExploreOrder, *, home: bool | None = None, budget: float | None = None, find: int | None = None
    ) -> dict[str, Any]:
        """Start an exploration, or end it."""
        ...


@dataclass(frozen=True, slots=True)
class ExplorationEnd:
    """How an exploration ended."""

    reason: Reason
    text: str
    elapsed: float
    """Seconds."""
    travelled: float
    """Metres."""
    known: float
    """Free ground in the map, m^2."""
    goals: int

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)


async def run_exploration(
    client: ExploringClient,
    *,
    home: bool | None,
    budget: float | None,
    find: int | None = None,
    arm: bool,
    report: Callable[[str], object] | None = None,
) -> ExplorationEnd:
    """Start an exploration and wait for its end; cancelled or without an answer, it is stopped.

    Args:
        client: of the robot.
        home: see ``TruckClient.explore``.
        budget: likewise, s.
        find: likewise.
        arm: arm the robot first.
        report: gets a line of progress now and then.

    Raises:
        RequestRefusedError: the start or the arming was refused.
        NoAnswerError: the robot does not answer.
    """
    with client.subscribe(EXPLORE, fifo(256)) as states:
        if arm:
            await client.arm()
        try:
            number = int((await client.explore(ExploreOrder.START, home=home, budget=budget, find=find))["number"])
            return await _followed(states, number, report)
        except BaseException as error:
            if not isinstance(error, TruckError) or isinstance(error, NoAnswerError):
                with suppress(TruckError):
                    await client.explore(ExploreOrder.STOP)
            raise


async def _followed(
    states: Mailbox[ExplorationState], number: int, report: Callable[[str], object] | None
) -> ExplorationEnd:
    shown: ExplorationState | None = None
    async for state in states:
        if state.number < number:
            continue
        if state.number > number:
            return ExplorationEnd(Reason.CANCELLED, f"{state.source} started another one", 0.0, 0.0, 0.0, 0)
        changed = shown is None or (state.phase, state.goals) != (shown.phase, shown.goals)
        if report is not None and (changed or shown is None or state.elapsed - shown.elapsed >= EVERY):
            shown = state
            report(progress_line(state))
        if not state.running:
            return ExplorationEnd(state.outcome, state.text, state.elapsed, state.travelled, state.known, state.goals)
    raise NoAnswerError("the link to the robot was closed")


def progress_line(state: ExplorationState) -> str:
    """How far an exploration has come, in less than 80 characters."""
    where = "" if state.target is None else f" to ({state.target.x:.1f}, {state.target.y:.1f})"
    return (
        f"{state.elapsed:5.0f} s {state.travelled:6.1f} m  {state.known:6.1f} m^2 known, "
        f"{state.frontiers:2d} frontiers  {state.phase}{where}"
    )
