"""Online estimate of the axles' response to requests: dead time and lag, from the turns that requests cause.

The candidates are all pairs of a dead time and a lag. Each candidate predicts the turn between two poses from the
requests and the speed. Measured turns are regressed on the prediction with a gain (the linkage may turn less than
expected) and a trim (the axles may be off centre), with priors near 1 and 0. The residuals give each candidate its
probability. Turns that all candidates predict equally carry no information and are ignored, so the estimate does not
fade on a straight.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering

LAG_CELL: Final = 0.01
"""Spacing of the history and of the candidates' dead times (s)."""
DEAD_TIMES: Final = 31
"""Number of candidate dead times: 0 to 0.3 s."""
LAGS: Final = np.array((0.0, 0.05, 0.1, 0.15, 0.2))
"""Candidate lags (s)."""
TURN_NOISE: Final = 0.003
"""Standard deviation of a measured turn before any comparison (rad)."""


class Response(NamedTuple):
    """Response of the axles to requests."""

    dead_time: float
    """Time from a request to the first movement of the wheels (s)."""
    lag: float
    """Time constant of the axles after the dead time (s)."""

    @property
    def total(self) -> float:
        """Total delay of slow requests (s)."""
        return self.dead_time + self.lag


@dataclass(frozen=True, slots=True)
class ResponseEstimate:
    """Dead time and lag, each the mean over the candidates."""

    response: Response
    deviation: float
    """Standard deviation of the sum of dead time and lag (s)."""
    shape_deviation: float
    """Standard deviation of the dead time alone (s): the split of the sum becomes known later."""
    samples: int
    """Number of informative turns so far."""


