"""Evidence that a body has moved although its wheels stand: the motion between two scans and its significance.

The latest scan is registered to an earlier one of the robot at rest. The jackknife over sectors of the view (Efron
1982) gives the significance of that motion: a person, door or curtain that moves in one sector contradicts the other
sectors and proves no motion. The stated range noise, an upper bound of the true one, must be an unlikely explanation.
Scan odometry over the scans in between must also be nearer to the registered motion than to standstill.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtri

from monstertruck_estimation.consistency.exchange import Claim, RestEvidence
from monstertruck_estimation.slam.registration import CORRELATION, Cloud, Fit, measure, normal_equations, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between

SECTOR: Final = math.radians(15)
"""Angle of view covered by a person at a distance of 2 m (rad)."""
DIMENSIONS: Final = 3
"""Number of dimensions of a planar motion."""
LEAST: Final = np.finfo(float).tiny
"""Lower bound of a p-value before its conversion to standard deviations."""


class _Sector(NamedTuple):
    """Normal equations of the points in one direction."""

    information: Array
    """Shape (3, 3)."""
    gradient: Array
    """Shape (3,)."""


def rest_evidence(scan: Scan, earlier: Scan, own: Array, claim: Claim, origin: tuple[float, float]) -> RestEvidence:
    """Return the motion since an earlier scan relative to a claimed motion.

    Args:
        scan: latest scan.
        earlier: scan at the start of the claim.
        own: motion between both by scan odometry, shape (3,): start of the registration.
        claim: motion by the wheels.
        origin: position of the sensor in base (m).
    """
    cloud, claimed = Cloud.of(earlier), np.array((*(claim.way or (0.0, 0.0)), claim.turn))
    fit = register(scan, cloud, own)
    if measure(scan, cloud, claimed).cost <= fit.cost or _is_nearer(own, claimed, fit):
        return RestEvidence()
    x, y, turn = between(claimed, fit.pose).tolist()
    sectors, moved = _sectors(scan, cloud, fit.pose, origin), fit.pose - claimed
    unlikely = 1e-3  # maximum p-value of a motion under the stated range noise that the jackknife judges
    if _by_noise(sectors, moved) > unlikely:
        return RestEvidence((x, y, turn))
    return RestEvidence((x, y, turn), -float(ndtri(max(_by_sectors(sectors, moved), LEAST))))


def _is_nearer(own: Array, claimed: Array, fit: Fit) -> bool:
    """Whether the scan odometry is nearer to the claim than to the registered motion."""
    to_claim, to_fit = own - claimed, own - fit.pose
    return bool(to_claim @ fit.information @ to_claim <= to_fit @ fit.information @ to_fit)


def _sectors(scan: Scan, cloud: Cloud, pose: Array, origin: tuple[float, float]) -> list[_Sector]:
    directions = np.arctan2(scan.points[:, 1] - origin[1], scan.points[:, 0] - origin[0])
    numbers = np.floor(directions / SECTOR)
    parts = (normal_equations(scan.chosen(numbers == one), cloud, pose) for one in np.unique(numbers))
    return [_Sector(information, gradient) for information, gradient, pairs in parts if pairs]


def _by_noise(sectors: list[_Sector], motion: Array) -> float:
    """P-value of the motion under independent range noise (chi-square test)."""
    information = np.sum([one.information for one in sectors], axis=0) / CORRELATION
    return float(chdtrc(DIMENSIONS, motion @ information @ motion))


def _by_sectors(sectors: list[_Sector], motion: Array) -> float:
    """P-value of the motion with the jackknife covariance over sectors (Hotelling's test).

    A weak prior, 1 m and 1 rad about standstill, keeps unconstrained directions finite: a direction constrained by a
    single sector stays uncertain.
    """
    count, prior = len(sectors), np.eye(DIMENSIONS)
    freedom = count - DIMENSIONS
    if freedom < 1:
        return 1.0
    information = np.sum([one.information for one in sectors], axis=0) + prior
    gradient = np.sum([one.gradient for one in sectors], axis=0) + prior @ motion
    without = np.stack([information - one.information for one in sectors])
    steps = np.stack([one.gradient - gradient for one in sectors])
    shifts = np.linalg.solve(without, steps[..., None])[..., 0]
    covariance = (count - 1) / count * shifts.T @ shifts
    squared = float(motion @ np.linalg.pinv(covariance, hermitian=True) @ motion)
    return float(fdtrc(DIMENSIONS, freedom, squared * freedom / (DIMENSIONS * (count - 1))))
