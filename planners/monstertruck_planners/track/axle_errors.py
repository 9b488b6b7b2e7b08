"""Deviation of the steering from its calibration: gain, trim and compliance of each axle, estimated from the motion.

After turning, an axle with requested angle q points at

    angle = gain q + trim - compliance a        a = v^2 (front - rear) / L, the lateral acceleration

A wrong servo or linkage appears in gain and trim at every speed; tyre slip grows with the square of the speed. Over
short intervals the turn, and the sideways motion if the position is measured too, are linear in these six numbers to
first order (eqs. 2.34 and 2.37), so an extended Kalman filter estimates them with their covariance. Outliers are
down-weighted (Student's t), and the noise is estimated from the residuals.
"""

import math
from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final, NamedTuple, Self

import numpy as np

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.chassis import Freedom
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering

Angles = tuple[float, float]

BASE: Final = 0.25
"""Minimum time between two compared poses (s), so that the noise of single poses hardly matters."""

DEAD_BAND: Final = 0.0012
"""Standard deviation of the servo's stop position (rad of the axle): a dead band of 2 us to either side, uniformly."""


INDEPENDENT: Final[Mapping[Freedom | None, tuple[Angles, ...]]] = MappingProxyType(
    {"both": ((1.0, 0.0), (0.0, 1.0)), "front": ((1.0, 0.0),), "parallel": ((1.0, 1.0),), None: ()}
)
"""Axles with independent errors, by freedom of the body: a single servo for both axles has the same error on both."""


class AxleError(NamedTuple):
    """Deviation of one axle from its calibration."""

    gain: float = 1.0
    trim: float = 0.0
    """Trim (rad), left positive."""
    compliance: float = 0.0
    """Angle lost by slip per lateral acceleration (rad s^2/m)."""


class AxleErrors(NamedTuple):
    """Deviations of both axles from their calibration."""

    front: AxleError = AxleError()
    rear: AxleError = AxleError()

    @classmethod
    def of(cls, state: Array) -> Self:
        """Convert the filter state: gain minus 1, trim, compliance, front then rear."""
        f_gain, f_trim, f_slip, r_gain, r_trim, r_slip = state.tolist()
        return cls(AxleError(1.0 + f_gain, f_trim, f_slip), AxleError(1.0 + r_gain, r_trim, r_slip))

    def wheels(self, requested: Angles, grip: float) -> Angles:
        """Return the effective angles of axles turned to ``requested`` (rad); ``grip``: speed^2 / wheelbase (m/s^2)."""
        front = self.front.gain * requested[0] + self.front.trim
        rear = self.rear.gain * requested[1] + self.rear.trim
        # 0.5: no slip doubles a turn
        acceleration = grip * (front - rear) / max(1.0 + grip * (self.front.compliance - self.rear.compliance), 0.5)
        return front - self.front.compliance * acceleration, rear - self.rear.compliance * acceleration

    def requests(self, wheels: Angles, grip: float) -> Angles:
        """Return the requests for effective angles ``wheels`` (rad); inverse of the method ``wheels``."""
        acceleration = grip * (wheels[0] - wheels[1])
        front, rear = (
            (angle + axle.compliance * acceleration - axle.trim) / axle.gain
            for angle, axle in zip(wheels, self, strict=True)
        )
        return front, rear


class AxleMotion(NamedTuple):
    """Motion data of one control step."""

    t: float
    """Time (s)."""
    swept: Angles
    """Time integrals of both axles' requested angles, after dead time and lag (rad s)."""
    angles: Angles
    """These angles now (rad)."""
    pose: tuple[float, float, float]
    """Pose (m, rad)."""
    speed: float
    """Forward speed (m/s)."""
    heading: tuple[float, float] | None
    """Time (s) and measured yaw (rad); None: the yaw of the pose, if it is located."""
    located: bool
    """Whether the pose is measured rather than computed from the requests."""


class _Sums(NamedTuple):
    """Sums up to a control step, or between two."""

    motion: AxleMotion
    """Motion at the step, or at the next step."""
    values: Array
    """Turn (rad) and sideways motion (m), each as a constant and its derivatives by the six numbers; (2, 7)."""
    distance: float
    """Distance (m)."""
    sideways: float
    """Measured sideways motion (m)."""


