"""Checks that the body follows its commands: the compass checks the steering, feedback checks the driven shafts.

``SteeringCheck`` detects servos without power. Hobby servos report nothing, and a servo controller on USB power keeps
answering when the servos lose their separate supply. But then the compass heading departs from the heading computed
from speed and commanded axle angles. ``ShaftCheck`` detects a blocked shaft.
"""

import math
from collections import deque
from collections.abc import Iterator
from typing import Any, Generic, Protocol, TypeVar

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode
from monstertruck_schemas.topics import DRIVES, Topic
from monstertruckd.gate.checks import Check, GateView, Tick
from monstertruckd.gate.config import ShaftCheckConfig, SteeringCheckConfig


class Comparison(Protocol):
    """Compares commands with measurements; ``contradicts`` stays true until ``reset``."""

    @property
    def contradicts(self) -> bool:
        """Whether the measurements contradict the commands."""

    def reset(self) -> None:
        """Restart the comparison."""


C = TypeVar("C", bound=Comparison)


class FollowingCheck(Check, Generic[C]):
    """Reports one reason while a comparison shows a contradiction.

    Args:
        view: read access to the gate's state.
        comparison: comparison of commands and measurements.
    """

    def __init__(self, view: GateView, comparison: C) -> None:
        super().__init__(view)
        self._comparison = comparison

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a contradiction found since the robot was armed."""
        if self._comparison.contradicts:
            yield from self.reasons

    def reset(self) -> None:
        """Clear the contradiction: only driving can show whether the hardware works again."""
        self._comparison.reset()


class SteeringCheck(FollowingCheck["TurnComparison"]):
    """Detects servos that do not follow their commands: the compass contradicts the wheels and the steering.

    Args:
        view: read access to the gate's state.
        config: window and tolerance.
    """

    reasons = (Reason.STEERING_DEAD,)

    def __init__(self, view: GateView, config: SteeringCheckConfig) -> None:
        super().__init__(view, TurnComparison(config))

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Compare a heading with the wheels and the steering at the same time."""
        if not isinstance(seen, Attitude):
            return
        now, samples = seen.received, self.view.samples
        trusted = seen.tilt_valid and not seen.heading_disturbed and samples.steering_fresh(now)
        heading = seen.heading if trusted and self.view.mode.active else None
        self._comparison.observe(seen.stamp, heading, samples.speed(now), samples.turn_rate(now))

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Difference between the commanded and the measured turn."""
        turns = self._comparison
        yield Measurement(name="yaw difference", value=turns.difference, unit="rad", limit=turns.config.tolerance)


class ShaftCheck(FollowingCheck["ShaftComparison"]):
    """Detects a driven shaft that does not turn when commanded.

    Args:
        view: read access to the gate's state.
        config: time and tolerance.
    """

    reasons = (Reason.SHAFT_BLOCKED,)

    def __init__(self, view: GateView, config: ShaftCheckConfig) -> None:
        super().__init__(view, ShaftComparison(config))

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Compare a shaft's speed with its command."""
        if isinstance(seen, DriveFeedback) and topic is not None:
            shaft = DRIVES.index(topic)
            measured = self.view.chassis.drivetrain.speed(seen.velocity)
            self._comparison.observe(seen, shaft, self.view.motion.shaft_speeds[shaft], measured)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Motor current of the blocked shaft."""
        yield Measurement(name="motor current", value=self._comparison.current, unit="A")


class TurnComparison:
    """Compares the commanded and the measured turn over a sliding window; ``contradicts`` stays true until ``reset``.

    Args:
        config: window and tolerance.
    """

    def __init__(self, config: SteeringCheckConfig) -> None:
        self.config = config
        self._window: deque[tuple[int, float, float]] = deque()
        """Samples (stamp in ns, commanded turn, measured turn) since a common origin, rad, left positive."""
        self._heading = 0.0
        self.contradicts = False
        """Whether the steering does not follow its commands."""
        self.difference = 0.0
        """Measured minus commanded turn over the window, rad."""

    def reset(self) -> None:
        """Restart the comparison."""
        self._window.clear()
        self.contradicts = False
        self.difference = 0.0

    def observe(self, stamp: int, heading: float | None, speed: float | None, rate: float) -> None:
        """Process a heading, together with the state of the wheels and the steering at that time.

        Args:
            stamp: time stamp of the measurement (ns).
            heading: compass heading, clockwise (rad); None if the compass is disturbed.
            speed: wheel speed over ground (m/s); None if unknown.
            rate: yaw rate computed from wheel speeds and commanded steering angles (rad/s), left positive.
        """
        if heading is None or speed is None or abs(speed) < self.config.speed:
            self._window.clear()
            return
        gap = SECOND // 2  # maximum time between compared headings, ns
        if not self._window or stamp - self._window[-1][0] > gap:
            self._begin(stamp, heading)
            return
        before, commanded, measured = self._window[-1]
        dt = (stamp - before) / SECOND
        turned = -math.remainder(heading - self._heading, 2 * math.pi)
        jump = 1.5  # a heading that changes faster than this is a compass disturbance, rad/s
        if abs(turned) > jump * dt:
            self._begin(stamp, heading)
            return
        commanded += rate * dt
        self._window.append((stamp, commanded, measured + turned))
        self._heading = heading
        while self._window[-1][0] - self._window[0][0] > self.config.window * SECOND:
            self._window.popleft()
        self._compare()

    def _begin(self, stamp: int, heading: float) -> None:
        self._window.clear()
        self._window.append((stamp, 0.0, 0.0))
        self._heading = heading

    def _compare(self) -> None:
        _, commanded_then, measured_then = self._window[0]
        _, commanded_now, measured_now = self._window[-1]
        commanded, measured = commanded_now - commanded_then, measured_now - measured_then
        self.difference = measured - commanded
        allowed = self.config.tolerance + self.config.share * max(abs(commanded), abs(measured))
        self.contradicts |= abs(self.difference) > allowed


class ShaftComparison:
    """Compares each driven shaft's speed with its command; ``blocked`` stays set until ``reset``.

    A blocked shaft draws current up to the controller's limit and heats the motor and the clutch; the controller
    reports no fault.

    Args:
        config: time and tolerance.
    """

    def __init__(self, config: ShaftCheckConfig) -> None:
        self._config = config
        self._since: dict[tuple[int, bool], int] = {}
        """Time since when each shaft has not turned, by shaft and whether its controller is enabled, ns."""
        self._current: dict[int, float] = {}
        """Latest measured current of each shaft, A."""
        self.blocked: int | None = None
        """Index of the shaft that does not turn; None if all turn."""

    @property
    def contradicts(self) -> bool:
        """Whether a shaft is blocked."""
        return self.blocked is not None

    def reset(self) -> None:
        """Restart the comparison."""
        self._since.clear()
        self.blocked = None

    def observe(self, feedback: DriveFeedback, shaft: int, commanded: float, measured: float) -> None:
        """Process feedback from a shaft.

        Args:
            feedback: feedback message.
            shaft: index of the shaft.
            commanded: commanded wheel speed over ground (m/s).
            measured: measured wheel speed over ground (m/s).
        """
        if feedback.current is not None:
            self._current[shaft] = feedback.current
        limits = self._config
        enabled = feedback.mode is DriveMode.ENABLED
        self._since.pop((shaft, not enabled), None)
        asked = feedback.mode is not DriveMode.FAULT and abs(commanded) >= limits.speed
        if not asked or measured * math.copysign(1.0, commanded) >= limits.share * abs(commanded):
            self._since.pop((shaft, enabled), None)
            return
        since = self._since.setdefault((shaft, enabled), feedback.received)
        # Maximum time for a drive controller to become enabled after a command to turn, s: it takes 0.6 s.
        enabled_within = 1.5
        within = limits.within if enabled else enabled_within
        if self.blocked is None and feedback.received - since >= within * SECOND:
            self.blocked = shaft

    @property
    def current(self) -> float | None:
        """Latest measured current of the blocked shaft (A)."""
        return None if self.blocked is None else self._current.get(self.blocked)
