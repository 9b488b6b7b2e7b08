"""The fuzzy tracker of rsband_local_planner: a sub-goal ahead on the path, rules, axle angles.

As published its direction comes from the sub-goal's bearing and changes at 120 degrees from cycle to cycle; corrected
it comes from the path, and the speed falls towards the end.
"""

import math
from typing import Final

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.actuator import Angles
from monstertruck_planners.track.config import FuzzyConfig
from monstertruck_planners.track.fuzzy_rules import Inputs, Outputs, Rules
from monstertruck_planners.track.law import Here, Law
from monstertruck_schemas.plan import Steering

BEHIND: Final = 120.0
"""Sub-goals at a greater bearing are driven to backward, as published, deg."""


class Fuzzy(Law[FuzzyConfig]):
    """See the module."""

    def __init__(self, config: FuzzyConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self._published = config.rules == "published"
        if not self._published:
            self.lead = config.dead_time + config.lag
        self._rules = Rules(config.near, config.lateral_tolerance, self._published)
        self._front = self._sideways = 0.0

    def reset(self) -> None:
        """See ``Tracker``."""
        super().reset()
        self._front = self._sideways = 0.0

    def steer(self, here: Here) -> Angles:
        """Axle angles; what no rule speaks of stays as it was."""
        outputs = self._infer(here)[0]
        self._front = self._front if outputs.front is None else outputs.front
        self._sideways = self._sideways if outputs.sideways is None else outputs.sideways
        angle = self.config.angle
        front, sideways = angle * self._front, angle * self._sideways
        rear = {"front": 0.0, "rear": -front, "counter": -front, "crab": sideways, "hybrid": sideways - front}
        return (0.0 if here.steering == "rear" else front), rear[here.steering]

    def limited(self, steering: Steering, front: float, rear: float) -> Angles:
        """Each axle by itself."""
        angle = self.config.angle
        return min(max(front, -angle), angle), min(max(rear, -angle), angle)

    def speed(self, here: Here) -> float:
        """Slow near the sub-goal, fast elsewhere."""
        outputs, direction = self._infer(here)
        share = 1.0 if outputs.speed is None else outputs.speed
        if self._published:
            return direction * share * self.config.speed
        most = share * (self.config.speed if direction > 0 else self.config.reverse_speed)
        return direction * min(abs(here.wanted), max(most, self.config.min_speed))

    def _infer(self, here: Here) -> tuple[Outputs, float]:
        """What the rules say, and the direction."""
        run, (x, y, yaw) = here.run, here.pose
        s = min(here.s + self.config.sub_goal, run.end)
        goal = run.at(s).point
        dx, dy = goal[0] - x, goal[1] - y
        ahead, aside = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        bearing = math.degrees(math.atan2(aside, ahead))
        orientation = math.degrees(math.remainder(here.course.spot(s).yaw - yaw, math.tau))
        direction = (1.0 if abs(bearing) < BEHIND else -1.0) if self._published else run.direction
        inputs = Inputs(bearing, orientation, math.hypot(dx, dy), aside, direction)
        return self._rules.infer(inputs), direction
