"""Lag of the scans' content behind the robot's motion: a likelihood for every lag.

The method compares the places by the scans (distance and yaw since the first scan) with the places by another measure
some time earlier. The covariance of their difference covers the errors of both: ``Errors`` give the scale error, the
slip along the path, the error of each place, a constant bend and a drift; the registration gives its deviations; the
offset is unknown. Only changes of motion therefore tell lags apart, as far as they exceed these errors. A lag is found
if the best lag beyond the tolerated ones explains the scans significantly better than every tolerated lag and better
than the longest lag tried: the scans have shown the change, but late.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.consistency.comparison import MOST_DEVIATIONS, Errors
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND

SHIFT: Final = SECOND // 10
"""Step between the lags tried (ns)."""
SIGMAS: Final = 5.0
"""Significance of a finding, in standard deviations: a false alarm in 3 million checks. Here it rejects all tolerated
lags and the longest."""


class ScanStep(NamedTuple):
    """Motion between two scans."""

    since: int
    """Stamp of the first scan (ns)."""
    stamp: int
    """Stamp of the second scan (ns)."""
    moved: tuple[float, float]
    """Distance ahead (m) and turn (rad)."""
    deviations: tuple[float, float]
    """Standard deviations of the place at ``stamp``, see ``StepOutput.deviations``."""


@dataclass(frozen=True, slots=True)
class LagQuestion:
    """Motion by the scans and by other measures, for the search of the lag; cheap enough for the event loop."""

    tolerated: int
    """Maximum tolerated lag, in ``SHIFT``."""
    others: tuple[tuple[Errors, tuple[ScanStep, ...], Array], ...]
    """For every other measure: its errors, the n consecutive scan steps whose time it covers, and its motion during
    them, shape (lags, n, 3), each lag earlier than the previous one."""


class Delay(NamedTuple):
    """Lag of the scans."""

    seconds: float
    sigmas: float
    """Significance for the rejection of all tolerated lags and the longest."""


def lag_question(steps: list[ScanStep], others: list[tuple[Errors, MotionTrack]], tolerated: float) -> LagQuestion:
    """Collect the motions for ``scan_delay``.

    Args:
        steps: consecutive steps of the scans, at least one.
        others: other measures of the same motion.
        tolerated: maximum tolerated lag (s).
    """
    lags = SHIFT * np.arange(17)  # the search finds only lags shorter than the last one
    known = []
    for errors, track in others:
        usable = tuple(row for row in steps if track.covers(row.since - int(lags[-1]), row.stamp))
        if len(usable) >= 12:  # minimum number of compared places
            begins, ends = (np.array([row[end] for row in usable]) - lags[:, None] for end in (0, 1))
            known.append((errors, usable, track.motions(begins, ends)))
    return LagQuestion(int(tolerated * SECOND / SHIFT), tuple(known))


def scan_delay(question: LagQuestion) -> Delay | None:
    """Return the lag of the scans behind all other measures, or None unless it exceeds the tolerance beyond chance."""
    cost, squares, places = np.zeros(1), np.zeros(1), 0
    for errors, steps, moved in question.others:
        for axis in _axes(errors):
            mahalanobis, volume = _fit(steps, moved, axis)
            cost = cost + mahalanobis + volume
            squares = squares + mahalanobis
            places += len(steps)
    best, allowed = int(np.argmin(cost)), question.tolerated + 1
    if not places or best < allowed:
        return None
    # If all differences exceed the stated errors, every difference becomes less certain.
    inflation = max(1.0, float(squares[best]) / places)
    # A change missing in the scans up to the longest lag may never appear: the other measure may be wrong.
    rejected = min(cost[:allowed].min(), cost[-1]) - cost[best]
    sigmas = math.sqrt(float(rejected) / inflation)
    return Delay(best * SHIFT / SECOND, sigmas) if sigmas >= SIGMAS else None


class _Axis(NamedTuple):
    """Maximum errors of the distance ahead or of the turn."""

    place: int
    """0 for distance, 1 for turn."""
    share: float
    constant: float
    """Constant error (m or rad)."""
    bend: float = 0.0
    """Bend (rad/m)."""
    drift: float = 0.0
    """Drift (rad/s)."""


def _axes(errors: Errors) -> list[_Axis]:
    turn = _Axis(1, *errors.turn, errors.bend, errors.drift)
    return [turn] if errors.way is None else [_Axis(0, *errors.way), turn]


def _fit(steps: tuple[ScanStep, ...], moved: Array, axis: _Axis) -> tuple[Array, Array]:
    """Return each lag's squared Mahalanobis distance between the places, and log determinant, shapes (k,)."""
    shown = np.cumsum([step.moved[axis.place] for step in steps])
    seen = np.square([step.deviations[axis.place] for step in steps])
    seconds = np.array([(step.stamp - steps[0].since) / SECOND for step in steps])
    along = moved[..., 2 * axis.place]
    places, lengths = np.cumsum(along, axis=1), np.cumsum(np.abs(along), axis=1)
    ways = np.cumsum(np.hypot(moved[..., 0], moved[..., 1]), axis=1)
    slip_length = 0.1  # distance (m) or turn (rad) over which slip stays constant
    slip = slip_length * np.minimum(lengths[:, :, None], lengths[:, None, :])
    greatest = np.square(axis.share) * (_outer(places) + slip)
    greatest += np.square(axis.bend) * _outer(ways) + np.square(axis.drift) * _outer(seconds[None])
    greatest += np.square(axis.constant) * np.eye(len(steps))
    offset = 1.0  # standard deviation of the unknown place at the start, m or rad
    root = np.linalg.cholesky(greatest / MOST_DEVIATIONS**2 + np.square(offset) + np.diag(seen))
    white = np.linalg.solve(root, (shown - places)[..., None])[..., 0]
    volume = 2.0 * np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)), axis=1)
    return np.sum(np.square(white), axis=1), volume


def _outer(values: Array) -> Array:
    product: Array = values[:, :, None] * values[:, None, :]
    return product
