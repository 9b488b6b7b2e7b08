"""Front ends: where a scan was taken, given a guess and the submap around it; each result judged the same way."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.correlation import Submap, correlate
from monstertruck_estimation.slam.registration import Fit, register
from monstertruck_estimation.slam.scans import Scan

Array = NDArray[np.float64]

LEAST_PAIRS: Final = 12
"""Pairs without which nothing is known."""
LEAST_OVERLAP: Final = 0.35
"""Share of a scan's points that must fit the submap."""
LEAST_SCORE: Final = 0.2
"""Mean likelihood under which the coarse search found nothing."""
WINDOW: Final = 3.0
"""Half width of the coarse search in standard deviations of the guess."""
MARGIN: Final = 0.15
"""What is added to that, m: stamps of wheels and scans disagree."""
WIDEST: Final = (2.0, 1.6)
"""Most of that, m and rad."""
CREDIBLE: Final = 6.0
"""A match further off the guess than this many standard deviations is not believed."""
MODEST: Final = 3.0
"""The same for a match that overlaps less than ``DOUBTFUL``."""
DOUBTFUL: Final = 0.6
"""Matches that overlap less are compared with one from further away."""
LEAST_AFAR: Final = 0.5
"""Overlap of a match that is believed from far away."""
CLEARLY: Final = 0.15
"""How much more it must overlap than the one close by."""
WIDER: Final = 3.0
"""How much further that search looks."""
COARSE_POINTS: Final = 160
"""Points of a scan in the coarse search."""
LEVELS: Final = 4
"""Levels of the coarse search's pyramid."""
WEAK: Final = 0.03
"""Ratio of the eigenvalues of the information on the position under which the surroundings are a corridor."""


class Verdict(StrEnum):
    """What became of a match."""

    ACCEPTED = "accepted"
    EMPTY = "empty"
    OVERLAP = "overlap"
    FAR = "far"


@dataclass(frozen=True, slots=True)
class Match:
    """A scan's place in a submap and what it is worth."""

    pose: Array
    """Shape (3,), m and rad; the guess if the match is rejected."""
    covariance: Array
    """Shape (3, 3), of ``pose``; the guess's if the match is rejected."""
    overlap: float
    """Share of the points that fit, 0..1."""
    residual: float
    """Root mean square distance across the surfaces, m."""
    degeneracy: float
    """Smaller eigenvalue of the information on the position over the greater one, 0..1: near 0 in a corridor."""
    direction: float
    """Yaw of the weakest direction in the submap's frame, rad, in [-pi/2, pi/2]."""
    verdict: Verdict
    information: Array | None = None
    """Shape (3, 3), inverse covariance by the scan alone, without the guess; None if the match is rejected."""

    @property
    def accepted(self) -> bool:
        """Whether the pose is the match's, not the guess."""
        return self.verdict is Verdict.ACCEPTED

    @property
    def degenerate(self) -> bool:
        """Whether the scan says next to nothing along ``direction``."""
        return self.degeneracy < WEAK


class FrontEnd(Protocol):
    """Registers scans; may keep a map of its own."""

    def locate(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> Match:
        """Pose of ``scan`` in the submap's frame.

        Args:
            scan: points in base.
            delta: shape (3,), predicted motion of the base since the last scan.
            guess: shape (3,), pose predicted by it in the submap's frame.
            covariance: shape (3, 3), of ``guess``.
            submap: what is known around.
        """
        ...


class Planar:
    """Correlation in a window given by the guess's covariance, then generalised ICP with the guess as prior.

    What does not fit there is searched for once more in a window ``WIDER`` times as wide, because wheels slip further
    than any covariance says; a place found that way must fit better (``LEAST_AFAR``).
    """

    def locate(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> Match:
        """See ``FrontEnd``."""
        if len(scan) < LEAST_PAIRS or len(submap.cloud) < LEAST_PAIRS:
            return rejected(guess, covariance, Verdict.EMPTY)
        match = self._locate(scan, guess, covariance, submap)
        if match.accepted and match.overlap >= DOUBTFUL:
            return match
        least = match.overlap + CLEARLY if match.accepted else 0.0
        again = self._locate(scan, guess, covariance * WIDER**2, submap)
        if again.accepted and again.overlap >= max(LEAST_AFAR, least):
            return again
        return match

    def _locate(self, scan: Scan, guess: Array, covariance: Array, submap: Submap) -> Match:
        deviation = deviations(covariance)
        window = min(WINDOW * deviation[0] + MARGIN, WIDEST[0]), min(WINDOW * deviation[1], WIDEST[1])
        prior: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        points = scan.points[np.linspace(0, len(scan) - 1, min(len(scan), COARSE_POINTS)).astype(np.intp)]
        peak = correlate(submap.grid(LEVELS), points, guess, window, deviation, LEAST_SCORE)
        fit = register(scan, submap.cloud, guess, prior)
        if peak is not None:
            other = register(scan, submap.cloud, guess, prior, start=peak.pose)
            if other.cost < fit.cost:
                fit = other
        return judge(fit, guess, covariance)


def judge(fit: Fit, guess: Array, covariance: Array) -> Match:
    """Accept or reject a fit that started at ``guess`` (covariance of that: shape (3, 3))."""
    ratio, direction = degeneracy(fit.information)
    verdict = Verdict.ACCEPTED
    off = fit.pose - guess
    off[2] = math.remainder(off[2], math.tau)
    if fit.pairs < LEAST_PAIRS:
        verdict = Verdict.EMPTY
    elif fit.overlap < LEAST_OVERLAP:
        verdict = Verdict.OVERLAP
    elif float(off @ np.linalg.solve(covariance, off)) > (CREDIBLE if fit.overlap >= DOUBTFUL else MODEST) ** 2:
        verdict = Verdict.FAR
    posterior = np.linalg.inv(fit.information + np.linalg.inv(covariance))
    if verdict is not Verdict.ACCEPTED:
        return Match(guess, covariance, fit.overlap, fit.residual, ratio, direction, verdict)
    return Match(fit.pose, posterior, fit.overlap, fit.residual, ratio, direction, verdict, fit.information)


def rejected(guess: Array, covariance: Array, verdict: Verdict) -> Match:
    """The guess, for want of anything better."""
    return Match(guess, covariance, 0.0, 0.0, 0.0, 0.0, verdict)


def deviations(covariance: Array) -> tuple[float, float]:
    """Greatest standard deviation of the position (m) and that of the yaw (rad)."""
    (a, b), (_, d) = covariance[:2, :2].tolist()
    greatest = (a + d) / 2 + math.hypot((a - d) / 2, b)
    return math.sqrt(max(greatest, 0.0)), math.sqrt(max(float(covariance[2, 2]), 0.0))


def degeneracy(information: Array) -> tuple[float, float]:
    """Ratio of the eigenvalues of the information on the position (the yaw unknown); yaw of the weakest direction."""
    by_yaw = max(float(information[2, 2]), 1e-9)
    position = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / by_yaw
    values, vectors = np.linalg.eigh(position)
    if values[1] <= 0:
        return 0.0, 0.0
    yaw = math.atan2(vectors[1, 0], vectors[0, 0])
    return max(float(values[0] / values[1]), 0.0), math.remainder(yaw, math.pi)
