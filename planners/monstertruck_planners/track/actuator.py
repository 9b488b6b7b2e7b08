"""What the axles are about to do: dead time, first-order lag and greatest rate between a request and the wheels.

Servos report what they are told, not where they are; so the trackers compute where they are.
"""

import math
from collections import deque
from typing import Final

from monstertruck_kinematics.truck import FourWheelSteering

LONGEST: Final = 0.05
"""Of the steps the future is computed in, s."""
FORGET: Final = 1.0
"""After a pause of this length nothing is known of the axles, s."""

Angles = tuple[float, float]
Pose = tuple[float, float, float]


class Axles:
    """Both axles' present angles, from the requests.

    Args:
        dead_time: s.
        lag: time constant, s; 0: none.
        rate: greatest turning rate, rad/s.
    """

    def __init__(self, dead_time: float, lag: float, rate: float) -> None:
        self.dead_time = dead_time
        self.lag = lag
        self.rate = rate
        self.reset()

    def reset(self) -> None:
        """Forget all requests."""
        self.angles: Angles = (0.0, 0.0)
        self.asked: Angles = (0.0, 0.0)
        """By the newest request."""
        self._due: deque[tuple[float, Angles]] = deque()
        self._target: Angles = (0.0, 0.0)
        self._t: float | None = None

    def ask(self, t: float, angles: Angles) -> None:
        """Note a request made at ``t``."""
        self.asked = angles
        self._due.append((t + self.dead_time, angles))

    def advance(self, t: float) -> None:
        """Bring the angles to the time ``t``."""
        if self._t is None or not 0.0 <= t - self._t <= FORGET:
            asked = self.asked
            self.reset()
            self.angles = self._target = self.asked = asked
            self._t = t
            return
        for _, until, target in self._pieces(self._t, t):
            self.angles = self._turned(self.angles, target, until)
            self._target = target
        while self._due and self._due[0][0] <= t:
            self._target = self._due.popleft()[1]
        self._t = t

    def ahead(self, pose: Pose, speed: float, geometry: FourWheelSteering, seconds: float) -> tuple[Pose, Angles]:
        """Pose and angles in ``seconds``, at a constant speed and if nothing else is asked for."""
        angles = self.angles
        begin = self._t or 0.0
        for _, duration, target in self._pieces(begin, begin + seconds):
            count = max(math.ceil(duration / LONGEST), 1)
            for _ in range(count):
                middle = self._turned(angles, target, 0.5 * duration / count)
                pose = geometry.integrate(pose, *geometry.body_twist(speed, *middle), duration / count)
                angles = self._turned(angles, target, duration / count)
        return pose, angles

    def _pieces(self, begin: float, end: float) -> list[tuple[float, float, Angles]]:
        """Times in which the axles turn to one target: when, how long, which."""
        pieces = []
        target, at = self._target, begin
        for due, angles in self._due:
            if due >= end:
                break
            if due > at:
                pieces.append((at, due - at, target))
                at = due
            target = angles
        if end > at:
            pieces.append((at, end - at, target))
        return pieces

    def _turned(self, angles: Angles, target: Angles, dt: float) -> Angles:
        return self._one(angles[0], target[0], dt), self._one(angles[1], target[1], dt)

    def _one(self, angle: float, target: float, dt: float) -> float:
        """First-order lag with a limited rate, exactly."""
        gap = target - angle
        linear = self.rate * self.lag
        if abs(gap) > linear:
            # At full rate until the lag alone would be slower.
            ramp = min(dt, (abs(gap) - linear) / self.rate)
            angle += math.copysign(self.rate * ramp, gap)
            gap, dt = target - angle, dt - ramp
        if dt <= 0.0:
            return angle
        return target if self.lag == 0.0 else target - gap * math.exp(-dt / self.lag)
