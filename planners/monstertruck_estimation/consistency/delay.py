"""How much the content of the scans lags behind the robot's motion: their motions compared at shifted times.

A robot that sets off, turns or brakes shows the delay: the scans' steps fit the other measure's steps of some time ago
better than those of now. Steady motion says nothing. Distances and turns are scaled freely, for wheels slip.
"""

from typing import Final, NamedTuple

import numpy as np

from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND

SHIFT: Final = SECOND // 10
"""Step of the delays that are tried, ns."""
LONGEST: Final = 12
"""Greatest delay that is tried, in ``SHIFT``."""
NOISE: Final = (0.006, 0.006)
"""Standard deviation of a step by the scans, m and rad."""
SPREAD: Final = 0.1
"""Its share of the step."""
SCALE: Final = (0.6, 1.4)
"""Limits of the scale."""
FEWEST: Final = 12
"""Steps that are compared at least."""
CLEARLY: Final = 0.7
"""Share of the squared error without a delay beyond the tolerated one below which that with a delay is clear."""
EXCESS: Final = 25.0
"""Least difference of both, in mean squared errors of a step that the delay leaves, or variances of its noise."""


class Delay(NamedTuple):
    """A delay of the scans."""

    seconds: float
    error: float
    """Share of the squared error that it leaves."""


def scan_delay(steps: list[tuple[int, int, float, float]], track: MotionTrack, tolerated: float) -> Delay | None:
    """Delay of the scans against ``track``, where it is clearly more than ``tolerated`` (s).

    Args:
        steps: of the scans: stamps of the earlier and the later one (ns), distance ahead (m) and turn (rad).
        track: of another measure.
        tolerated: delay that is none, s.
    """
    reach = LONGEST * SHIFT
    usable = [row for row in steps if track.covers(row[0] - reach, row[1])]
    if len(usable) < FEWEST:
        return None
    ends = np.array([row[:2] for row in usable])
    scans = np.array([row[2:] for row in usable])
    deviations = np.sqrt(np.square(NOISE) + np.square(SPREAD * scans))
    shifts = SHIFT * np.arange(LONGEST + 1)
    others = track.motions(ends[None, :, 0] - shifts[:, None], ends[None, :, 1] - shifts[:, None])[..., (0, 2)]
    errors = _errors(scans, deviations, others)
    allowed = int(tolerated * SECOND / SHIFT) + 1
    best = int(np.argmin(errors))
    least = float(errors[:allowed].min())
    left = float(errors[best])
    if best < allowed or left > CLEARLY * least or least - left < EXCESS * max(left / len(usable), 1.0):
        return None
    return Delay(best * SHIFT / SECOND, float(errors[best]) / least)


def _errors(scans: Array, deviations: Array, others: Array) -> Array:
    """Sums of squared differences in variances, (k,), for others, (k, n, 2), each column scaled as fits best."""
    weights = 1.0 / np.square(deviations)
    energy = np.sum(weights * np.square(others), axis=1)
    scale = np.clip(np.sum(weights * scans * others, axis=1) / np.maximum(energy, 1e-9), *SCALE)
    sums: Array = np.sum(weights * np.square(scans - scale[:, None, :] * others), axis=(1, 2))
    return sums
