"""Calibration of a robot from a browser: a wizard's messages, questions, progress and result."""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, TruckError
from monstertruckd.station import frames
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.viewer import Viewer

TIMEOUT: Final = 10.0
"""Timeout of the robot's answer (s): its daemon writes files."""
SAID: Final = 30
"""Maximum number of messages of a wizard shown."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Result of a wizard, not yet saved."""

    rows: Sequence[dict[str, Any]]
    """Estimates: name, unit, meaning, value, low, high, grade, and the values ``before`` with their interval."""
    measured: str
    """Summary of the measurement, as a sentence."""
    save: Callable[[], Awaitable[str]]
    """Saves the result; returns the location as text for the operator."""


class Calibrator(Protocol):
    """Interface to the calibration wizards."""

    async def offered(self, truck: TruckClient) -> list[dict[str, Any]]:
        """Return the wizards for this robot in the recommended order: id, name, doc, options, and whether it is due."""

    async def measure(self, truck: TruckClient, step: str, options: Mapping[str, Any], panel: "PagePanel") -> Measured:
        """Run a wizard; ``options`` override its defaults.

        Raises:
            TruckError: the wizard ended without a result.
        """


class PagePanel:
    """Connects a wizard to the operator at a browser.

    Args:
        show: called after every change.
    """

    def __init__(self, show: Callable[[], object]) -> None:
        self._show = show
        self.said: deque[str] = deque(maxlen=SAID)
        self.bar: dict[str, Any] | None = None
        """Progress of the current step."""
        self.drawn: dict[str, Any] | None = None
        """Plot of the measurements."""
        self.question: dict[str, Any] | None = None
        """Question to the operator."""
        self._answer: asyncio.Future[float | bool] | None = None

    def say(self, text: str) -> None:
        """Show a message."""
        self.bar = None
        self.said.append(text)
        self._show()

    def progress(self, name: str, done: float, total: float) -> None:
        """Update the progress bar of a step."""
        self.bar = {"name": name, "done": round(min(done, total), 3), "total": total}
        self._show()

    def plot(self, plot: Any) -> None:
        """Show measurements; ``plot`` has a name, labels for its axes, points and optionally a curve."""
        self.drawn = {
            "name": plot.name,
            "x": plot.x,
            "y": plot.y,
            "points": _thinned(plot.points),
            "curve": None if plot.curve is None else _thinned(plot.curve),
        }
        self._show()

    async def number(self, step: Any) -> float:
        """Ask for a number; ``step`` has a name, a question and bounds."""
        return float(await self._ask(kind="number", name=step.name, text=step.question, low=step.low, high=step.high))

    async def confirm(self, step: Any) -> bool:
        """Ask for yes or no; unless the step is a ``fact``, the answer no ends the wizard."""
        return bool(await self._ask(kind="confirm", name=step.name, text=step.question, fact=step.fact))

    async def _ask(self, **question: Any) -> float | bool:
        self._answer, self.question, self.bar = asyncio.get_running_loop().create_future(), question, None
        self._show()
        try:
            value = await self._answer
        finally:
            self._answer = self.question = None
        shown = ("yes" if value else "no") if question["kind"] == "confirm" else f"{value:g}"
        self.say(f"{question['text']} {shown}")
        return value

    def answer(self, value: float | bool) -> None:
        """Answer the pending question.

        Raises:
            InputError: no question is pending, or the number is out of bounds.
        """
        question = self.question
        if question is None or self._answer is None or self._answer.done():
            raise InputError("the wizard is not asking a question")
        if question["kind"] == "number" and not question["low"] <= value <= question["high"]:
            raise InputError(f"{question['name']}: expected {question['low']:g} to {question['high']:g}, got {value:g}")
        if question["kind"] == "confirm" and not isinstance(value, bool):
            raise InputError(f"{question['name']}: expected yes or no")
        self._answer.set_result(value)


class Calibration:
    """Calibration from one browser: one wizard at a time.

    Args:
        address: address of the robot.
        program: name of the session with the robot.
        clock: clock of the station.
        calibrator: the calibration wizards.
        viewer: outbox of the browser.
    """

    def __init__(
        self, address: RobotAddress, program: str, clock: Clock, calibrator: Calibrator, viewer: Viewer
    ) -> None:
        self._address, self._program, self._clock = address, program, clock
        self._calibrator, self._viewer = calibrator, viewer
        self._panel = PagePanel(self._show)
        self._step, self._phase, self._text = "", "idle", ""
        self._measured: Measured | None = None
        self._decision: asyncio.Future[bool] | None = None
        self._task: asyncio.Task[None] | None = None

    def _show(self) -> None:
        measured = None if self._measured is None else {"rows": self._measured.rows, "text": self._measured.measured}
        self._viewer.show(
            "calibrating",
            frames.text(
                "calibrating",
                step=self._step,
                phase=self._phase,
                said=list(self._panel.said),
                progress=self._panel.bar,
                plot=self._panel.drawn,
                question=self._panel.question,
                measured=measured,
                text=self._text,
            ),
        )

    def _session(self) -> TruckClient:
        return self._address.session(self._program, self._clock, TIMEOUT)

    async def offer(self) -> list[dict[str, Any]]:
        """Return the wizards; raises TruckError if the robot refuses or is absent."""
        async with self._session() as truck:
            return await self._calibrator.offered(truck)

    def begin(self, step: str, options: Mapping[str, Any]) -> None:
        """Start a wizard; ``options`` override its defaults.

        Raises:
            InputError: a wizard is already running.
        """
        if self._task is not None and not self._task.done():
            raise InputError(f"calibration {self._step} is already running")
        self._panel, self._step, self._measured = PagePanel(self._show), step, None
        self._enter("running")
        self._task = asyncio.create_task(self._run(step, options), name=f"calibration {step}")

    def answer(self, value: float | bool) -> None:
        """Answer the wizard's question; raises the same errors as ``PagePanel.answer``."""
        self._panel.answer(value)

    def decide(self, *, accept: bool) -> None:
        """Accept or discard the result; a wizard that is still measuring is cancelled.

        Raises:
            InputError: there is no result to accept.
        """
        if self._decision is not None and not self._decision.done():
            self._decision.set_result(accept)
        elif accept:
            raise InputError("there is no result to accept")
        elif self._task is not None:
            self._task.cancel()

    def end(self) -> asyncio.Task[None] | None:
        """Cancel a running wizard without saving; return its task."""
        if self._task is not None:
            self._task.cancel()
        return self._task

    def _enter(self, phase: str, text: str = "") -> None:
        self._phase, self._text = phase, text
        self._show()

    async def _run(self, step: str, options: Mapping[str, Any]) -> None:
        try:
            async with self._session() as truck:
                self._measured = await self._calibrator.measure(truck, step, options, self._panel)
                self._decision = asyncio.get_running_loop().create_future()
                self._enter("measured")
                if await self._decision:
                    self._enter("saved", await self._measured.save())
                else:
                    self._enter("discarded")
        except TruckError as error:
            self._enter("failed", str(error))
        except asyncio.CancelledError:
            self._enter("discarded")
            raise
        finally:
            self._decision = None


def _thinned(points: Any) -> list[list[float]]:
    """Return at most 200 finite points, including the last one, shape (n, 2), for a plot 300 pixels wide."""
    points = points[np.isfinite(points).all(axis=1)]
    step = -(-len(points) // 200)
    return [[float(f"{value:.5g}") for value in point] for point in points[::-1][::step][::-1]] if step else []