class _Mark(NamedTuple):
    """Start of an interval."""

    t: float
    yaw: float
    measured: bool
    """Whether the yaw comes from a heading measurement."""
    sums: _Sums


class AxleErrorEstimator:
    """Estimator of the axle errors; see the module.

    Args:
        geometry: geometry of the truck.
        freedom: angles that the axles can take; None: no axle is steered, so nothing is learnt.
    """

    def __init__(self, geometry: FourWheelSteering, freedom: Freedom | None = "both") -> None:
        self._geometry = geometry
        self.state: Array = np.zeros(6)
        # Standard deviations of an undriven truck: of the gain, the spread of hobby servos in pulse per angle; of the
        # trim (rad), a servo horn put on up to half of a tooth of 25 off, uniformly, at 0.64 rad of the axle per rad of
        # the servo; of the compliance (rad s^2/m), rubber tyres under a light truck.
        alone = np.diag(np.square((0.15, 0.047, 0.03)))
        self._prior: Array = sum((np.kron(np.outer(e, e), alone) for e in INDEPENDENT[freedom]), np.zeros((6, 6)))
        self.covariance: Array = self._prior.copy()
        self.errors = AxleErrors()
        self.metres = 0.0
        """Compared distance (m)."""
        self.samples = 0
        """Number of compared intervals."""
        self._squares, self._counts = [0.0, 0.0], [0.0, 0.0]
        self.restart()

    def restart(self) -> None:
        """Begin a new interval, because the axles do not match the requests or were recomputed."""
        # Maximum age of a late heading, in control steps.
        self._sums: deque[_Sums] = deque(maxlen=32)
        self._begin: _Mark | None = None

    def observe(self, motion: AxleMotion, delay_deviation: float) -> bool:
        """Compare the motion since the last interval with the requests; return whether the estimate changed.

        Args:
            motion: current motion.
            delay_deviation: standard deviation of the axle delay (s).
        """
        if not self._prior.any() or (not motion.located and motion.heading is None):
            return False
        self._add(motion)
        at, yaw = motion.heading or (motion.t, motion.pose[2])
        sums = self._at(at)
        if sums is None:
            return False
        begin, mark = self._begin, _Mark(at, yaw, motion.heading is not None, sums)
        # 4.0: intervals this many times as long as meant were interrupted
        usable = begin is not None and begin.measured is mark.measured and at - begin.t <= 4.0 * BASE
        if begin is None or not usable:
            self._begin = mark
            return False
        if at - begin.t < BASE:
            return False
        self._begin = mark
        return self._compare(begin, mark, delay_deviation)

    def _compare(self, begin: _Mark, end: _Mark, delay_deviation: float) -> bool:
        """Learn from one interval; return whether the truck moved."""
        way = end.sums.distance - begin.sums.distance
        if abs(way) < 0.001:  # a truck at rest, m
            return False
        self._forget(abs(way))
        wheelbase = self._geometry.wheelbase
        steered = [b - a for a, b in zip(begin.sums.motion.angles, end.sums.motion.angles, strict=True)]
        late = abs(way) / (end.t - begin.t) * delay_deviation * abs(steered[0] - steered[1]) / wheelbase
        stopped = abs(way) * DEAD_BAND * math.sqrt(2.0) / wheelbase
        turn, aside = end.sums.values - begin.sums.values
        self._update(0, turn, wrap_angle(end.yaw - begin.yaw), late**2 + stopped**2)
        if end.sums.motion.located:
            known = (way * DEAD_BAND) ** 2 + (late * way) ** 2
            self._update(1, aside, end.sums.sideways - begin.sums.sideways, known)
        self.errors = AxleErrors.of(self.state)
        return True

    def _add(self, motion: AxleMotion) -> None:
        """Extend the sums by the motion since the last step."""
        last = self._sums[-1] if self._sums else None
        # 0.5: steps further apart than this are not joined, s
        if last is None or not 0.0 < motion.t - last.motion.t <= 0.5:
            self.restart()
            self._sums.append(_Sums(motion, np.zeros((2, 7)), 0.0, 0.0))
            return
        before = last.motion
        dt = motion.t - before.t
        speed = 0.5 * (before.speed + motion.speed)
        asked = tuple((b - a) / dt for a, b in zip(before.swept, motion.swept, strict=True))
        rows = self._rows((asked[0], asked[1]), speed)
        dx, dy = motion.pose[0] - before.pose[0], motion.pose[1] - before.pose[1]
        middle = before.pose[2] + 0.5 * wrap_angle(motion.pose[2] - before.pose[2])
        aside = math.cos(middle) * dy - math.sin(middle) * dx
        values = last.values + speed * dt * rows
        self._sums.append(_Sums(motion, values, last.distance + speed * dt, last.sideways + aside))

    def _rows(self, asked: Angles, speed: float) -> Array:
        """Return turn and sideways motion per metre, each as constant and derivatives by the six numbers; (2, 7)."""
        geometry, grip = self._geometry, speed * speed / self._geometry.wheelbase
        acceleration = grip * (asked[0] - asked[1])
        tangents, by_axle = [], []
        for q, angle in zip(asked, self.errors.wheels(asked, grip), strict=True):
            tangents.append(math.tan(min(max(angle, -1.4), 1.4)))  # 1.4: angles are cut to this, rad
            # Slope of exact axles: with the estimated axles, the filter would learn from the noise of its own estimate.
            slope = 1.0 + math.tan(min(max(q, -1.4), 1.4)) ** 2
            by_axle.append(slope * np.array((q, 1.0, -acceleration)))
        shares = ((1.0 / geometry.wheelbase, -1.0 / geometry.wheelbase), (1.0 - geometry.cg_split, geometry.cg_split))
        rows = np.empty((2, 7))
        for row, (front, rear) in zip(rows, shares, strict=True):
            row[1:4], row[4:] = front * by_axle[0], rear * by_axle[1]
            row[0] = front * tangents[0] + rear * tangents[1] - row[1:] @ self.state
        return rows

    def _at(self, t: float) -> _Sums | None:
        """Return the sums at an instant between two steps; None if no step is that old."""
        for after, before in zip(reversed(self._sums), list(reversed(self._sums))[1:], strict=False):
            if before.motion.t <= t <= after.motion.t:
                share = (t - before.motion.t) / (after.motion.t - before.motion.t)
                return _Sums(
                    after.motion,
                    before.values + share * (after.values - before.values),
                    before.distance + share * (after.distance - before.distance),
                    before.sideways + share * (after.sideways - before.sideways),
                )
        return None

    def _forget(self, way: float) -> None:
        """Let the covariance grow back towards the prior."""
        # Distance that reduces the weight of older knowledge to a third (m): parts wear.
        keep = math.exp(-way / 200.0)
        self.covariance = keep * self.covariance + (1.0 - keep) * self._prior
        self.metres += way
        self.samples += 1

    def _update(self, kind: int, row: Array, measured: float, known: float) -> None:
        """Add one measurement: turn (0) or sideways motion (1); ``known`` is the variance of modelled effects."""
        by = row[1:]
        residual = measured - float(row[0] + by @ self.state)
        # Standard deviation of a turn (rad) and of a sideways motion (m) before any comparison.
        assumed, believed = (0.003, 0.002)[kind], 5.0  # believed: weight of the assumed noise, in intervals
        noise = (self._squares[kind] + believed * assumed**2) / (self._counts[kind] + believed) + known
        spread = self.covariance @ by
        predicted = float(by @ spread)
        freedom = 4.0  # degrees of freedom of Student's t for the weights of residuals
        weight = (freedom + 1.0) / (freedom + residual**2 / (predicted + noise))
        unexplained = weight * residual**2 * noise / (predicted + noise) - known
        fade = 1.0 - 1.0 / 150.0  # share of the sums that remains after each interval
        self._squares[kind] = fade * self._squares[kind] + max(unexplained, 0.0)
        self._counts[kind] = fade * self._counts[kind] + 1.0
        # Student's t with this scale has a variance that is larger by freedom / (freedom - 2).
        gain = spread / (predicted + noise * freedom / (freedom - 2.0) / min(weight, 1.0))
        self.state = self.state + gain * residual
        self.covariance = self.covariance - np.outer(gain, spread)
