"""Scan matchers: the pose of a scan in a submap, given a predicted pose; every result passes the same gate."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import numpy as np

from monstertruck_estimation.slam.correlation import Submap, correlate
from monstertruck_estimation.slam.registration import Fit, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.base import position_deviation

LIKELY: Final = 3.0
"""Likely range of a predicted pose, in standard deviations.

It is the half width of a search around the pose, and the gate (Mahalanobis) of matches that overlap less than
``LOW_OVERLAP``.
"""
LOW_OVERLAP: Final = 0.6
"""Overlap below which a match is compared with a result of the wide search."""


class MatchStatus(StrEnum):
    """Reason why a match was accepted or rejected."""

    ACCEPTED = "accepted"
    EMPTY = "empty"
    OVERLAP = "overlap"
    FAR = "far"
    CONTRADICTED = "contradicted"
    """Beams of the scan pass through walls of the map, or beams of the map through objects in the scan."""
    UNSURE = "unsure"
    """After a gap in the scans the robot may be anywhere, so a single fitting place is insufficient."""


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Pose of a scan in a submap, with its uncertainty and quality."""

    pose: Array
    """Pose, shape (3,) (m, rad); the guess if the match is rejected."""
    covariance: Array
    """Covariance of ``pose``, shape (3, 3); the guess's covariance if the match is rejected."""
    overlap: float
    """Share of the points that fit, 0..1."""
    residual: float
    """Root mean square distance across the surfaces (m)."""
    degeneracy: float
    """Ratio of the smaller to the greater eigenvalue of the position's information, 0..1; near 0 in a corridor."""
    direction: float
    """Yaw of the weakest direction in the submap's frame (rad), in [-pi/2, pi/2]."""
    verdict: MatchStatus
    information: Array | None = None
    """Inverse covariance by the scan alone, without the guess, shape (3, 3); None if the match is rejected."""
    moving: float = 0.0
    """Fraction of the scan's points removed as moving, 0..1."""

    @property
    def accepted(self) -> bool:
        """Whether the match passed the gate; otherwise its pose is the predicted one."""
        return self.verdict is MatchStatus.ACCEPTED

    @property
    def degenerate(self) -> bool:
        """Whether the scan leaves the position undetermined along ``direction``, or may be determined only by people.

        People are round and constrain all directions equally. As many points as were left out may move undetected; they
        can explain an eigenvalue ratio up to their share.
        """
        # A match is degenerate (a corridor) below this ratio of the eigenvalues of the information on the position.
        degenerate_ratio = 0.03
        return self.degeneracy < max(degenerate_ratio, self.moving)


