"""Interface of the gate's checks. A check is one rule; it can only slow the robot or keep it at rest.

The gate keeps an ordered list of checks, worst reasons first. Every check observes all messages received by the gate
and every tick (``observe``). At each tick the gate asks the check why the robot may not move at all (``reason``) and
how fast it may go along the requested and commanded motions (``limit``); ``describe`` explains a reason with its
measurements. The gate combines the union of all reasons and the minimum of all limits, so an additional check can only
make the gate stricter.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, points_relative
from monstertruck_planners.collision import Footprint
from monstertruck_runtime.requests import OPERATORS
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.arbitration import GateStateMachine
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import Course, Motion
from monstertruckd.gate.samples import Samples

GATE: Final = ServiceName.GATE.value
"""Source of causes known only to the gate."""


class Tick(NamedTuple):
    """Start of a tick of the gate; checks observe it like a message."""

    now: int
    """Time of the tick, ns."""
    elapsed: float
    """Time since the previous tick, ns."""


class PaceLimit(NamedTuple):
    """A speed limit with its reason."""

    reason: Reason
    pace: float
    """Maximum pace, m/s; 0: the robot stands while its driver stays in control."""


class DockArea(NamedTuple):
    """Area in front of a dock, in the base frame at the time of the latest scan."""

    docked: Pose2
    """Pose of the docked robot, turned so that its x axis leads into the dock."""
    corridor: tuple[float, float, float]
    """Ground on the axis of the dock: first and last x and the greatest distance from the axis, relative to ``docked``
    (m)."""
    housing: tuple[float, float, float] | None
    """Part of the dock that the lidar sees: first and last x and half its width, relative to ``docked`` (m); None
    without one."""

    def outside(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (m, base frame, shape (n, 2)) is outside the housing."""
        return np.ones(len(points), np.bool_) if self.housing is None else ~self._within(self.housing, points)

    def on_axis(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (m, base frame, shape (n, 2)) lies in the corridor."""
        return self._within(self.corridor, points)

    def _within(self, box: tuple[float, float, float], points: Array) -> NDArray[np.bool_]:
        first, last, half = box
        x, y = points_relative(points, self.docked).T
        return np.asarray((x >= first) & (x <= last) & (np.abs(y) <= half))


class GateView:
    """Read access for checks: limits, latest samples, commanded motion and mode of the gate.

    Args:
        limits: limits in force.
        chassis: kinematics of the body.
        footprint: the body's outline.
        samples: latest valid sample of every sensor.
        motion: commanded motion.
        states: the gate's state machine.
    """

    def __init__(
        self,
        limits: InForce,
        chassis: Chassis,
        footprint: Footprint,
        samples: Samples,
        motion: Motion,
        states: GateStateMachine,
    ) -> None:
        self.limits = limits
        self.chassis = chassis
        self.footprint = footprint
        self.samples = samples
        self.motion = motion
        self._states = states
        self.dock: DockArea | None = None
        """Dock that a behaviour approaches or leaves and that is near, as ``DockCheck`` finds at every tick."""

    @property
    def config(self) -> GateConfig:
        """Limits in force."""
        return self.limits.config

    @property
    def mode(self) -> GateMode:
        """Current mode."""
        return self._states.mode

    @property
    def calibrates(self) -> bool:
        """Whether an operator has armed the robot to calibrate sensors on ground that is kept clear."""
        return self._states.calibrates

    @property
    def planner(self) -> str | None:
        """The robot's planner that is driving; None if no planner drives."""
        holder = self._states.holder
        return holder.request.source if holder is not None and holder.inside else None

    @property
    def operated(self) -> bool:
        """Whether an operator drives."""
        holder = self._states.holder
        return holder is not None and not holder.inside and holder.request.role in OPERATORS

    @property
    def confirmed(self) -> bool:
        """Whether the driving operator holds the second control, to drive into unseen ground."""
        holder = self._states.holder
        return self.operated and holder is not None and holder.request.unseen


class Check:
    """One rule of the gate; a subclass overrides the methods it needs.

    Args:
        view: read access to the gate's state.
    """

    reasons: tuple[Reason, ...] = ()
    """Reasons that the check may give."""
    reads: tuple[Topic[Any], ...] = ()
    """Topics needed in addition to the topics always read by the gate."""

    def __init__(self, view: GateView) -> None:
        self.view = view

    @property
    def urgent(self) -> bool:
        """Whether only a quick stop can avoid contact."""
        return False

    @property
    def moves(self) -> bool:
        """Whether a motor moves the robot, even if the drives' velocities do not show it."""
        return False

    @property
    def findings(self) -> int:
        """Number of motions so far that required an emergency stop."""
        return 0

    @property
    def power_off(self) -> bool:
        """Whether the robot can be stopped only by switching off its power stages."""
        return False

    @property
    def port_off(self) -> bool:
        """Whether the robot can be stopped only by switching off the drives' ports."""
        return False

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process a message or the start of a tick; ``view.samples`` already holds the message if it is valid.

        Args:
            seen: message or tick.
            topic: topic of the message; None for a tick.
        """

    def reason(self, now: int) -> Iterable[Reason]:
        """Return why the robot may not move at ``now`` (ns), worst first; called at ticks and for orders."""
        return ()

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterable[PaceLimit]:
        """Speed limits at a tick.

        Args:
            now: current time (ns).
            courses: requested and commanded motions; empty at standstill, None if no source drives.
        """
        return ()

    def text(self, reason: Reason) -> str:
        """Text of a reason of this check, for its event."""
        return reason.text

    def figures(self, reason: Reason, now: int) -> Iterable[Measurement]:
        """Measurements behind a reason of this check."""
        return ()

    def describe(self, reason: Reason, now: int, since: int) -> Iterable[Cause]:
        """Causes of a stop for a reason of this check."""
        yield Cause(
            reason=reason,
            source=GATE,
            since=since,
            text=self.text(reason),
            measurements=tuple(self.figures(reason, now)),
        )

    def reset(self) -> None:
        """Clear a finding that stays until the gate disarms."""


class Checks:
    """Ordered list of the gate's checks: union of their reasons, minimum of their limits.

    Args:
        checks: checks, worst reasons first.
    """

    def __init__(self, checks: Iterable[Check]) -> None:
        self._checks = tuple(checks)
        self._givers: dict[Reason, Check] = {}
        """Check that gave each reason most recently; initially the first check that may give it."""
        for check in self._checks:
            for reason in check.reasons:
                self._givers.setdefault(reason, check)

    def __iter__(self) -> Iterator[Check]:
        return iter(self._checks)

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Pass a message or the start of a tick to every check; see ``Check.observe``."""
        for check in self._checks:
            check.observe(seen, topic)

    def blocks(self, now: int) -> tuple[Reason, ...]:
        """Reasons why the robot may not move at ``now`` (ns), worst first."""
        found: dict[Reason, Check] = {}
        for check in self._checks:
            for reason in check.reason(now):
                found.setdefault(reason, check)
        self._givers |= found
        return tuple(found)

    def limits(self, now: int, courses: Sequence[Course] | None) -> dict[Reason, float]:
        """Minimum pace limit for each reason, m/s; for the arguments see ``Check.limit``."""
        found: dict[Reason, float] = {}
        for check in self._checks:
            for reason, pace in check.limit(now, courses):
                allowed = pace if pace > 0 else 0.0  # also replaces NaN
                if allowed < found.get(reason, math.inf):
                    found[reason] = allowed
                    self._givers[reason] = check
        return found

    @property
    def reads(self) -> tuple[Topic[Any], ...]:
        """Topics needed by the checks in addition to the topics always read by the gate."""
        return tuple(dict.fromkeys(topic for check in self._checks for topic in check.reads))

    @property
    def urgent(self) -> bool:
        """Whether only a quick stop avoids contact."""
        return any(check.urgent for check in self._checks)

    @property
    def moves(self) -> bool:
        """Whether a motor moves the robot."""
        return any(check.moves for check in self._checks)

    @property
    def findings(self) -> int:
        """Motions so far that demanded an emergency stop."""
        return sum(check.findings for check in self._checks)

    @property
    def power_off(self) -> bool:
        """Whether the power stages must be off."""
        return any(check.power_off for check in self._checks)

    @property
    def port_off(self) -> bool:
        """Whether the drives' ports must be off."""
        return any(check.port_off for check in self._checks)

    def text(self, reason: Reason) -> str:
        """Wording of a reason, for its event."""
        giver = self._givers.get(reason)
        return reason.text if giver is None else giver.text(reason)

    def describe(self, reasons: Iterable[Reason], now: int, since: Mapping[Reason, int]) -> list[Cause]:
        """Causes of a stop, with text and measurements.

        Args:
            reasons: reasons, worst first.
            now: current time (ns).
            since: time when the gate first saw each reason (ns).
        """
        causes: list[Cause] = []
        for reason in reasons:
            giver, began = self._givers.get(reason), since.get(reason, now)
            if giver is None:
                causes.append(Cause(reason=reason, source=GATE, since=began, text=reason.text))
            else:
                causes += giver.describe(reason, now, began)
        return causes

    def reset(self) -> None:
        """Clear findings that persist until the gate disarms."""
        for check in self._checks:
            check.reset()
