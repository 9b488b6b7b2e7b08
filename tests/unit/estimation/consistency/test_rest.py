"""Which motion of a robot at rest the scans are asked about."""

import pytest

from monstertruck_estimation.consistency.exchange import RestEvidence, StepOutput
from monstertruck_estimation.consistency.rest import OVER, RestWatch
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.consistency.kit import PERIOD

PROVEN = RestEvidence((0.02, 0.0, 0.1), 6.0)


def watched(*, scans=60, gap=None, rolls=None, creeps=0.0, rest=None):
    """A robot whose wheels stand, after scan ``gap`` none before; ``rolls``: scan at which its wheels turn."""
    track, stamp = MotionTrack(), SECOND
    watch = RestWatch(track, 0.3)
    for k in range(scans):
        stamp = SECOND + k * PERIOD
        track.add(stamp, (0.01 if k == rolls else creeps, 0.0, 0.0))
        watch.claim(stamp, stamp)
        watch.observe(StepOutput(stamp, None if k in (0, gap) else stamp - PERIOD, rest=rest))
    track.add(stamp + PERIOD, (creeps, 0.0, 0.0))
    return watch, stamp


def test_it_asks_about_the_newest_seconds():
    watch, stamp = watched()
    claim = watch.claim(stamp + PERIOD, stamp + PERIOD)
    assert claim.since == stamp - OVER
    assert (claim.way, claim.turn) == ((0.0, 0.0), 0.0)


@pytest.mark.parametrize("since", [{"gap": 50}, {"rolls": 49}])
def test_it_asks_about_nothing_from_before_a_gap_or_before_the_wheels_stood(since):
    watch, stamp = watched(**since)
    assert watch.claim(stamp + PERIOD, stamp + PERIOD).since == SECOND + 50 * PERIOD


def test_it_asks_from_the_first_scan_after_the_wheels_stopped():
    watch, stamp = watched(rolls=59)
    assert watch.claim(stamp + PERIOD, stamp + PERIOD) is None
    watch, stamp = watched(rolls=58)
    assert watch.claim(stamp + PERIOD, stamp + PERIOD).since == stamp


def test_what_is_proven_is_not_asked_about_again():
    watch, stamp = watched(rest=PROVEN)
    assert watch.motion.stamp == stamp
    assert watch.motion.since == stamp - PERIOD
    assert (watch.motion.distance, watch.motion.turn) == (0.02, 0.1)
    assert watched(rest=RestEvidence(PROVEN.motion, 4.9))[0].motion is None


def test_wheels_that_creep_explain_their_own_motion_and_slip():
    watch, stamp = watched(creeps=0.0019, rest=RestEvidence(PROVEN.motion, 0.0))
    way = watch.claim(stamp + PERIOD, stamp + PERIOD).way[0]
    assert way == pytest.approx(0.0019 * (OVER / PERIOD + 1))
    watch, stamp = watched(creeps=0.0019, rest=PROVEN)
    assert watch.motion.distance == pytest.approx(0.02 - 0.3 * 0.0019)


def test_a_scan_in_which_the_wheels_set_off_proves_nothing():
    track = MotionTrack()
    watch = RestWatch(track, 0.3)
    for k in range(20):
        stamp = SECOND + k * PERIOD
        track.add(stamp, (0.0, 0.0, 0.0))
        watch.observe(StepOutput(stamp, None if k == 0 else stamp - PERIOD))
    track.add(stamp + PERIOD // 2, (0.0, 0.0, 0.0))
    assert watch.claim(stamp, stamp + PERIOD) is not None
    track.add(stamp + PERIOD, (0.01, 0.0, 0.0))
    assert watch.claim(stamp, stamp + PERIOD) is None
