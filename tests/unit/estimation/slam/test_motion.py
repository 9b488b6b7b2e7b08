import itertools
import math

import numpy as np
import pytest

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.motion import ClockOffsetEstimator, MotionPredictor, OdometryCheck, ScanOdometry
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch, rejected
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.health import OdometryUse

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


def test_the_motion_is_reported_in_base_with_the_covariance_of_the_later_place():
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


def test_with_odometry_no_motion_is_reported_by_or_across_a_misfit():
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


STEP = np.array((0.05, 0.0, 0.02))
"""Motion of a tenth of a second."""


def compared(check, wrong, count, motion=STEP):
    """Takes ``count`` motions by the scans and what odometry makes of them."""
    for _ in range(count):
        check.add(0.1, motion * wrong, motion)
    return check


@pytest.mark.parametrize(
    "wrong", [(1, 1, -1), (0, 0, 0), (0.5, 0.5, 0.5), (2, 2, 2)], ids=["mirrored", "stuck", "half", "double"]
)
def test_odometry_that_the_scans_contradict_is_dropped_within_five_seconds(wrong):
    check = compared(OdometryCheck(), 1.0, 100)
    assert not check.contradicted
    assert compared(check, np.array(wrong), 50).contradicted
    assert 0.5 < check.since <= 5.5


@pytest.mark.parametrize("wrong", [0.5, 2.0], ids=["half", "double"])
def test_a_slow_robots_odometry_is_judged_over_as_much_way(wrong):
    """At 0.1 m/s no error of half the way exceeds what clocks may do within 5 s."""
    assert compared(OdometryCheck(), wrong, 125, np.array((0.01, 0.0, 0.0))).contradicted


def test_misfits_do_not_forget_what_was_compared_before():
    check = OdometryCheck()
    for _ in range(5):
        compared(check, 0.5, 8)
        check.interrupt(0.1)
    assert check.contradicted


def test_what_a_match_makes_up_for_after_a_misfit_is_no_motion():
    model, place = MotionPredictor(MapperConfig()), np.zeros(3)
    for k in range(100):
        delta, noise = model.predict(0.1, np.array((0.05 * k, 0.0, 0.0)))
        misfit = k % 5 == 4
        moved = delta if misfit else delta + np.array((0.3 if k % 5 == 0 else 0.0, 0.0, 0.0))
        made = rejected(place, np.eye(3), MatchStatus.FAR) if misfit else match((0.0, 0.0, 0.0))
        model.learn(0.1, delta, noise, moved, made)
    assert model.use is OdometryUse.USED


def test_the_noise_of_matches_while_the_robot_stands_is_no_way():
    check, rng = OdometryCheck(), np.random.default_rng(1)
    places = rng.normal(0.0, (0.006, 0.006, 0.003), (5000, 3))
    for before, after in itertools.pairwise(places):
        check.add(0.1, np.zeros(3), between(before, after))
    assert not check.contradicted


def test_odometry_of_ordinary_error_is_used():
    assert not compared(OdometryCheck(), np.array((1.15, 1.0, 0.85)), 300).contradicted


def test_a_turn_of_the_wrong_sign_is_not_used_again_for_driving_straight():
    check = compared(OdometryCheck(), np.array((1, 1, -1)), 60)
    assert compared(check, 1.0, 200, np.array((0.05, 0.0, 0.0))).contradicted
    assert not compared(check, 1.0, 200).contradicted


def test_one_late_odometry_is_no_contradiction():
    check = compared(OdometryCheck(), 1.0, 50)
    for wrong in (0.0, 2.0):
        check.add(0.3, wrong * STEP * 10, STEP * 10)
    assert not compared(check, 1.0, 50).contradicted


def test_late_stamps_at_both_ends_of_a_comparison_are_no_contradiction():
    check = OdometryCheck()
    step = np.array((0.1, 0.0, 0.0))
    ahead = np.zeros(30)
    ahead[15], ahead[18:20] = 0.3, -0.15
    for before, after in itertools.pairwise(ahead):
        check.add(0.3, step + np.array((after - before, 0.0, 0.0)), step)
        assert not check.contradicted


def misled(wrong, **more):
    """A model after 10 s of odometry that makes ``wrong`` of every motion, and what it predicts of the next one."""
    model, odom = MotionPredictor(MapperConfig()), np.zeros(3)
    for _ in range(100):
        delta, noise = model.predict(0.1, odom)
        model.learn(0.1, delta, noise, STEP, match(tuple(STEP), **more))
        odom = compose(odom, STEP * wrong)
    assert model.use is OdometryUse.CONTRADICTED
    return model.predict(0.1, compose(odom, (2.0, 0.0, 2.0) * STEP * wrong))[0]


