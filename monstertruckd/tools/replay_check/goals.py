"""Reads the record of goals from a log before its replay: ticks of the goal service, remote calls, and paths found.

The record is incomplete: most ticks publish nothing, and remote calls are not recorded. Results of the workers are
inferred from the paths that were driven, decisions and calls from the reports on goals.
"""

import itertools
import re
from bisect import bisect_right
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from monstertruck_planners.goals.path_publisher import SOURCE
from monstertruck_planners.goals.service import REPORT
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import TruckError
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalPhase, GoalState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, GoalControl, GoalOrder, GoalRequest, Role
from monstertruck_schemas.state import GateState
from monstertruckd.recorder.reader import LogMessage

ASKED: Final = frozenset({topics.REQ_GOAL.name, topics.REQ_GOAL_CONTROL.name})
CANCELLED_BY: Final = "cancelled by "

PLANNED: Final = r"goal-\d+\.\d+"
DEFORMED: Final = r"goal-\d+-(deformed|held-up)\.\d+"
TOGETHER: Final = SECOND // 50
"""Outputs of one tick have stamps this near to each other, ns."""


@dataclass(frozen=True, slots=True)
class RecordedCall:
    """A remote call, inferred from the report on the goal."""

    source: str
    frame: str
    what: Pose2D | GoalOrder
    """The goal, or an order about it."""

    def request(self, gate: GateState, stamp: int, seq: int) -> GoalRequest | GoalControl:
        """Return the request behind a report, without unreported fields, with the rights it must have had."""
        header: dict[str, Any] = {
            "stamp": stamp,
            "received": stamp,
            "seq": seq,
            "frame": self.frame,
            "source": self.source,
            "role": Role.STATION,
            "lease": 1.0,  # s
            "nonce": gate.nonce,
            "gate_stamp": gate.stamp,
        }
        if isinstance(self.what, GoalOrder):
            return GoalControl(**header, order=self.what)
        return GoalRequest(**header, goal=self.what)


@dataclass(frozen=True, slots=True)
class GoalReport:
    """A report on the goal, with its position in the log."""

    sequence: int
    state: GoalState


@dataclass(slots=True)
class GoalRecord:
    """Remote calls of one log."""

    reports: list[GoalReport] = field(default_factory=list)
    paths: list[Path] = field(default_factory=list)
    planner_requests: list[int] = field(default_factory=list)
    """Stamps of requests to stand still, ns."""
    asked: list[int] = field(default_factory=list)
    """When requests came by topic, ns."""
    replayed: int = -1
    """Number of the latest report that the replay has reached."""

    def note(self, entry: LogMessage) -> None:
        """Process a message of the log."""
        if entry.topic in ASKED:
            self.asked.append(entry.log_time)
            return
        with suppress(TruckError):
            match entry.topic:
                case topics.GOAL.name:
                    self._add_report(entry)
                case topics.PATH.name:
                    path = entry.decode()
                    assert isinstance(path, Path)
                    self.paths.append(path)
                case topics.PLAN_DRIVE.name if self.reports and asks_standstill(entry):
                    self.planner_requests.append(entry.stamp)

    def _add_report(self, entry: LogMessage) -> None:
        state = entry.decode()
        assert isinstance(state, GoalState)
        self.reports.append(GoalReport(entry.sequence, state))

    @property
    def start(self) -> int | None:
        """Time of the service's first report, ns; None in a log without goals."""
        return self.reports[0].state.stamp if self.reports else None

    def ticks(self, period: int) -> list[int]:
        """Return the times of visible ticks: the earliest stamp of each one's outputs."""
        calls = self.calls(period)
        stamps = [one.state.stamp for one in self.reports if one.sequence not in calls] + self.planner_requests
        shown: list[int] = []
        for stamp in sorted(stamps):
            if not shown or stamp - shown[-1] > TOGETHER:
                shown.append(stamp)
        own = [path.stamp for path in self.paths if re.fullmatch(DEFORMED, path.name) is None]
        return [min((stamp for stamp in own if 0 <= tick - stamp <= TOGETHER), default=tick) for tick in shown]

    def unseen_ticks(self, period: int) -> list[int]:
        """Return the times of the ticks between them that published nothing while a goal was pursued."""
        stamps = [one.state.stamp for one in self.reports]
        found: list[int] = []
        for before, after in itertools.pairwise(self.ticks(period)):
            for number in range(round((after - before) / period) - 1, 0, -1):
                instant = after - number * period
                newest = self.reports[bisect_right(stamps, instant) - 1].state
                if newest.phase is not GoalPhase.IDLE:
                    found.append(min(instant, newest.stamp + REPORT - 1))
        return found

    def calls(self, period: int) -> dict[int, RecordedCall]:
        """Return requests by remote call, by the number of the report that shows them.

        Requests by topic are in the log itself, and show within two ticks.
        """
        found: dict[int, RecordedCall] = {}
        for before, after in itertools.pairwise(self.reports):
            stamp = after.state.stamp
            if any(0 <= stamp - asked <= 2 * period for asked in self.asked):
                continue
            if (call := _call(before.state, after.state)) is not None:
                found[after.sequence] = call
        return found

    def unknown_waypoints(self, period: int) -> bool:
        """Return whether a remote call had waypoints: reports give only their number."""
        goals = {number for number, call in self.calls(period).items() if isinstance(call.what, Pose2D)}
        return any(one.sequence in goals and one.state.waypoints for one in self.reports)

    def decided(self) -> int | None:
        """Return the time of the route planner's answer to a request made now, ns; None if it was dropped.

        Reports of the tick that made the request are stamped later than its first output.
        """
        for before, after in itertools.pairwise(self.reports):
            if after.sequence > self.replayed and _answered(before.state, after.state):
                return after.state.stamp
        return None

    def path_between(self, begin: int, end: int, name: str) -> Path | None:
        """Return the first path published after ``begin`` and until ``end``, ns, whose name matches the pattern."""
        found = (path for path in self.paths if begin < path.stamp <= end)
        return next((path for path in found if re.fullmatch(name, path.name)), None)


def asks_standstill(entry: LogMessage) -> bool:
    """Return whether the goal service made a drive request, not the tracker."""
    request = entry.decode()
    return isinstance(request, DriveRequest) and request.source == SOURCE


def is_deformed(entry: LogMessage) -> bool:
    """Return whether a path came from deformation rather than from a tick of the goal service."""
    path = entry.decode()
    return isinstance(path, Path) and re.fullmatch(DEFORMED, path.name) is not None


def _answered(before: GoalState, after: GoalState) -> bool:
    decided = ("phase", "routes", "recoveries", "outcome")
    same = all(getattr(before, name) == getattr(after, name) for name in decided)
    return before.phase is GoalPhase.PLANNING and before.number == after.number and not same


def _call(before: GoalState, after: GoalState) -> RecordedCall | None:
    if after.number != before.number and after.goal is not None:
        return RecordedCall(after.source, after.frame, after.goal)
    if before.phase is after.phase:
        return None
    if before.phase is GoalPhase.PAUSED and after.phase is GoalPhase.PLANNING:
        return RecordedCall(after.source, after.frame, GoalOrder.RESUME)
    if after.phase is GoalPhase.PAUSED:
        return RecordedCall(after.source, after.frame, GoalOrder.PAUSE)
    if after.outcome is Reason.CANCELLED and after.text.startswith(CANCELLED_BY):
        return RecordedCall(after.text.removeprefix(CANCELLED_BY), after.frame, GoalOrder.CANCEL)
    return None