class ResponseEstimator:
    """Estimator of dead time and lag; see the module.

    Args:
        geometry: geometry of the truck.
        rate: maximum turning rate of the axles (rad/s).
    """

    def __init__(self, geometry: FourWheelSteering, rate: float) -> None:
        self._geometry = geometry
        self._rate = rate
        dead_times, by_lag = (a.ravel() for a in np.broadcast_arrays(LAG_CELL * np.arange(DEAD_TIMES), LAGS[:, None]))
        totals = dead_times + by_lag
        # mean and standard deviation of dead time plus lag of an unmeasured truck, s
        expected = (0.05, 0.08)
        self._prior = 0.5 * ((totals - expected[0]) / expected[1]) ** 2
        self._keep = [math.exp(-LAG_CELL / lag) if lag else 0.0 for lag in LAGS.tolist()]
        self._powers = np.stack((np.ones(len(totals)), dead_times, by_lag, dead_times**2, totals**2))
        """Powers of the candidates; their weighted sums are the moments of the estimate."""
        self._by_x: Array = np.zeros((3, len(totals)))
        """Sums of products of predicted turns with themselves, measured turns and distances, by candidate."""
        self._products = np.empty_like(self._by_x)
        self._yy = self._yd = self._dd = self._count = 0.0
        self._samples = 0
        self._variance = TURN_NOISE**2
        self.estimate = self._judged()
        self.forget_requests()
        self._end = DEAD_TIMES + 1  # a truck begins with its wheels straight

    def forget_requests(self) -> None:
        """Forget requests that were not obeyed, as the axle angles are unknown; keep the estimate."""
        self._request = (0.0, 0.0)
        self._bend = 0.0
        """Requested turn per metre (rad/m)."""
        self._most = math.inf
        """Maximum change within one cell (rad/m)."""
        self._curvatures = [0.0] * len(self._keep)
        self._turns = [0.0] * len(self._keep)
        # At least a second before the latest cell is kept: the longest dead time plus the longest pause between poses.
        self._history = np.zeros((len(self._keep), 400))
        """Time integral of the turn per metre at the end of each cell (rad s/m)."""
        self._end = 1
        """Number of cells written."""
        self._begin = math.nan
        """Time of the first cell (s)."""
        self._seen: tuple[float, float, float, bool] | None = None
        """Time (s), yaw (rad), speed (m/s) and kind of the last yaw."""

    def request(self, t: float, angles: tuple[float, float]) -> None:
        """Record axle angles (rad) requested at ``t``."""
        if math.isnan(self._begin):
            self._begin = t - (self._end - 1) * LAG_CELL
        self._fill(t)
        change = max(abs(new - old) for new, old in zip(angles, self._request, strict=True))
        bend = self._geometry.body_twist(1.0, *angles)[2]
        if change > 0.0:
            self._most = self._rate * LAG_CELL * abs(bend - self._bend) / change
        self._request, self._bend = angles, bend

    def observe(self, t: float, yaw: float, speed: float, *, measured: bool = False) -> bool:
        """Compare the turn since the last pose with the requests; return whether it was informative.

        Args:
            t: time (s).
            yaw: yaw (rad).
            speed: forward speed (m/s).
            measured: whether a sensor measured the yaw; turns are computed only between yaws of the same kind.
        """
        before, self._seen = self._seen, (t, yaw, speed, measured)
        # 0.5: poses further apart in time than this are not compared, s
        if before is None or before[3] is not measured or not 0.0 < t - before[0] <= 0.5 or math.isnan(self._begin):
            return False
        self._fill(t)
        first, last = self._at(before[0]), self._at(t)
        if first is None or last is None:
            return False
        x = 0.5 * (before[2] + speed) * (last - first)
        if float(x.max() - x.min()) < 0.001:  # minimum spread of the predictions of an informative turn, rad
            return False
        self._learn(x, wrap_angle(yaw - before[1]), 0.5 * (before[2] + speed) * (t - before[0]))
        self.estimate = self._judged()
        return True

    def _fill(self, t: float) -> None:
        """Write all cells that end by ``t``."""
        count = math.floor(self._cells(t)) + 1 - self._end
        half = self._history.shape[1] // 2
        if count > half:
            self.forget_requests()
            return
        for _ in range(count):
            if self._end == len(self._history[0]):
                self._history[:, :half] = self._history[:, half:]
                self._end -= half
                self._begin += half * LAG_CELL
            for i, keep in enumerate(self._keep):
                change = (1.0 - keep) * (self._bend - self._curvatures[i])
                self._curvatures[i] += min(max(change, -self._most), self._most)
                self._turns[i] += LAG_CELL * self._curvatures[i]
            self._history[:, self._end] = self._turns
            self._end += 1

    def _cells(self, t: float) -> float:
        """Return the cells before an instant; one that ends then counts in spite of rounding."""
        return (t - self._begin) / LAG_CELL + 1e-6

    def _at(self, t: float) -> Array | None:
        """Return the sums at ``t`` minus each dead time, by candidate; None if that precedes the history."""
        cells = self._cells(t)
        i = math.floor(cells)
        if i < DEAD_TIMES or i >= self._end:
            return None
        after = min(i + 1, self._end - 1)
        low, high = (self._history[:, j - DEAD_TIMES + 1 : j + 1][:, ::-1] for j in (i, after))
        return np.ravel(low + (cells - i) * (high - low))

    def _learn(self, x: Array, y: float, way: float) -> None:
        fade, products = 1.0 - 1.0 / 150.0, self._products  # 150: memory in informative turns; older ones weigh a third
        np.multiply(x, x, out=products[0])
        np.multiply(x, y, out=products[1])
        np.multiply(x, way, out=products[2])
        self._by_x *= fade
        self._by_x += products
        self._yy = fade * self._yy + y * y
        self._yd = fade * self._yd + y * way
        self._dd = fade * self._dd + way * way
        self._count = fade * self._count + 1.0
        self._samples += 1

    def _judged(self) -> ResponseEstimate:
        # 0.15: prior standard deviation of the relative error of a turn
        # 0.1: prior standard deviation of the curvature without a request, 1/m
        by_gain, by_trim = self._variance / 0.15**2, self._variance / 0.1**2
        (xx, xy, xd), dd = self._by_x, self._dd + by_trim
        xx, xy = xx + by_gain, xy + by_gain
        explained = (xy * (dd * xy - 2 * self._yd * xd) + self._yd**2 * xx) / (xx * dd - xd * xd)
        most = float(explained.max())
        believed = 5.0  # weight of the prior noise, in turns
        self._variance = (self._yy + by_gain - most + believed * TURN_NOISE**2) / (self._count + believed)
        # 3.0: turns equivalent to one independent turn: model errors last longer than a step
        cost = (most - explained) / (2 * self._variance * 3.0) + self._prior
        moments = (self._powers @ np.exp(float(cost.min()) - cost)).tolist()
        dead_time, lag, dead_time_squared, total_squared = (moment / moments[0] for moment in moments[1:])
        response = Response(dead_time, lag)
        variances = total_squared - response.total**2, dead_time_squared - dead_time**2
        total_deviation, dead_time_deviation = (math.sqrt(max(variance, 0.0)) for variance in variances)
        return ResponseEstimate(response, total_deviation, dead_time_deviation, self._samples)


def rounded(estimate: ResponseEstimate) -> Response:
    """Return the estimated delay: dead time alone until the split is known; the lag is a multiple of 0.05 s."""
    found = estimate.response
    lag_step = 0.05  # rounding step of estimated lags, s: every lag needs separate gains
    lag = lag_step * round(found.lag / lag_step) if estimate.shape_deviation < lag_step / 2 else 0.0
    return Response(max(found.total - lag, 0.0), lag)


def choose(used: Response, configured: Response | None, estimate: ResponseEstimate) -> Response:
    """Return the response to use next: the configured one unless the estimate contradicts it; ``used`` for no change.

    A contradicted configured response is used again once the estimate returns to it.
    """
    found = estimate.response
    if configured is not None:
        # 3.0: minimum difference of a contradiction to the configured response, in standard deviations
        # 1.0: difference below which the configured response is used again, in standard deviations
        sure, share = (3.0, 1.0) if used == configured else (1.0, 0.5)
        # 0.03: minimum difference from the configured delay, s: effects that are not modelled look like a delay of this
        # size
        near = abs(found.total - configured.total) <= sure * estimate.deviation + share * 0.03
        # 0.05: minimum difference from the configured dead time alone, s
        alike = abs(found.dead_time - configured.dead_time) <= sure * estimate.shape_deviation + share * 0.05
        if near and alike:
            return configured
    new = rounded(estimate)
    # 0.01: an estimate that differs by less than this from the one in use changes nothing, s
    same = used != configured and used.lag == new.lag and abs(new.total - used.total) < 0.01
    return used if same else new
