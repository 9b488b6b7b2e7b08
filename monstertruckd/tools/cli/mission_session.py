"""One mission, as a client of the robot."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from monstertruck_runtime.errors import NoAnswerError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.requests import Operator
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.plan import MissionState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import MissionOrder
from monstertruck_schemas.topics import MISSION


class MissionClient(Operator, Protocol):
    """Client of a robot that does missions."""

    async def mission(
        self, order: MissionOrder, mission: Mission | None = None, *, moved: bool = False
    ) -> dict[str, Any]:
        """Start, go on with or end one."""
        ...


@dataclass(frozen=True, slots=True)
class MissionEnd:
    """How a mission ended."""

    mission: str
    reason: Reason
    text: str
    elapsed: float
    """Seconds."""
    step: int
    """The last one, from 1."""
    failures: int

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)


async def run_mission(
    client: MissionClient,
    mission: Mission | None,
    *,
    arm: bool,
    moved: bool = False,
    report: Callable[[str], object] | None = None,
) -> MissionEnd:
    """Start a mission, or go on with the interrupted one, and wait for its end; cancelled, it is stopped.

    Args:
        client: of the robot.
        mission: None = the interrupted one.
        arm: arm the robot first.
        moved: see ``TruckClient.mission``.
        report: gets a line for each step.

    Raises:
        RequestRefusedError: the start or the arming was refused.
        NotFoundError: the robot cannot do one of the steps.
        NoAnswerError: the robot does not answer.
    """
    order = MissionOrder.RESUME if mission is None else MissionOrder.START
    with client.subscribe(MISSION, fifo(256)) as states:
        if arm:
            await client.arm()
        try:
            number = int((await client.mission(order, mission, moved=moved))["number"])
            return await _followed(states, number, report)
        except BaseException as error:
            if not isinstance(error, TruckError) or isinstance(error, NoAnswerError):
                with suppress(TruckError):
                    await client.mission(MissionOrder.STOP)
            raise


async def _followed(states: Mailbox[MissionState], number: int, report: Callable[[str], object] | None) -> MissionEnd:
    shown = (0, 0)
    async for state in states:
        if state.number < number or state.resumable:
            continue
        if state.number > number:
            return MissionEnd(state.name, Reason.CANCELLED, f"{state.source} started another one", 0.0, 0, 0)
        if report is not None and (state.step, state.attempt) != shown and state.running:
            shown = state.step, state.attempt
            again = f", attempt {state.attempt}" if state.attempt > 1 else ""
            report(f"{state.elapsed:6.0f} s  step {state.step} of {state.steps}: {state.doing}{again}")
        if not state.running:
            return MissionEnd(state.name, state.outcome, state.text, state.elapsed, state.step, state.failures)
    raise NoAnswerError("the link to the robot was closed")
