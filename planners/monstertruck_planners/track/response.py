"""How the axles answer requests, estimated while driving: dead time and lag from the turns that requests bring about.

Candidates are all pairs of a dead time and a lag. For each the turn between two poses is predicted from the requests
and the speed; measured turns are regressed on it with a gain (the linkage may turn less than it should) and a trim (the
axles may be off centre), both near 1 and 0 beforehand. What remains unexplained gives every candidate its probability.
Turns about which the candidates agree say nothing: they are left out, and the estimate does not fade on a straight.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering

LAG_CELL: Final = 0.01
"""Spacing of the history and of the candidates' dead times, s."""
DEAD_TIMES: Final = 31
"""Candidates: 0 to 0.3 s."""
LAGS: Final = np.array((0.0, 0.05, 0.1, 0.15, 0.2))
"""Candidates, s."""
KEPT_CELLS: Final = 100
"""Cells of history that are needed before the newest: the longest dead time and the longest pause between poses."""
EARLY: Final = 1e-6
"""Cells by which rounding may make an instant early."""
TURN_NOISE: Final = 0.003
"""Standard deviation of a measured turn before any was compared, rad."""


class Response(NamedTuple):
    """How the axles follow requests."""

    dead_time: float
    """From a request to the first movement of the wheels, s."""
    lag: float
    """Time constant with which the axles then turn, s."""

    @property
    def total(self) -> float:
        """Delay of slow requests, s."""
        return self.dead_time + self.lag


@dataclass(frozen=True, slots=True)
class ResponseEstimate:
    """Dead time and lag, each the mean over the candidates."""

    response: Response
    deviation: float
    """Standard deviation of their sum, s."""
    shape_deviation: float
    """Standard deviation of the dead time alone, s: how the sum is divided shows later."""
    samples: int
    """Telling turns so far."""


