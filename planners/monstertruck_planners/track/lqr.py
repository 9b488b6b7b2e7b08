"""Linear-quadratic regulator with preview; gains depend on the current speed and steering mode.

Prediction bridges the dead time, the axles' lag is part of the state, and upcoming curves act through the optimal
preview gains, so the wheels begin to turn before the curve.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import LqrConfig
from monstertruck_planners.track.error_model import BASES, discretise, riccati
from monstertruck_planners.track.path_tracker import Angles, PathTracker, TrackingState
from monstertruck_schemas.plan import Steering

BETWEEN: Final = 4
"""Samples per period averaged into the reference."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains for m inputs, n states and k preview periods."""

    feedback: Array
    """Shape (m, n): change of the input per error; states e, p, axles, last input."""
    preview: Array
    """Shape (m, 2 k): change of the input per slip and turn of the reference, period by period."""
    furthest: float
    """Limit to which the distance from the path is clipped (m)."""
    least: Array
    """Shape (2, 2): infinite-horizon cost of e and p, with the axles at their optimum."""


class Lqr(PathTracker[LqrConfig]):
    """Linear-quadratic tracker; see the module."""

    def __init__(self, config: LqrConfig, geometry: FourWheelSteering) -> None:
        super().__init__(config, geometry)
        self._periods = max(math.ceil(config.preview * config.rate), 1)
        self._times = (np.arange(self._periods * BETWEEN, dtype=np.float64) + 0.5) * (self.period / BETWEEN)
        self._soon = self._times[: max(len(self._times) // 3, 1)]
        self._gains = GainTable(config, geometry, self._periods)

    def steer(self, state: TrackingState) -> Angles:
        """Return the axle angles for the next period."""
        basis = BASES[state.steering]
        gains = self._gains.at(state.steering, float(state.speeds(self._soon).mean()), self.response.lag)
        onto = np.linalg.pinv(basis)
        axles = onto @ np.tan(state.angles)
        asked = onto @ np.tan(state.requested)
        offset = min(max(state.lateral_error, -gains.furthest), gains.furthest)
        error = np.concatenate(([offset, state.heading_error], axles, asked))
        change = gains.preview @ self._reference(state) - gains.feedback @ error
        front, rear = np.arctan(basis @ (asked + change))
        return float(front), float(rear)

    def _reference(self, state: TrackingState) -> Array:
        """Return slip and turn of the next periods, shape (2 k,)."""
        # The path after a change of steering does not apply to these axles: plan as if the path continued unchanged.
        # 0.03: a change of steering, m: more than the spacing of the reference
        end = state.reference.section_end(state.s) - 0.03
        ahead = state.reference.at(np.minimum(state.distances(self._times), end))
        if state.steering == "crab":
            slip = np.remainder(ahead.heading - state.pose[2] + math.pi, math.tau) - math.pi
            slip, turn = np.clip(slip, -1.0, 1.0), np.zeros_like(slip)
        else:
            slip, turn = ahead.slip, ahead.turn / np.cos(ahead.slip)
        both = np.stack((np.tan(slip), turn), axis=1)
        return np.asarray(both.reshape(self._periods, BETWEEN, 2).mean(axis=1).ravel())


class GainTable:
    """Gains by steering mode, speed and axle lag, each computed once.

    Args:
        config: scales.
        geometry: geometry of the truck.
        periods: number of preview periods.
    """

    def __init__(self, config: LqrConfig, geometry: FourWheelSteering, periods: int) -> None:
        self._config = config
        self._geometry = geometry
        self._periods = periods
        self._known: dict[tuple[Steering, bool, int, float], Gains] = {}

    def at(self, steering: Steering, speed: float, lag: float) -> Gains:
        """Return the gains for a non-zero speed (m/s) and a lag (s)."""
        speed_step = 0.05  # speeds this near to each other (relatively) share their gains
        key = (steering, speed > 0, round(math.log(abs(speed)) / speed_step), lag)
        if key not in self._known:
            size = math.exp(key[2] * speed_step)
            self._known[key] = self._design(steering, math.copysign(size, speed), lag)
        return self._known[key]

    def _design(self, steering: Steering, speed: float, lag: float) -> Gains:
        config, period = self._config, 1.0 / self._config.rate
        model = discretise(self._geometry, steering, speed, lag, period)
        n, m = model.b.shape
        a = np.block([[model.a, model.b], [np.zeros((m, n)), np.eye(m)]])
        b = np.vstack((model.b, np.eye(m)))
        d = np.vstack((model.d, np.zeros((m, 2))))
        q = np.zeros((n + m, n + m))
        q[0, 0] = period / config.lateral_scale**2
        q[1, 1] = period / config.heading_scale**2
        if steering == "crab":  # the path sets the heading, and no input changes it
            q[1, 1] = a[0, 1] = 0.0
            a[1, :] = 0.0
        r = np.eye(m) / (period * config.rate_scale**2)
        cost = riccati(a, b, q, r)
        inverse = np.linalg.inv(r + b.T @ cost @ b)
        feedback = inverse @ b.T @ cost @ a
        closed = a - b @ feedback
        preview, ahead = [], cost @ d
        for _ in range(self._periods):
            preview.append(-inverse @ b.T @ ahead)
            ahead = closed.T @ ahead
        single = m == 1 and steering != "crab"
        # 0.6: steepest angle at which the path is approached, rad
        furthest = 0.6 * abs(feedback[0, 1] / feedback[0, 0]) if single else math.inf
        least = cost[:2, :2] - cost[:2, 2:] @ np.linalg.solve(cost[2:, 2:], cost[2:, :2])
        return Gains(feedback, np.hstack(preview), furthest, least)
