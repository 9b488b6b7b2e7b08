"""One run of a behaviour, as a client of the robot."""

from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from monstertruck_runtime.errors import NoAnswerError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.requests import Operator
from monstertruck_schemas.plan import BehaviourState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import BehaviourOrder
from monstertruck_schemas.topics import BEHAVIOUR
from monstertruckd.tools.cli.output import progress


class BehaviourClient(Operator, Protocol):
    """Client of a robot that has behaviours."""

    async def behave(
        self, order: BehaviourOrder, behaviour: str = "", settings: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """Start or stop a behaviour."""
        ...


@dataclass(frozen=True, slots=True)
class BehaviourEnd:
    """How a behaviour ended."""

    behaviour: str
    reason: Reason
    text: str
    elapsed: float
    """Seconds."""
    travelled: float
    """Metres."""
    values: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Everything as plain data."""
        return asdict(self)


async def run_behaviour(
    driver: BehaviourClient, name: str, *, arm: bool, settings: Mapping[str, Any] | None = None
) -> BehaviourEnd:
    """Start a behaviour and wait for its end; cancelled or without an answer, it is stopped.

    Args:
        driver: the robot's client.
        name: of the behaviour.
        arm: the robot first.
        settings: those that replace the configured ones.

    Raises:
        RequestRefusedError: the start or the arming was refused.
        NoAnswerError: the robot does not answer.
    """
    with driver.subscribe(BEHAVIOUR, fifo(256)) as states:
        if arm:
            await driver.arm()

        async def stop() -> None:
            with suppress(TruckError):
                await driver.behave(BehaviourOrder.STOP, name)

        start = driver.behave(BehaviourOrder.START, name, settings)
        return await _followed(states, name, start, stop)


async def _followed(
    states: Mailbox[BehaviourState],
    name: str,
    start: Awaitable[dict[str, Any]],
    stop: Callable[[], Awaitable[None]],
) -> BehaviourEnd:
    try:
        number = int((await start)["number"])
        with progress(name) as show:
            async for state in states:
                if state.number > number:
                    return BehaviourEnd(
                        name, Reason.CANCELLED, f"{state.source} started {state.behaviour}", 0.0, 0.0, {}
                    )
                if state.number < number:
                    continue
                show(state.elapsed)
                if not state.running:
                    return BehaviourEnd(
                        name, state.outcome, state.text, state.elapsed, state.travelled, dict(state.values)
                    )
        raise NoAnswerError("the link to the robot was closed")
    except BaseException as error:
        if not isinstance(error, TruckError) or isinstance(error, NoAnswerError):
            await stop()
        raise
