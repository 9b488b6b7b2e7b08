import math

import numpy as np
import pytest

from monstertruck_estimation.slam.motion import ScanOdometry
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch, rejected

INFORMATION = np.diag((1e4, 1e5, 1e6))


def match(pose, information=INFORMATION, degeneracy=0.5, direction=0.0, overlap=0.9):
    return ScanMatch(
        np.array(pose),
        np.eye(3),
        overlap,
        0.01,
        degeneracy,
        direction,
        MatchStatus.ACCEPTED,
        np.asarray(information, float),
    )


def take(increments, stamp, pose, *, alone=False, **more):
    made = match(pose, **more)
    return increments.take(stamp, made, made.pose, alone=alone)


def test_the_motion_is_told_in_base_with_the_covariance_of_the_later_place():
    increments = ScanOdometry()
    assert take(increments, 1, (1.0, 0.0, math.pi / 2)) is None
    moved = take(increments, 2, (1.0, 0.5, math.pi / 2))
    assert moved.since == 1
    assert moved.motion == pytest.approx((0.5, 0.0, 0.0))
    sizes = np.sqrt(np.diag(np.array(moved.covariance).reshape(3, 3)))
    # Base looks along y of the map: what is known best across the map's y is known best along base.
    assert sizes[0] == pytest.approx(math.hypot(1e5**-0.5, 0.002), rel=0.01)
    assert sizes[1] == pytest.approx(math.hypot(1e4**-0.5, 0.002), rel=0.01)


def test_without_odometry_rejected_matches_are_stepped_over():
    increments = ScanOdometry()
    take(increments, 1, (0.0, 0.0, 0.0), alone=True)
    lost = rejected(np.array((9.0, 9.0, 9.0)), np.eye(3), MatchStatus.OVERLAP)
    assert increments.take(2, lost, lost.pose, alone=True) is None
    assert take(increments, 3, (0.2, 0.0, 0.0), alone=True).motion == pytest.approx((0.2, 0.0, 0.0))
    assert take(increments, 4, (0.3, 0.0, 0.0), alone=True, overlap=0.4).motion == pytest.approx((0.1, 0.0, 0.0))


def test_beside_odometry_no_motion_is_told_by_or_across_a_misfit():
    increments = ScanOdometry()
    take(increments, 1, (0.0, 0.0, 0.0))
    assert take(increments, 2, (1.0, 1.0, 0.5), overlap=0.4) is None
    assert take(increments, 3, (1.1, 1.0, 0.5)) is None
    assert take(increments, 4, (1.2, 1.0, 0.5)) is not None
    lost = rejected(np.array((9.0, 9.0, 9.0)), np.eye(3), MatchStatus.OVERLAP)
    assert increments.take(5, lost, lost.pose, alone=False) is None
    assert take(increments, 6, (5.0, 0.0, 0.0)) is None


def test_after_a_misfit_the_overlap_must_be_as_usual():
    increments = ScanOdometry()
    take(increments, 1, (0.0, 0.0, 0.0), overlap=0.95)
    assert take(increments, 2, (0.1, 0.0, 0.0), overlap=0.65) is not None
    take(increments, 3, (3.0, 0.0, 0.0), overlap=0.4)
    assert [take(increments, k, (3.1, 0.0, 0.0), overlap=0.7) for k in range(4, 8)] == [None] * 4
    take(increments, 8, (5.0, 0.0, 0.0), overlap=0.9)
    assert take(increments, 9, (5.1, 0.0, 0.0), overlap=0.9).motion == pytest.approx((0.1, 0.0, 0.0))
    take(increments, 10, (5.2, 0.0, 0.0), overlap=0.4)
    increments.forget()
    take(increments, 11, (1.0, 0.0, 0.0), overlap=0.65)
    assert take(increments, 12, (1.1, 0.0, 0.0), overlap=0.65) is not None


def test_a_correction_of_the_map_is_no_motion():
    increments = ScanOdometry()
    first = match((0.0, 0.0, 0.0))
    increments.take(1, first, np.array((5.0, 5.0, 0.0)), alone=True, corrected=True)
    assert take(increments, 2, (5.1, 5.0, 0.0)).motion == pytest.approx((0.1, 0.0, 0.0))
    lost = rejected(np.zeros(3), np.eye(3), MatchStatus.FAR)
    increments.take(3, lost, lost.pose, alone=True, corrected=True)
    assert take(increments, 4, (7.0, 0.0, 0.0), alone=True) is None
    increments.forget()
    assert take(increments, 5, (8.0, 0.0, 0.0)) is None


def test_a_corridor_says_nothing_along_itself():
    increments = ScanOdometry()
    take(increments, 1, (0.0, 0.0, 0.3))
    moved = take(increments, 2, (0.0, 0.0, 0.3), degeneracy=0.01, direction=0.3)
    sizes = np.sqrt(np.diag(np.array(moved.covariance).reshape(3, 3)))
    assert sizes[0] > 10.0
    assert sizes[1] < 0.1
