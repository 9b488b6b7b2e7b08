"""An exploration by the emulated robot: find a tag, drive home; its figures, and the report of its log."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.drives import TaskEnd, run_task
from monstertruck_runtime.errors import NoAnswerError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.requests import Operator
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import ExplorationState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ExploreOrder
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import Grid
from monstertruck_schemas.topics import EXPLORE, MAP, POSE
from monstertruckd.tools.demo.summary import log_figures
from monstertruckd.tools.logs.report import report

Report = Callable[[str, Grid | None, Pose2D | None], object]
"""Receives a line of progress, the latest map and the robot's pose in it; None before the first map."""
DONE: Final = frozenset({Reason.GOAL_REACHED, Reason.EXPLORED, Reason.POINTS_FOUND})
"""Outcomes of a successful demo."""
STARTING: Final = frozenset(
    {
        Reason.NO_MAP,
        Reason.PLANNER_STARTING,
        Reason.SCAN_STALE,
        Reason.DRIVE_STALE,
        Reason.STEERING_STALE,
        Reason.ATTITUDE_STALE,
        Reason.BATTERY_STALE,
        Reason.SONAR_STALE,
    }
)
"""Refusals that pass by themselves while the robot starts."""


async def explore_home(
    operator: Operator, clock: Clock, *, tags: bool, report: Report, timeout: float = 120.0
) -> TaskEnd[ExplorationState]:
    """Arm the robot, let it explore, find a tag if it searches for ``tags``, and drive home.

    Args:
        operator: sends the orders.
        clock: source of time.
        tags: whether to end the search once one tag is on the map.
        report: receives the progress every two seconds of the robot's time.
        timeout: maximum wait until the robot is ready (s).

    Raises:
        RequestRefusedError: the exploration does not start.
        NoAnswerError: the robot was not ready in time, or does not answer.
    """
    due = 0.0

    async def ask(order: ExploreOrder, **more: Any) -> dict[str, Any]:
        return await operator.call("explore", {**await operator.header(), "order": order, **more})

    def show(state: ExplorationState) -> None:
        nonlocal due
        if state.elapsed >= due:
            due = state.elapsed + 2.0  # seconds: `map_period` of the bundled configurations
            report(progress(state), maps.latest, None if poses.latest is None else poses.latest.pose)

    begun = clock.now()
    with operator.subscribe(MAP, latest()) as maps, operator.subscribe(POSE, latest()) as poses:
        while True:
            try:
                return await run_task(
                    operator,
                    EXPLORE,
                    ServiceName.EXPLORER,
                    lambda: ask(ExploreOrder.START, home=True, **({"find": 1} if tags else {})),
                    lambda: ask(ExploreOrder.STOP, own=True),
                    show,
                    arm=True,
                    to_its_end=True,
                )
            except RequestRefusedError as error:
                if error.refusal not in STARTING:
                    raise
                if clock.now() - begun > timeout * SECOND:
                    raise NoAnswerError(f"the robot was not ready to explore within {timeout:g} s: {error}") from None
            await clock.sleep(0.5)


def progress(state: ExplorationState) -> str:
    """Describe the progress of an exploration."""
    tags = "" if state.find is None else f", {state.found} of {state.find} tags"
    return f"{state.elapsed:5.0f} s  {state.travelled:5.1f} m  {state.known:6.1f} m^2 known{tags}  {state.phase.value}"


@dataclass(frozen=True, slots=True)
class ExplorationSummary:
    """Figures of one exploration."""

    end: TaskEnd[ExplorationState]
    distance: float
    """True distance travelled (m)."""
    home_error: float
    """True distance from the start at the end (m)."""
    collided: bool
    messages: dict[str, int]
    """Number of messages by topic."""
    log_bytes: int
    files: tuple[Path, ...]
    """Map, report and logs."""

    @property
    def outcome(self) -> Reason:
        """Reason of its end."""
        return self.end.reason

    @property
    def text(self) -> str:
        """The explorer's description of its end."""
        return self.end.text

    def rows(self) -> list[tuple[str, str]]:
        """Return name and value of every printed figure."""
        figures = self._figures()
        return [
            ("outcome", self.end.text + (", COLLIDED" if self.collided else "")),
            ("time", f"{figures['elapsed']:.1f} s"),
            ("known area", f"{figures['known']:.1f} m^2"),
            ("tags found", f"{figures['found']}"),
            ("distance, true", f"{self.distance:.2f} m"),
            ("true error at home", f"{self.home_error * 100:.1f} cm"),
            ("messages", f"{sum(self.messages.values())} in {len(self.messages)} topics"),
            ("log size", f"{self.log_bytes / 1e6:.2f} MB, compressed"),
            *(("file", str(file)) for file in self.files),
        ]

    def _figures(self) -> dict[str, float]:
        """Figures of the last report; 0 without one."""
        names = ("elapsed", "travelled", "known", "found")
        return {name: 0.0 if self.end.state is None else getattr(self.end.state, name) for name in names}

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "outcome": self.end.reason.value,
            "text": self.end.text,
            **self._figures(),
            "distance_m": self.distance,
            "home_error_m": self.home_error,
            "collided": self.collided,
            "messages": self.messages,
            "log_bytes": self.log_bytes,
            "files": [str(file) for file in self.files],
        }


def summarised(end: TaskEnd[ExplorationState], truth: Array, folder: Path) -> ExplorationSummary:
    """Return the figures of a run with its log in ``folder``, and write its report there; blocks for seconds.

    Args:
        end: end of the exploration.
        truth: shape (n, 6), as ``TruthLog.COLUMNS``.
        folder: contains ``logs``, and the saved map in ``explored``.
    """
    messages, size, logs = log_figures(folder)
    page = report(logs[0], folder / "report.html", None).file
    pictures = tuple(sorted((folder / "explored").rglob("*.png")))
    return ExplorationSummary(
        end,
        float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum()),
        float(np.hypot(*(truth[-1, 1:3] - truth[0, 1:3]))),
        bool(truth[:, 5].any()),
        messages,
        size,
        (*pictures, page, *logs),
    )
