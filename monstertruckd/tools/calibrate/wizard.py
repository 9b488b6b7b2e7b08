"""Calibration wizards: coroutines that lead the operator through typed steps.

A wizard awaits the steps of its ``WizardContext`` one by one: ask for a number, ask for a confirmation, move, collect
messages, fit. It can be cancelled at every step. The truck moves only within ``move`` and is disarmed between moves.
Nothing is written before the wizard returns its result, so an interrupt, a lost link or a killed process leaves the
calibration unchanged; the gate stops the truck, as it does for any operator whose requests end.
"""

import json
import math
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from types import MappingProxyType
from typing import Any, ClassVar, Final, Protocol, TypeVar

import numpy as np

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.calibration import Result, Value, WizardName, value_at
from monstertruckd.config.calibration_rpc import SAVE
from monstertruckd.config.expiry import state_of
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WizardRun, sequence
from monstertruckd.tools.calibrate.motion import Mover
from monstertruckd.tools.calibrate.steps import Collect, Confirm, MoveRecord, MoveStep, Number, Panel, Plot, WatchStep

M = TypeVar("M", bound=Message)
T = TypeVar("T")

CLEAR: Final = Confirm("clear", "The robot is about to move. Is the floor clear as described?")


class Wizard(Protocol):
    """One calibration procedure, with its settings."""

    name: ClassVar[WizardName]
    doc: ClassVar[str]
    """Purpose, in a sentence"""
    room: ClassVar[str]
    """Free space that the truck needs"""

    async def __call__(self, context: "WizardContext") -> Result:
        """Measure."""


class WizardContext:
    """Steps of one wizard, and the truck data it uses.

    Args:
        truck: link to the truck.
        panel: interface to the operator.
        clock: source of time.
        config: configuration of the daemon, including the calibration.
        known: the truck's calibration so far, by wizard; expired results and results for another part are ignored.
    """

    def __init__(
        self,
        truck: TruckClient,
        panel: Panel,
        clock: Clock,
        config: TruckConfig,
        known: Mapping[WizardName, Result] = MappingProxyType({}),
    ) -> None:
        self.config = config
        self.chassis = config.chassis()
        now = clock.now() + clock.real_offset()
        self.expired = {
            name: why for name, result in known.items() if (why := state_of(result, config, now, 0.0).expired)
        }
        self.known = {name: result for name, result in known.items() if name not in self.expired}
        self._truck = truck
        self._panel = panel
        self._clock = clock
        self._mover = Mover(truck, clock, self.chassis)
        self._values: dict[str, Any] = config.model_dump()
        self._moves, self._moved = 0, 0

    def say(self, text: str) -> None:
        """Show a message to the operator."""
        self._panel.say(text)

    def plot(self, plot: Plot) -> None:
        """Show measurements, and the fit to them, to the operator."""
        self._panel.plot(plot)

    def value(self, key: str) -> Value:
        """Return a value of the daemon's configuration.

        Raises:
            InputError: this truck has no such device.
        """
        value = value_at(self._values, key)
        if value is None:
            raise InputError(f"{key}: not in this robot's configuration, so there is nothing to calibrate")
        return value

    async def ask(self, step: Number) -> float:
        """Ask for a number within its bounds.

        Raises:
            InputError: no usable answer is available.
        """
        value = await self._panel.number(step)
        if not step.low <= value <= step.high:
            raise InputError(f"{step.name}: {value:g} is not within {step.low:g} to {step.high:g}")
        return value

    async def confirm(self, step: Confirm) -> bool:
        """Ask for a confirmation; return the answer.

        Raises:
            RequestRefusedError: the operator declined a required step.
            InputError: no answer is available.
        """
        yes = await self._panel.confirm(step)
        if not yes and not step.fact:
            raise RequestRefusedError(Reason.CANCELLED, f"cancelled at: {step.question}")
        return yes

    def expect(self, moves: int) -> None:
        """Set the total for the numbering of the next ``moves`` moves in messages to the operator."""
        self._moves, self._moved = moves, 0

    async def move(self, step: MoveStep) -> MoveRecord:
        """Drive; raises the same errors as ``Mover.move``."""
        self._moved += 1
        which = f" ({self._moved} of {self._moves})" if self._moved <= self._moves else ""
        self._panel.say(f"moving{which}: {step.name}")

        driven: list[tuple[float, float]] = []

        def report(record: MoveRecord, distance: float) -> None:
            self._panel.progress(step.name, distance, step.metres)
            driven.append((distance, math.degrees(record.turned())))
            if record.attitude:
                self.plot(Plot(step.name, "distance (m)", "turn, left positive (deg)", np.array(driven)))

        return await self._mover.move(step, report, self._panel.say)

    async def collect(self, step: Collect[M]) -> list[M]:
        """Collect messages of a topic.

        Raises:
            NoAnswerError: there are too few messages arrived in time.
        """
        found: list[M] = []
        with self._truck.subscribe(step.topic, fifo(step.count)) as messages:
            try:
                async with self._clock.deadline(step.timeout):
                    while len(found) < step.count:
                        found.append(await messages.next())
                        self._panel.progress(step.name, len(found), step.count)
            except TimeoutError:
                text = f"{step.topic.name}: {len(found)} of {step.count} messages received within {step.timeout:g} s"
                raise NoAnswerError(text) from None
        return found

    async def watch(self, step: WatchStep[M]) -> None:
        """Follow messages until ``step.take`` has received enough; raises the same errors as ``step.take``.

        Raises:
            NoAnswerError: no message arrived in time.
        """
        with ExitStack() as feeds:
            newest = feeds.enter_context(self._truck.subscribe(step.topic, latest()))
            # 64: maximum number of messages kept between two calls
            others = {t.name: feeds.enter_context(self._truck.subscribe(t, fifo(64))) for t in step.also}
            done, total = 0.0, 1.0
            while done < total:
                message = await newest.next_within(step.timeout)
                if message is None:
                    raise NoAnswerError(f"{step.topic.name}: no message received for {step.timeout:g} s")
                done, total = step.take(message, {name: box.drain() for name, box in others.items()})
                self._panel.progress(step.name, done, total)

    def fit(self, name: str, function: Callable[[], T]) -> T:
        """Compute a result from the measurements, as a separate step.

        Raises:
            InputError: the measurements do not determine a result. Errors raised by ``function`` are passed on.
        """
        self._panel.say(f"computing: {name}")
        try:
            return function()
        except (ValueError, ArithmeticError) as error:  # includes errors of pydantic, numpy and least squares
            text = str(error).splitlines()[0]
            raise InputError(f"{name}: cannot be computed from the measurement ({text}): measure again") from error


