"""How fast: slower on a slope, over rough ground, where it is narrow, before curves, cusps and the goal."""

import math
from typing import Final

import numpy as np

from monstertruck_planners.track.api import TruckState
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.course import Course
from monstertruck_planners.track.line import Run

LEAST: Final = 1e-6
"""Curvatures (1/m) and turns (rad) are taken to be no smaller."""


class Pace:
    """Speed from which every curve ahead is reached at what its curvature allows, and at which the axles keep up.

    Args:
        config: accelerations, and the way in which the axles can turn.
        course: of a run.
    """

    def __init__(self, config: TrackerConfig, course: Course) -> None:
        s = course.places
        allowed = config.lateral_acceleration / np.maximum(np.abs(course.at(s).curvature), LEAST)
        turning = config.turn_within * config.steering_rate / np.maximum(course.turned(config.turn_within), LEAST)
        gained = 2 * config.deceleration * s
        least = np.minimum.accumulate((np.minimum(allowed, turning**2) + gained)[::-1])[::-1]
        self._rows = np.column_stack((s, np.maximum(least - gained, 0.0)))

    def at(self, s: float) -> float:
        """Greatest speed at ``s`` metres, m/s."""
        last = len(self._rows) - 1
        i = min(max(int(self._rows[:, 0].searchsorted(s, "right")) - 1, 0), last - 1)
        (begin, here), (end, there) = self._rows[i : i + 2].tolist()
        share = min(max((s - begin) / (end - begin), 0.0), 1.0)
        return math.sqrt(here + share * (there - here))


def wanted_speed(config: TrackerConfig, state: TruckState, run: Run, pace: Pace, s: float) -> float:
    """Speed along the run, m/s, at ``s`` metres; its sign is the run's direction."""
    if state.speed * run.direction < -config.min_speed:
        return 0.0  # still rolling the other way
    speed = config.speed if run.direction > 0 else config.reverse_speed
    speed *= min(max(state.clearance, 0.0) / config.slow_clearance, 1.0)
    speed *= comfort(state.tilt, config.slow_tilt) * comfort(state.roughness, config.slow_roughness)
    left = run.length - s - config.goal_tolerance - abs(state.speed) * config.dead_time
    speed = min(speed, math.sqrt(2 * config.deceleration * max(left, 0.0)), pace.at(s))
    return run.direction * max(speed, config.min_speed)


def comfort(amount: float, limit: float) -> float:
    """Share of the speed: 1 up to the limit, falling to 0 at twice as much; 0 for what is not a number."""
    return min(max(2.0 - amount / limit, 0.0), 1.0) if math.isfinite(amount) else 0.0
