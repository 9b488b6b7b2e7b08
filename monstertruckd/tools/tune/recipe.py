"""The coursework's recipe for the gains of a PD control of the distance from a wall, as a pure procedure.

K_d = 0: raise K_p until it overshoots. Raise K_d until it is calm. Raise K_p again, and repeat until the steady error
is small.
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np


class WallGains(NamedTuple):
    """Gains of the control."""

    k_p: float
    """Rad/s/m."""
    k_d: float
    """Rad/s/m, of the plain difference between two samples."""


class RunVerdict(NamedTuple):
    """Result of one run."""

    overshoot: float
    """Share of the first error."""
    steady: float
    """RMS of the errors in the last third, m."""


def judged(errors: Sequence[float]) -> RunVerdict:
    """Judge a run from the distance errors of its samples, m; the first is the step.

    Raises:
        ValueError: fewer than ten samples.
    """
    smoothed = 4  # samples over which errors are averaged
    if len(errors) < 3 * smoothed + 1:
        raise ValueError(f"{len(errors)} samples: expected at least {3 * smoothed + 1}")
    all_of = np.asarray(errors)
    smooth = np.convolve(all_of, np.ones(smoothed) / smoothed, "valid")
    step = max(abs(float(smooth[0])), 0.03)  # minimum first error, m
    beyond = -np.sign(smooth[0]) * smooth
    steady = all_of[-len(all_of) // 3 :]
    return RunVerdict(max(float(beyond.max()), 0.0) / step, float(np.sqrt(np.mean(steady**2))))


def recipe(k_p: float) -> Generator[WallGains, RunVerdict, WallGains | None]:
    """Generate gains to try; receives each run's verdict.

    Returns:
        Calm gains with the smallest steady error; None if none was calm.
    """
    calm, most = 0.5, 16  # overshoot of calm gains, as a fraction, and runs, at most
    gains, runs = WallGains(k_p, 0.0), 1
    verdict = yield gains
    first_d, raise_d = 0.5, 1.8  # first K_d, as a fraction of K_p, and its growth factor
    raise_p = 1.5, 1.2  # factors of K_p, at first and again later
    # Minimum overshoot, as a fraction of the first error.
    while verdict.overshoot < 0.6 and runs < most and gains.k_p * raise_p[0] <= 60.0:  # k_p that is tried
        gains, runs = WallGains(gains.k_p * raise_p[0], 0.0), runs + 1
        verdict = yield gains
    best: tuple[float, WallGains] | None = None
    while runs < most:
        if verdict.overshoot <= calm:
            if best is None or verdict.steady < best[0]:
                best = verdict.steady, gains
            if verdict.steady <= 0.006:  # maximum small steady error, m, as in the coursework
                break
            gains = WallGains(gains.k_p * raise_p[1], gains.k_d)
        else:
            gains = WallGains(gains.k_p, max(first_d * gains.k_p, raise_d * gains.k_d))
        runs += 1
        verdict = yield gains
    else:
        if verdict.overshoot <= calm and (best is None or verdict.steady < best[0]):
            best = verdict.steady, gains
    return None if best is None else best[1]
