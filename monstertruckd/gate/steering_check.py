"""Does the truck turn as it is steered? Hobby servos report nothing, so only the yaw tells that they are dead.

A servo controller on USB power goes on answering when the servos' own supply is lost. What betrays it is the compass:
the heading it measures parts from the one that speed and commanded axle angles amount to.
"""

import math
from collections import deque
from typing import Annotated, Final

from pydantic import Field

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Schema

Positive = Annotated[float, Field(gt=0)]

JUMP: Final = 1.5
"""A heading that changes faster than this, rad/s, is a disturbed compass, not a turn."""
GAP: Final = SECOND // 2
"""Headings further apart than this are not compared, ns."""


class SteeringCheckConfig(Schema):
    """When the truck's yaw contradicts its steering."""

    window: Positive = 2.0
    """Seconds over which turns are compared."""
    tolerance: Positive = 0.14
    """Difference that proves nothing: compass errors and the servos' lag, rad."""
    speed: Positive = 0.03
    """Slower, nothing is compared: somebody may be turning the truck by hand, m/s."""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.3
    """The same as a share of the larger turn: tyre slip and calibration."""


class SteeringCheck:
    """Compares the turn commanded with the turn measured over a sliding window; ``dead`` stays until ``reset``.

    Args:
        config: window and tolerance.
        steering: the truck's geometry.
    """

    def __init__(self, config: SteeringCheckConfig, steering: FourWheelSteering) -> None:
        self._config = config
        self._steering = steering
        self._rows: deque[tuple[int, float, float]] = deque()
        """(ns, turned by the commands, turned by the compass) since some origin, rad, left positive."""
        self._heading = 0.0
        self.dead = False
        """The steering does not do what it is told."""
        self.difference = 0.0
        """Turn measured less turn commanded over the window, rad."""

    def reset(self) -> None:
        """Forget everything: somebody has looked."""
        self._rows.clear()
        self.dead = False
        self.difference = 0.0

    def observe(self, stamp: int, heading: float | None, speed: float | None, front: float, rear: float) -> None:
        """Take a heading and what the truck did when it was measured.

        Args:
            stamp: of the measurement, ns.
            heading: clockwise, rad; None where the compass is disturbed.
            speed: of the wheels over ground, m/s; None where it is not known.
            front: commanded axle angle, rad.
            rear: the same behind.
        """
        if heading is None or speed is None or abs(speed) < self._config.speed:
            self._rows.clear()
            return
        if not self._rows or not 0 < stamp - self._rows[-1][0] <= GAP:
            self._begin(stamp, heading)
            return
        before, commanded, measured = self._rows[-1]
        dt = (stamp - before) / SECOND
        turned = -math.remainder(heading - self._heading, 2 * math.pi)
        if abs(turned) > JUMP * dt:
            self._begin(stamp, heading)
            return
        body_speed = speed / self._steering.drive_speed(1.0, front, rear)
        commanded += self._steering.body_twist(body_speed, front, rear)[2] * dt
        self._rows.append((stamp, commanded, measured + turned))
        self._heading = heading
        while self._rows[-1][0] - self._rows[0][0] > self._config.window * SECOND:
            self._rows.popleft()
        self._judge()

    def _begin(self, stamp: int, heading: float) -> None:
        self._rows.clear()
        self._rows.append((stamp, 0.0, 0.0))
        self._heading = heading

    def _judge(self) -> None:
        _, commanded_then, measured_then = self._rows[0]
        _, commanded_now, measured_now = self._rows[-1]
        commanded, measured = commanded_now - commanded_then, measured_now - measured_then
        self.difference = measured - commanded
        allowed = self._config.tolerance + self._config.share * max(abs(commanded), abs(measured))
        self.dead |= abs(self.difference) > allowed