def test_ways_by_odometry_count_on_if_only_its_turns_are_wrong():
    assert misled(np.array((1, 1, -1))) == pytest.approx((3 * STEP[0], 0.0, STEP[2]), abs=5e-3)


def test_turns_by_odometry_count_on_if_only_its_ways_are_wrong():
    assert misled(np.array((2, 2, 1))) == pytest.approx((STEP[0], 0.0, 3 * STEP[2]), abs=5e-3)


def test_nothing_of_odometry_counts_if_both_are_wrong():
    assert misled(np.array((2, 2, 2))) == pytest.approx(STEP, abs=5e-3)


def test_ways_that_no_scan_saw_do_not_count_on():
    """In a corridor the way is compared with itself."""
    assert misled(np.array((1, 1, -1)), degeneracy=0.01) == pytest.approx(STEP, abs=5e-3)


def test_wheels_that_are_stuck_while_the_robot_turns_on_the_spot_say_nothing_of_its_way():
    check = OdometryCheck()
    for k in range(20):
        check.add(0.3, np.zeros(3), np.array((0.02 * (-1) ** k, 0.0, 0.2)))
    assert check.contradicted
    assert check.kept == (False, False)


def alone(times, motions):
    """What a model without odometry predicts of each of the ``motions`` in ``times``, s."""
    model, predicted = MotionPredictor(MapperConfig()), []
    for dt, moved in zip(times, motions, strict=True):
        delta, noise = model.predict(dt, None)
        model.learn(dt, delta, noise, moved, match(tuple(moved)))
        predicted.append(delta)
    return np.array(predicted)


def test_scans_stamped_in_bursts_do_not_make_the_robot_leap():
    times, motions = np.tile((0.001, 0.4), 50), np.tile(STEP, (100, 1))
    motions[80:83] = 4 * STEP, -2 * STEP, STEP  # two scans were exchanged
    assert alone(times, motions)[10:] == pytest.approx(np.tile(STEP, (90, 1)), abs=1e-9)


def test_a_pause_makes_the_way_longer_where_the_stamps_are_right():
    times = np.tile((0.1, 0.2), 50)
    motions = times[:, None] * STEP
    assert alone(times, motions)[10:] == pytest.approx(motions[10:])


def test_a_corridor_does_not_contradict_the_way_by_odometry():
    model = MotionPredictor(MapperConfig())
    for k in range(100):
        delta, noise = model.predict(0.1, np.array((0.05 * k, 0.0, 0.0)))
        model.learn(0.1, delta, noise, np.zeros(3), match((0.0, 0.0, 0.0), degeneracy=0.01))
    assert model.use is OdometryUse.USED


def test_noise_of_turns_is_learned():
    model = MotionPredictor(MapperConfig())
    for k in range(200):
        delta, noise = model.predict(0.1, np.array((0.05 * k, 0.0, 0.0)))
        moved = delta + np.array((0.0, 0.0, 0.15 * (-1) ** k))
        model.learn(0.1, delta, noise, moved, match((0.0, 0.0, 0.0)))
    assert model.factors[0] == 1.0
    assert model.factors[1] > 2.0


def test_the_first_odometry_after_a_gap_is_no_motion():
    model = MotionPredictor(MapperConfig())
    model.predict(0.1, np.zeros(3))
    for _ in range(30):
        model.predict(0.1, np.full(3, np.nan))
    assert model.use is OdometryUse.MISSING
    delta, _ = model.predict(0.1, np.array((1.0, 0.0, 0.5)))
    assert delta.tolist() == [0.0, 0.0, 0.0]
    delta, _ = model.predict(0.1, np.array((1.1, 0.0, 0.5)))
    assert np.hypot(*delta[:2]) == pytest.approx(0.1)
    assert model.use is OdometryUse.USED


def test_odometry_that_was_never_a_number_is_missing():
    motion = MotionPredictor(MapperConfig())
    motion.predict(0.1, None)
    assert motion.use is OdometryUse.NONE
    motion.predict(0.1, np.full(3, np.nan))
    assert motion.use is OdometryUse.MISSING
    motion.predict(0.1, np.zeros(3))
    assert motion.use is OdometryUse.USED


def test_a_yaw_that_is_no_number_makes_no_time_offset():
    clocks, yaw = ClockOffsetEstimator(), 0.0
    for k in range(240):
        yaw += 0.05 * math.sin(k / 7)
        clocks.add((k + 1) * SECOND // 10, yaw, math.nan if k == 100 else yaw)
    assert clocks.offset is None
