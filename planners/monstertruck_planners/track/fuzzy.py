"""Fuzzy tracker of rsband_local_planner: rules give axle angles from a sub-goal ahead on the path.

In the published version the direction depends on the sub-goal's bearing, and may change at 120 degrees from cycle to
cycle. In the corrected version it comes from the path, and the speed falls towards the end.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import FuzzyConfig
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState
from monstertruck_schemas.plan import Steering

Membership = Callable[[float], float]

SHARES: Final = {"RH": -1.0, "RL": -0.5, "Z": 0.0, "LL": 0.5, "LH": 1.0}
"""Steering terms as fractions of the maximum angle."""

FAR_TURNS: Final = {
    "RBL": "Z", "RL": "LH", "SL": "LH", "FL": "LL", "FA": "Z", "FR": "RL", "SR": "RH", "RR": "RH", "RBR": "Z",
}  # fmt: skip
"""Front steering by the bearing of a distant sub-goal."""
CLOSE_TURNS: Final = {"SL": "LH", "FL": "LL", "FA": "Z", "FR": "RL", "SR": "RH"}
"""Front steering by the orientation of a close sub-goal, driving forward; backward, left and right are swapped."""
OPPOSITE: Final = {"LH": "RH", "LL": "RL", "Z": "Z", "RL": "LL", "RH": "LH"}


def trapezoid(a: float, b: float, c: float, d: float) -> Membership:
    """Trapezoidal membership: 0 up to a, 1 from b to c, 0 from d on."""

    def membership(x: float) -> float:
        rising = 1.0 if x >= b else (x - a) / (b - a) if x > a else 0.0
        falling = 1.0 if x <= c else (d - x) / (d - c) if x < d else 0.0
        return min(rising, falling)

    return membership


BEARINGS: Final = {
    "RBR": trapezoid(-181, -180, -175, -165),
    "RR": trapezoid(-175, -165, -130, -120),
    "SR": trapezoid(-130, -120, -35, -25),
    "FR": trapezoid(-35, -25, -15, -5),
    "FA": trapezoid(-15, -5, 5, 15),
    "FL": trapezoid(5, 15, 25, 35),
    "SL": trapezoid(25, 35, 120, 130),
    "RL": trapezoid(120, 130, 165, 175),
    "RBL": trapezoid(165, 175, 180, 181),
}
PUBLISHED_ORIENTATIONS: Final = BEARINGS | {"FR": trapezoid(-40, -30, -15, -10)}


@dataclass(frozen=True, slots=True)
class FuzzyInputs:
    """Sub-goal as seen from the truck."""

    bearing: float
    """Bearing (deg)."""
    orientation: float
    """Orientation (deg)."""
    distance: float
    """Distance (m)."""
    aside: float
    """Distance to the left (m)."""
    direction: float
    """+1 forward, -1 backward."""


@dataclass(frozen=True, slots=True)
class FuzzyOutputs:
    """Fractions of the maximum values; None if no rule fired."""

    speed: float | None
    front: float | None
    sideways: float | None


@dataclass(frozen=True, slots=True)
class Rules:
    """A rule base.

    Args:
        near: maximum distance of a close sub-goal (m); from twice this distance it is far.
        tolerance: lateral deviation classified as small (m).
        published: use the published rules with their errors.
    """

    near: float
    tolerance: float
    published: bool

    def infer(self, inputs: FuzzyInputs) -> FuzzyOutputs:
        """Return the outputs of all rules."""
        far = min(max(inputs.distance / self.near - 1.0, 0.0), 1.0)
        close = 1.0 - far
        return FuzzyOutputs(
            speed=mean([(close, 0.5), (far, 1.0)]),
            front=mean(self._front(inputs, close, far)),
            sideways=mean(self._sideways(inputs)),
        )

    def _orientations(self) -> dict[str, Membership]:
        return PUBLISHED_ORIENTATIONS if self.published else BEARINGS

    def _front(self, inputs: FuzzyInputs, close: float, far: float) -> list[tuple[float, float]]:
        forward = min(max(0.5 + inputs.direction / 0.2, 0.0), 1.0)
        fired = [(min(far, BEARINGS[term](inputs.bearing)), SHARES[turn]) for term, turn in FAR_TURNS.items()]
        for term, turn in CLOSE_TURNS.items():
            fits = min(close, self._orientations()[term](inputs.orientation))
            fired.append((min(fits, forward), SHARES[turn]))
            if term != "FA" or not self.published:
                fired.append((min(fits, 1.0 - forward), SHARES[OPPOSITE[turn]]))
        return fired

    def _sideways(self, inputs: FuzzyInputs) -> list[tuple[float, float]]:
        orientation = self._orientations()
        front = max(orientation[term](inputs.orientation) for term in ("FA", "FL", "FR"))
        t = self.tolerance
        sign = 1.0 if self.published else inputs.direction
        small = {1.0: trapezoid(0, t, t, 2 * t), -1.0: trapezoid(-2 * t, -t, -t, 0)}
        big = {1.0: trapezoid(t, 3 * t, 1e9, 2e9), -1.0: trapezoid(-2e9, -1e9, -3 * t, -t)}
        fired = [(1.0 - front, 0.0), (min(front, trapezoid(-t, 0, 0, t)(inputs.aside)), 0.0)]
        for side in (1.0, -1.0):
            fired.append((min(front, small[side](inputs.aside)), sign * side))
            fired.append((min(front, big[side](inputs.aside)), 0.0 if self.published else sign * side))
        return fired


def mean(fired: list[tuple[float, float]]) -> float | None:
    """Return the weighted mean of conclusions, equal ones with their maximum weight; None if all weights are 0."""
    weights: dict[float, float] = {}
    for weight, value in fired:
        weights[value] = max(weights.get(value, 0.0), weight)
    total = sum(weights.values())
    return sum(weight * value for value, weight in weights.items()) / total if total > 0.0 else None


class Fuzzy(PathTracker[FuzzyConfig]):
    """Fuzzy tracker; see the module."""

    def __init__(self, config: FuzzyConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self._published = config.rules == "published"
        self._rules = Rules(config.near, config.lateral_tolerance, self._published)
        self._front = self._sideways = 0.0

    @property
    def prediction(self) -> float:
        """See the base class."""
        return super().prediction if self._published else self.response.total

    def reset(self) -> None:
        """See ``Tracker``."""
        super().reset()
        self._front = self._sideways = 0.0

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles; values without a rule are unchanged."""
        outputs = self._infer(state)[0]
        self._front = self._front if outputs.front is None else outputs.front
        self._sideways = self._sideways if outputs.sideways is None else outputs.sideways
        angle = self.config.angle
        front, sideways = angle * self._front, angle * self._sideways
        rear = {"front": 0.0, "rear": -front, "counter": -front, "crab": sideways, "hybrid": sideways - front}
        return (0.0 if state.steering == "rear" else front), rear[state.steering]

    def limited(self, steering: Steering, front: float, rear: float) -> Angles:
        """Each axle independently."""
        angle = self.config.angle
        return min(max(front, -angle), angle), min(max(rear, -angle), angle)

    def speed(self, state: TrackingState) -> float:
        """Slow near the sub-goal, fast elsewhere."""
        outputs, direction = self._infer(state)
        share = 1.0 if outputs.speed is None else outputs.speed
        if self._published:
            return direction * share * self.config.speed
        most = share * (self.config.speed if direction > 0 else self.config.reverse_speed)
        return direction * min(abs(state.target_speed), max(most, self.config.min_speed))

    def _infer(self, state: TrackingState) -> tuple[FuzzyOutputs, float]:
        """Return the result of the rules, and the direction."""
        run, (x, y, yaw) = state.run, state.pose
        s = min(state.s + self.config.sub_goal, run.end)
        goal = run.at(s).point
        dx, dy = goal[0] - x, goal[1] - y
        ahead, aside = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
        bearing = math.degrees(math.atan2(aside, ahead))
        orientation = math.degrees(math.remainder(state.reference.state(s).yaw - yaw, math.tau))
        # 120.0: minimum bearing of a sub-goal that the truck approaches backward, as published, deg
        direction = (1.0 if abs(bearing) < 120.0 else -1.0) if self._published else run.direction
        inputs = FuzzyInputs(bearing, orientation, math.hypot(dx, dy), aside, direction)
        return self._rules.infer(inputs), direction