async def calibrate(
    wizard: Wizard,
    truck: TruckClient,
    panel: Panel,
    clock: Clock,
    config: TruckConfig,
    known: Mapping[WizardName, Result],
) -> tuple[Result, str]:
    """Run a wizard and let the daemon save its result; return the value of ``save``.

    Raises:
        TruckError: the wizard ended without a result; nothing was saved.
    """
    return await save(truck, await measure(wizard, truck, panel, clock, config, known))


async def measure(
    wizard: Wizard,
    truck: TruckClient,
    panel: Panel,
    clock: Clock,
    config: TruckConfig,
    known: Mapping[WizardName, Result],
) -> Result:
    """Run a wizard without saving. Raises TruckError if it ended without a result."""
    panel.say(f"{wizard.name}: {wizard.doc}")
    if wizard.room:
        panel.say(f"room: {wizard.room}")
    context = WizardContext(truck, panel, clock, config, known)
    if why := context.expired.get(wizard.name):
        panel.say(f"the previous calibration is ignored because it has expired: {why}")
    return await wizard(context)


async def save(truck: TruckClient, result: Result) -> tuple[Result, str]:
    """Let the daemon save a result; return the saved result and the path of the new file."""
    saved = await truck.call(SAVE, {"result": result.model_dump(mode="json"), "source": truck.source})
    return Result.model_validate_json(json.dumps(saved["result"])), str(saved["file"])


def missing(config: TruckConfig, results: Mapping[str, Result], expired: Collection[str] = ()) -> list[WizardRun]:
    """Return the wizard runs that a robot still needs, ordered so that each can use earlier results.

    Args:
        config: configuration of the robot.
        results: results of the wizards so far.
        expired: wizards with expired results.
    """
    found = []
    for run in sequence():
        wizard, step = run
        result = results.get(wizard.name)
        done = result is not None and result.estimate(step.complete) is not None
        needed = wizard.fits(config) and step.fits(config)
        if needed and not (done and (step.rough or wizard.name not in expired)):
            found.append(run)
    return found
