"""Checks that the body does what is commanded: steering by the compass, driven shafts by their feedback.

``SteeringCheck`` finds servos without supply. Hobby servos report nothing, and a servo controller on USB power keeps
answering when the servos' own supply is lost; but then the compass heading departs from the one that follows from
speed and commanded axle angles. ``ShaftCheck`` finds a shaft that is blocked.
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
    """Compares commands with measurements; ``contradicts`` stays until ``reset``."""

    @property
    def contradicts(self) -> bool:
        """Whether the measurements contradict the commands."""

    def reset(self) -> None:
        """Start over."""


C = TypeVar("C", bound=Comparison)


class FollowingCheck(Check, Generic[C]):
    """One reason as long as a comparison contradicts.

    Args:
        view: what it may look at.
        comparison: of commands and measurements.
    """

    def __init__(self, view: GateView, comparison: C) -> None:
        super().__init__(view)
        self._comparison = comparison

    def reason(self, now: int) -> Iterator[Reason]:
        """A contradiction since the robot was armed."""
        if self._comparison.contradicts:
            yield from self.reasons

    def reset(self) -> None:
        """Only driving can show whether it works again."""
        self._comparison.reset()


class SteeringCheck(FollowingCheck["TurnComparison"]):
    """The compass contradicts wheels and steering: the servos do not follow their commands.

    Args:
        view: what it may look at.
        config: window and tolerance.
    """

    reasons = (Reason.STEERING_DEAD,)

    def __init__(self, view: GateView, config: SteeringCheckConfig) -> None:
        super().__init__(view, TurnComparison(config))

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Compare a heading with what wheels and steering say at that time."""
        if not isinstance(seen, Attitude):
            return
        now, samples = seen.received, self.view.samples
        trusted = seen.tilt_valid and not seen.heading_disturbed and samples.steering_fresh(now)
        heading = seen.heading if trusted and self.view.mode.active else None
        self._comparison.observe(seen.stamp, heading, samples.speed(now), samples.turn_rate(now))

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Difference of the turns."""
        turns = self._comparison
        yield Measurement(name="yaw difference", value=turns.difference, unit="rad", limit=turns.config.tolerance)


class ShaftCheck(FollowingCheck["ShaftComparison"]):
    """A driven shaft does not turn although it is commanded to.

    Args:
        view: what it may look at.
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
        """Current of its motor."""
        yield Measurement(name="motor current", value=self._comparison.current, unit="A")


class TurnComparison:
    """Compares the turn commanded with the turn measured over a sliding window; ``contradicts`` stays until ``reset``.

    Args:
        config: window and tolerance.
    """

    def __init__(self, config: SteeringCheckConfig) -> None:
        self.config = config
        self._window: deque[tuple[int, float, float]] = deque()
        """(ns, turn by the commands, turn by the compass) since a common origin, rad, left positive."""
        self._heading = 0.0
        self.contradicts = False
        """The steering does not follow its commands."""
        self.difference = 0.0
        """Turn measured less turn commanded over the window, rad."""

    def reset(self) -> None:
        """Start over."""
        self._window.clear()
        self.contradicts = False
        self.difference = 0.0

    def observe(self, stamp: int, heading: float | None, speed: float | None, rate: float) -> None:
        """Take a heading, and what wheels and steering say at that time.

        Args:
            stamp: of the measurement, ns.
            heading: clockwise, rad; None = the compass is disturbed.
            speed: of the wheels over ground, m/s; None = not known.
            rate: yaw rate that follows from the wheels' speeds and the commanded steering angles, rad/s, left positive.
        """
        if heading is None or speed is None or abs(speed) < self.config.speed:
            self._window.clear()
            return
        gap = SECOND // 2  # headings further apart than this are not compared, ns
        if not self._window or stamp - self._window[-1][0] > gap:
            self._begin(stamp, heading)
            return
        before, commanded, measured = self._window[-1]
        dt = (stamp - before) / SECOND
        turned = -math.remainder(heading - self._heading, 2 * math.pi)
        jump = 1.5  # a heading that changes faster than this, rad/s, is a disturbed compass, not a turn
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
    """Compares each driven shaft's speed with its command; ``blocked`` stays until ``reset``.

    A blocked shaft draws current up to the controller's limit and heats motor and clutch, and the controller reports
    no fault.

    Args:
        config: time and tolerance.
    """

    def __init__(self, config: ShaftCheckConfig) -> None:
        self._config = config
        self._since: dict[tuple[int, bool], int] = {}
        """Since when each shaft has not turned, and its controller been enabled or not, ns."""
        self._current: dict[int, float] = {}
        """Newest measured current of each, A."""
        self.blocked: int | None = None
        """The shaft that does not turn."""

    @property
    def contradicts(self) -> bool:
        """Whether a shaft is blocked."""
        return self.blocked is not None

    def reset(self) -> None:
        """Start over."""
        self._since.clear()
        self.blocked = None

    def observe(self, feedback: DriveFeedback, shaft: int, commanded: float, measured: float) -> None:
        """Take feedback of a shaft.

        Args:
            feedback: the message.
            shaft: which.
            commanded: wheel speed over ground, m/s.
            measured: same.
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
        # Seconds in which a drive controller that is commanded to turn its shaft is enabled: it takes 0.6.
        enabled_within = 1.5
        within = limits.within if enabled else enabled_within
        if self.blocked is None and feedback.received - since >= within * SECOND:
            self.blocked = shaft

    @property
    def current(self) -> float | None:
        """Newest measured current of the blocked shaft, A."""
        return None if self.blocked is None else self._current.get(self.blocked)