class ScanMatcher(Protocol):
    """Scan registration, possibly with a separate map."""

    def match(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        """Return the pose of ``scan`` in the submap's frame.

        Args:
            scan: points in base.
            delta: predicted motion of the base since the last scan, shape (3,).
            guess: resulting pose in the submap's frame, shape (3,).
            covariance: covariance of ``guess``, shape (3, 3).
            submap: the map around the predicted pose.
        """


class PlanarMatcher:
    """Correlation in a window set by the guess's covariance, then generalised ICP with the guess as prior.

    Every piece of surface is weighted by its length, not by its number of beams. A match that is rejected or overlaps
    little is repeated in a window three times as wide, because wheels slip further than their covariance; the new
    result must overlap more.
    """

    def match(self, scan: Scan, delta: Array, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        """See ``ScanMatcher``."""
        # Edge of the squares whose mean points are matched, m: weighted by beams, a person or robot beside the lidar
        # would outweigh all walls.
        spacing = 0.04
        scan = scan.averaged(spacing)
        if not (enough(len(scan)) and enough(len(submap.cloud))):
            return rejected(guess, covariance, MatchStatus.EMPTY)
        match = self._match_in_window(scan, guess, covariance, submap)
        if match.accepted and match.overlap >= LOW_OVERLAP:
            return match
        wide_overlap_gain = 0.15  # minimum gain in overlap over the first match
        least = match.overlap + wide_overlap_gain if match.accepted else 0.0
        wide_factor = 3.0  # factor on the standard deviation of the predicted pose in the wide search
        again = self._match_in_window(scan, guess, covariance * wide_factor**2, submap)
        if again.accepted and again.overlap >= max(0.5, least):  # minimum overlap of a result of the wide search
            return again
        return match

    def _match_in_window(self, scan: Scan, guess: Array, covariance: Array, submap: Submap) -> ScanMatch:
        deviation = deviations(covariance)
        margin = 0.15  # allowance for disagreeing stamps of odometry and scans, m
        max_window = (2.0, 1.6)  # maximum half width of the search, m and rad
        window = min(LIKELY * deviation[0] + margin, max_window[0]), min(LIKELY * deviation[1], max_window[1])
        prior: Array = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        coarse_points = 160  # number of points in the correlative search
        points = scan.points[np.linspace(0, len(scan) - 1, min(len(scan), coarse_points)).astype(np.intp)]
        min_score = 0.2  # minimum mean likelihood of a result of the correlative search
        levels = 4  # levels of its likelihood pyramid
        peak = correlate(submap.grid(levels), points, guess, window, deviation, min_score)
        fit = register(scan, submap.cloud, guess, prior)
        if peak is not None:
            other = register(scan, submap.cloud, guess, prior, start=peak.pose)
            if other.cost < fit.cost:
                fit = other
        return gated(fit, guess, covariance)


def gated(fit: Fit, guess: Array, covariance: Array) -> ScanMatch:
    """Accept or reject a fit with predicted pose ``guess`` and its ``covariance``, shape (3, 3)."""
    ratio, direction = degeneracy(fit.information)
    verdict = MatchStatus.ACCEPTED
    gate = 6.0 if fit.overlap >= LOW_OVERLAP else LIKELY  # maximum Mahalanobis distance from the predicted pose
    if not enough(fit.pairs):
        verdict = MatchStatus.EMPTY
    elif fit.overlap < 0.35:  # minimum share of a scan's points that fit the submap
        verdict = MatchStatus.OVERLAP
    elif off_guess(fit.pose, guess, covariance) > gate:
        verdict = MatchStatus.FAR
    posterior = np.linalg.inv(fit.information + np.linalg.inv(covariance))
    if verdict is not MatchStatus.ACCEPTED:
        return ScanMatch(guess, covariance, fit.overlap, fit.residual, ratio, direction, verdict)
    return ScanMatch(fit.pose, posterior, fit.overlap, fit.residual, ratio, direction, verdict, fit.information)


def enough(pairs: int) -> bool:
    """Whether this number of pairs can determine a pose."""
    return pairs >= 12


def off_guess(pose: Array, guess: Array, covariance: Array) -> float:
    """Return the Mahalanobis distance of ``pose`` from ``guess``, both shape (3,), with its ``covariance``, (3, 3)."""
    off = difference(pose, guess)
    return math.sqrt(float(off @ np.linalg.solve(covariance, off)))


def difference(pose: Array, other: Array) -> Array:
    """Return the difference of two poses in the frame of both, shape (3,) (m, rad)."""
    off = pose - other
    off[2] = math.remainder(off[2], math.tau)
    return off


def rejected(guess: Array, covariance: Array, verdict: MatchStatus) -> ScanMatch:
    """Return a rejected match: its pose is the guess."""
    return ScanMatch(guess, covariance, 0.0, 0.0, 0.0, 0.0, verdict)


def deviations(covariance: Array) -> tuple[float, float]:
    """Return the maximum standard deviation of the position (m) and the standard deviation of the yaw (rad)."""
    return position_deviation(covariance), math.sqrt(max(float(covariance[2, 2]), 0.0))


def degeneracy(information: Array) -> tuple[float, float]:
    """Return the eigenvalue ratio of the position's information (yaw unknown), and the yaw of the weakest direction."""
    by_yaw = max(float(information[2, 2]), 1e-9)
    position = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / by_yaw
    values, vectors = np.linalg.eigh(position)
    if values[1] <= 0:
        return 0.0, 0.0
    yaw = math.atan2(vectors[1, 0], vectors[0, 0])
    return max(float(values[0] / values[1]), 0.0), math.remainder(yaw, math.pi)
