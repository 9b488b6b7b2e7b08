"""Which motion of a robot at rest the scans are asked about."""

import pytest

from monstertruck_estimation.consistency.exchange import StepOutput
from monstertruck_estimation.consistency.rest import ASKED, OVER, RestWatch
from monstertruck_estimation.consistency.tracks import MotionTrack
from monstertruck_runtime.clock import SECOND
from tests.unit.estimation.consistency.kit import PERIOD

DEVIATION = 0.01


def watched(moved, *, scans=60, gap=None, rolls=None):
    """A robot whose scans show ``moved`` m from one to the next, after scan ``gap`` none before; ``rolls``: scan at
    which its wheels turn.
    """
    track, stamp = MotionTrack(), SECOND
    watch = RestWatch(track)
    for k in range(scans):
        stamp = SECOND + k * PERIOD
        since = None if k in (0, gap) else stamp - PERIOD
        if since is None:
            track.begin(stamp)
        else:
            track.add(stamp, (moved, 0.0, 0.0))
        watch.observe(StepOutput(stamp, since, (moved, 0.0, 0.0), (DEVIATION, DEVIATION)), still=k != rolls)
    return watch, stamp


def test_it_asks_about_the_newest_seconds():
    watch, stamp = watched(0.01)
    claim = watch.claim()
    assert claim.since == stamp - OVER
    assert (claim.way, claim.turn) == ((0.0, 0.0), 0.0)


@pytest.mark.parametrize("since", [{"gap": 50}, {"rolls": 49}])
def test_it_asks_about_nothing_from_before_a_gap_or_before_the_wheels_stood(since):
    watch, _ = watched(0.01, **since)
    assert watch.claim().since == SECOND + 50 * PERIOD


def test_it_does_not_ask_about_what_the_registration_does_not_know():
    steps = OVER // PERIOD
    assert watched(0.9 * ASKED * DEVIATION / steps)[0].claim() is None
    assert watched(1.1 * ASKED * DEVIATION / steps)[0].claim() is not None
