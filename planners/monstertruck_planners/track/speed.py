"""How fast: slower on a slope, over rough ground, where it is narrow, before curves, cusps and the goal."""

import math

import numpy as np

from monstertruck_planners.track.api import TruckState
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.course import Course
from monstertruck_planners.track.line import Run

LOOKS = 24
"""Places ahead whose curvature counts."""


def wanted_speed(config: TrackerConfig, state: TruckState, run: Run, course: Course, s: float) -> float:
    """Speed along the run, m/s, at ``s`` metres; its sign is the run's direction."""
    if state.speed * run.direction < -config.min_speed:
        return 0.0  # still rolling the other way
    speed = config.speed if run.direction > 0 else config.reverse_speed
    speed *= min(max(state.clearance, 0.0) / config.slow_clearance, 1.0)
    speed *= comfort(state.tilt, config.slow_tilt) * comfort(state.roughness, config.slow_roughness)
    left = run.length - s - config.goal_tolerance - abs(state.speed) * config.dead_time
    speed = min(speed, math.sqrt(2 * config.deceleration * max(left, 0.0)), _for_curves(config, course, run, s, speed))
    return run.direction * max(speed, config.min_speed)


def comfort(amount: float, limit: float) -> float:
    """Share of the speed: 1 up to the limit, falling to 0 at twice as much; 0 for what is not a number."""
    return min(max(2.0 - amount / limit, 0.0), 1.0) if math.isfinite(amount) else 0.0


def _for_curves(config: TrackerConfig, course: Course, run: Run, s: float, speed: float) -> float:
    """Speed from which every curve ahead is reached at what its curvature allows, and at which the axles keep up."""
    braking = 0.5 * speed * speed / config.deceleration
    ahead = np.linspace(0.0, min(braking, run.end - s) if run.end > s else 0.0, LOOKS)
    curvature = np.abs(course.at(s + ahead).curvature)
    allowed = config.lateral_acceleration / np.maximum(curvature, 1e-6)
    turning = config.turn_within * config.steering_rate / np.maximum(course.turned(s + ahead, config.turn_within), 1e-6)
    return float(np.sqrt((np.minimum(allowed, turning**2) + 2 * config.deceleration * ahead).min()))
