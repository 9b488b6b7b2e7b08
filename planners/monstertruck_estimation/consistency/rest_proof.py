"""Evidence that a body has moved although its wheels stand: the motion between two scans and its significance.

The latest scan is registered to an earlier one of the robot at rest. The jackknife over parts of the view (Efron 1982)
gives the significance of that motion: each part in turn is left out and the rest is registered again. A part that moves
by itself, such as a door or a curtain, contradicts the others and proves no motion. All things as narrow as a person
are one part, because people walk the same way: only if the walls alone show the motion is it proven. The stated range
noise, an upper bound of the true one, must be an unlikely explanation. Scan odometry over the scans in between must
also be nearer to the registered motion than to standstill.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc, ndtri

from monstertruck_estimation.consistency.exchange import Claim, RestEvidence
from monstertruck_estimation.slam.movers import narrow
from monstertruck_estimation.slam.registration import CORRELATION, Cloud, Fit, fitting, measure, register
from monstertruck_estimation.slam.scans import Scan
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between

SECTOR: Final = math.radians(15)
"""Angle of view of one part of the walls (rad)."""
DIMENSIONS: Final = 3
"""Number of dimensions of a planar motion."""
LEAST: Final = np.finfo(float).tiny
"""Lower bound of a p-value before its conversion to standard deviations."""


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
    moved = fit.pose - claimed
    unlikely = 1e-3  # maximum p-value of a motion under the stated range noise that the jackknife judges
    if _by_noise(fit, moved) > unlikely:
        return RestEvidence((x, y, turn))
    poses = _jackknife(scan, cloud, fit.pose, claimed, _parts(scan, origin))
    return RestEvidence((x, y, turn), -float(ndtri(max(_by_parts(poses - fit.pose, moved), LEAST))))


def _is_nearer(own: Array, claimed: Array, fit: Fit) -> bool:
    """Whether the scan odometry is nearer to the claim than to the registered motion."""
    to_claim, to_fit = own - claimed, own - fit.pose
    return bool(to_claim @ fit.information @ to_claim <= to_fit @ fit.information @ to_fit)


def _by_noise(fit: Fit, motion: Array) -> float:
    """P-value of the motion under independent range noise (chi-square test)."""
    return float(chdtrc(DIMENSIONS, motion @ fit.information @ motion / CORRELATION))


def _parts(scan: Scan, origin: tuple[float, float]) -> NDArray[np.int64]:
    """Return the part of the view of each point, shape (n,)."""
    directions = np.arctan2(scan.points[:, 1] - origin[1], scan.points[:, 0] - origin[0])
    sectors = np.floor((directions + math.pi) / SECTOR).astype(np.int64)
    things = -1
    sectors[narrow(scan.points, np.ones(len(scan), np.bool_))] = things
    return sectors


def _jackknife(scan: Scan, cloud: Cloud, pose: Array, claimed: Array, parts: NDArray[np.int64]) -> Array:
    """Return the registered poses without one part each, shape (parts, 3), for the parts that fit at ``pose``.

    A linear step from ``pose`` would be too short, because the other points were paired at ``pose``. A weak prior, 1 m
    and 1 rad about the claim, keeps unconstrained directions finite: a direction constrained by a single part stays
    uncertain.
    """
    prior, fitted = np.eye(DIMENSIONS), np.unique(parts[fitting(scan, cloud, pose)])
    rest = (scan.chosen(parts != one) for one in fitted)
    return np.array([register(one, cloud, claimed, prior, start=pose).pose for one in rest])


def _by_parts(shifts: Array, motion: Array) -> float:
    """P-value of the motion with the jackknife covariance (Hotelling's test).

    Args:
        shifts: shape (parts, 3), changes of the registered pose without one part each.
        motion: shape (3,).
    """
    count = len(shifts)
    freedom = count - DIMENSIONS
    if freedom < 1:
        return 1.0
    covariance = (count - 1) / count * shifts.T @ shifts
    squared = float(motion @ np.linalg.pinv(covariance, hermitian=True) @ motion)
    return float(fdtrc(DIMENSIONS, freedom, squared * freedom / (DIMENSIONS * (count - 1))))