class ResponseEstimator:
    """See the module.

    Args:
        geometry: the truck's.
        rate: greatest turning rate of the axles, rad/s.
    """

    def __init__(self, geometry: FourWheelSteering, rate: float) -> None:
        self._geometry = geometry
        self._rate = rate
        dead_times, by_lag = (a.ravel() for a in np.broadcast_arrays(LAG_CELL * np.arange(DEAD_TIMES), LAGS[:, None]))
        totals = dead_times + by_lag
        # mean and standard deviation of dead time and lag together of a truck that was not measured, s
        expected = (0.05, 0.08)
        self._prior = 0.5 * ((totals - expected[0]) / expected[1]) ** 2
        self._keep = [math.exp(-LAG_CELL / lag) if lag else 0.0 for lag in LAGS.tolist()]
        self._powers = np.stack((np.ones(len(totals)), dead_times, by_lag, dead_times**2, totals**2))
        """Powers of the candidates; their weighted sums are the moments of the estimate."""
        self._by_x: Array = np.zeros((3, len(totals)))
        """Sums of the predicted turns' products with themselves, the measured turns and the ways, by candidate."""
        self._products = np.empty_like(self._by_x)
        self._yy = self._yd = self._dd = self._count = 0.0
        self._samples = 0
        self._variance = TURN_NOISE**2
        self.estimate = self._judged()
        self.forget_requests()
        self._end = DEAD_TIMES + 1  # a truck begins with its wheels straight

    def forget_requests(self) -> None:
        """Requests were not obeyed, so the axles are somewhere; what was learnt stays."""
        self._request = (0.0, 0.0)
        self._bend = 0.0
        """Turn per metre that is requested, rad/m."""
        self._most = math.inf
        """Greatest change within one cell, rad/m."""
        self._curvatures = [0.0] * len(self._keep)
        self._turns = [0.0] * len(self._keep)
        self._history = np.zeros((len(self._keep), 4 * KEPT_CELLS))
        """Turn per metre, summed up over time, at the end of each cell, rad s/m."""
        self._end = 1
        """Cells written."""
        self._begin = math.nan
        """Time of the first cell, s."""
        self._seen: tuple[float, float, float, bool] | None = None
        """Time (s), yaw (rad), speed (m/s) and kind of the last yaw."""

    def request(self, t: float, angles: tuple[float, float]) -> None:
        """Note axle angles, rad, requested at ``t``."""
        if math.isnan(self._begin):
            self._begin = t - (self._end - 1) * LAG_CELL
        self._fill(t)
        change = max(abs(new - old) for new, old in zip(angles, self._request, strict=True))
        bend = self._geometry.body_twist(1.0, *angles)[2]
        if change > 0.0:
            self._most = self._rate * LAG_CELL * abs(bend - self._bend) / change
        self._request, self._bend = angles, bend

    def observe(self, t: float, yaw: float, speed: float, *, measured: bool = False) -> bool:
        """Compare the turn since the last pose with the requests; whether that said anything.

        Args:
            t: s.
            yaw: rad.
            speed: forward, m/s.
            measured: the yaw is a sensor's; turns are taken between yaws of one kind only.
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
        if float(x.max() - x.min()) < 0.001:  # turns whose predictions differ by less than this say nothing, rad
            return False
        self._learn(x, wrap_angle(yaw - before[1]), 0.5 * (before[2] + speed) * (t - before[0]))
        self.estimate = self._judged()
        return True

    def _fill(self, t: float) -> None:
        """Write the cells that end up to ``t``."""
        count = math.floor((t - self._begin) / LAG_CELL + EARLY) + 1 - self._end
        if count > 2 * KEPT_CELLS:
            self.forget_requests()
            return
        for _ in range(count):
            if self._end == len(self._history[0]):
                self._history[:, : 2 * KEPT_CELLS] = self._history[:, 2 * KEPT_CELLS :]
                self._end -= 2 * KEPT_CELLS
                self._begin += 2 * KEPT_CELLS * LAG_CELL
            for i, keep in enumerate(self._keep):
                change = (1.0 - keep) * (self._bend - self._curvatures[i])
                self._curvatures[i] += min(max(change, -self._most), self._most)
                self._turns[i] += LAG_CELL * self._curvatures[i]
            self._history[:, self._end] = self._turns
            self._end += 1

    def _at(self, t: float) -> Array | None:
        """The sums at ``t`` less each dead time, by candidate; None if that is before the history."""
        cells = (t - self._begin) / LAG_CELL + EARLY
        i = math.floor(cells)
        if i < DEAD_TIMES or i >= self._end:
            return None
        after = min(i + 1, self._end - 1)
        low, high = (self._history[:, j - DEAD_TIMES + 1 : j + 1][:, ::-1] for j in (i, after))
        return np.ravel(low + (cells - i) * (high - low))

    def _learn(self, x: Array, y: float, way: float) -> None:
        fade, products = 1.0 - 1.0 / 150.0, self._products  # telling turns after which the older ones count for a third
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
        # 0.15: standard deviation of the share by which the truck may turn more or less than requested
        # 0.1: standard deviation of the curvature that is there without being requested, 1/m
        by_gain, by_trim = self._variance / 0.15**2, self._variance / 0.1**2
        (xx, xy, xd), dd = self._by_x, self._dd + by_trim
        xx, xy = xx + by_gain, xy + by_gain
        explained = (xy * (dd * xy - 2 * self._yd * xd) + self._yd**2 * xx) / (xx * dd - xd * xd)
        most = float(explained.max())
        believed = 5.0  # turns that this is worth
        self._variance = (self._yy + by_gain - most + believed * TURN_NOISE**2) / (self._count + believed)
        # 3.0: turns that say as much as one independent turn: what the model does not know lasts longer than a step
        cost = (most - explained) / (2 * self._variance * 3.0) + self._prior
        moments = (self._powers @ np.exp(float(cost.min()) - cost)).tolist()
        dead_time, lag, dead_time_squared, total_squared = (moment / moments[0] for moment in moments[1:])
        response = Response(dead_time, lag)
        variances = total_squared - response.total**2, dead_time_squared - dead_time**2
        total_deviation, dead_time_deviation = (math.sqrt(max(variance, 0.0)) for variance in variances)
        return ResponseEstimate(response, total_deviation, dead_time_deviation, self._samples)


def rounded(estimate: ResponseEstimate) -> Response:
    """The estimated delay: dead time alone until it shows how it is divided; the lag is a multiple of 0.05 s."""
    found = estimate.response
    lag_step = 0.05  # estimated lags are rounded to multiples of this, s: every lag needs gains of its own
    lag = lag_step * round(found.lag / lag_step) if estimate.shape_deviation < lag_step / 2 else 0.0
    return Response(max(found.total - lag, 0.0), lag)


def choose(used: Response, configured: Response | None, estimate: ResponseEstimate) -> Response:
    """The response to use next: the configured one unless the estimate contradicts it; ``used`` itself for no change.

    A configured response that was contradicted counts again when the estimate comes back to it.
    """
    found = estimate.response
    if configured is not None:
        # 3.0: standard deviations by which the estimate must differ from the configured response to contradict it
        # 1.0: standard deviations within which it must come back for the configured response to count again
        sure, share = (3.0, 1.0) if used == configured else (1.0, 0.5)
        # 0.03: least difference from the configured delay, s: effects that are not modelled look like a delay of this
        # size
        near = abs(found.total - configured.total) <= sure * estimate.deviation + share * 0.03
        # 0.05: least difference from the configured dead time alone, s
        alike = abs(found.dead_time - configured.dead_time) <= sure * estimate.shape_deviation + share * 0.05
        if near and alike:
            return configured
    new = rounded(estimate)
    # 0.01: an estimate that differs by less than this from the one in use changes nothing, s
    same = used != configured and used.lag == new.lag and abs(new.total - used.total) < 0.01
    return used if same else new
