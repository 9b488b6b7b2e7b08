"""All ranges change by one factor from one revolution to the next."""

import math

import numpy as np
import pytest

from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.exchange import StepOutput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.scale import Revolution, ScaleWatch, scale_change
from monstertruck_estimation.slam.scans import ScanGeometry, prepare
from monstertruck_kinematics.se2 import compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import DoubtKind
from tests.unit.estimation.consistency.kit import PERIOD, SENSORS, Lies, drive, straight
from tests.unit.estimation.slam.kit import HALL, LIDAR, box, ranges

LANE = straight(start=(-4.5, 2.0, 0.0))


def changed(factor, at=40):
    return lambda k, seen: seen[k] * (factor if k >= at else 1.0)


@pytest.mark.parametrize("front", ["own", "kiss"])
@pytest.mark.parametrize("factor", [0.3, 0.5, 0.8, 1.3, 2.0])
def test_a_change_is_found_at_once(factor, front):
    trial = drive(HALL, LANE, Lies(scan=changed(factor)), front=front)
    doubt = trial.found["lidar"]
    assert doubt.kind is DoubtKind.SCALE
    assert "switch the lidar off for more than 2 s" in doubt.text
    assert doubt.difference == pytest.approx(abs(factor - 1.0), abs=0.03)
    assert trial.at["lidar"] == pytest.approx(21 * 0.025, abs=0.03), "at the first revolution"


def test_a_change_at_rest_is_found_though_the_robot_is_not_armed():
    trial = drive(HALL, LANE, Lies(scan=changed(0.5, at=10)), armed=1000)
    assert trial.found["lidar"].kind is DoubtKind.SCALE
    assert trial.at["lidar"] == 0.0


def test_a_part_of_the_view_that_a_hand_covers_is_no_change():
    def covered(k, seen):
        return np.where(np.arange(len(seen[k])) < 100, seen[k] * (0.2 if k >= 40 else 1.0), seen[k])

    found = drive(HALL, LANE, Lies(scan=covered)).found
    assert not any(doubt.kind is DoubtKind.SCALE for doubt in found.values())


def revolution(seen, geometry=LIDAR):
    return Revolution(prepare(seen, geometry), (0.0, 0.0))


@pytest.mark.parametrize("beams", [448, 449, 451])
def test_a_change_is_found_though_the_number_of_beams_and_the_first_ones_bearing_vary(beams):
    """As of heads whose speed varies: LD19, RPLIDAR."""
    pose, earlier = np.array(LANE[0][:3], float), ScanGeometry(math.pi, -math.tau / 450, 0.02, 12.0)
    newest = ScanGeometry(math.pi - 0.01, -math.tau / beams, 0.02, 12.0)
    before, after = ranges(HALL, pose, earlier, 450), ranges(HALL, pose, newest, beams)
    for factor in (0.6, 1.5):
        found = scale_change(revolution(factor * after, newest), revolution(before, earlier), [np.zeros(3)])
        assert found == pytest.approx(factor, rel=0.01)
    assert scale_change(revolution(after, newest), revolution(before, earlier), [np.zeros(3)]) == 1.0


@pytest.mark.parametrize("motion", [(0.08, 0.0, 0.0), (0.05, 0.0, 0.1)])
def test_motion_between_the_revolutions_does_not_change_the_factor(motion):
    """The change and the change back of a driving robot's lidar cancel each other."""
    pose = np.array(LANE[0][:3], float)
    before, after = ranges(HALL, pose), ranges(HALL, compose(pose, np.array(motion)))
    for factor in (0.3, 1.6):
        found = scale_change(revolution(factor * after), revolution(before), [np.zeros(3), np.array(motion)])
        assert found == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize("seed", [17, 22, 35, 38])
def test_another_place_is_no_change_of_scale(seed):
    """Scans that came late end at once: the lidar shows a place far from the one before."""
    rng, lane = np.random.default_rng(seed), box(-1.1, -6.0, 1.1, 6.0)
    sheet = ScanGeometry(math.pi, -math.tau / 450, 0.02, 12.0, noise=0.0225)
    poses = np.column_stack((rng.uniform(-1.0, 1.0, 2), rng.uniform(-0.95, 0.95, 2), rng.uniform(-3.0, 3.0, 2)))
    before, after = (revolution(ranges(lane, pose, sheet, 450, 0.02, rng), sheet) for pose in poses)
    assert scale_change(after, before, [np.zeros(3), np.array((0.08, 0.0, 0.0))]) in (None, 1.0)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_a_change_in_the_middle_of_a_revolution_is_found_at_the_next_one(share):
    pose, watch = np.array(LANE[0][:3], float), ScaleWatch()
    clean = ranges(HALL, pose)
    later = np.arange(len(clean)) >= share * len(clean)
    seen = (clean, clean, np.where(later, 1.6 * clean, clean), 1.6 * clean, np.where(later, clean, 1.6 * clean), clean)
    found = [watch.change(revolution(one), [np.zeros(3), np.zeros(3)]) for one in seen]
    assert found[:2] == [None, None]
    assert math.prod(factor for factor in found[2:4] if factor) == pytest.approx(1.6, rel=0.01)
    assert math.prod(factor for factor in found[2:] if factor) == pytest.approx(1.0, abs=0.02), "and changed back"


def test_ranges_that_change_back_unnoticed_are_sound_once_they_fit_those_before_the_change():
    """Over several revolutions, none of which fits the one before by motion or by a factor."""
    pose, watch = np.array(LANE[0][:3], float), ScaleWatch()
    clean, beams = ranges(HALL, pose), np.arange(len(ranges(HALL, pose)))
    back = [np.where(beams < share * len(clean), clean, 1.6 * clean) for share in (0.25, 0.5, 0.75)]
    found = [watch.change(revolution(one), [np.zeros(3)] * 2) for one in (clean, 1.6 * clean, *back, clean, clean)]
    assert found[1] == pytest.approx(1.6, rel=0.01)
    assert math.prod(factor for factor in found if factor) == pytest.approx(1.0)


@pytest.mark.parametrize(("factor", "first"), [(1.1, 140), (1.15, 160), (1.25, 180), (0.8, 120)])
def test_one_wall_beside_a_cover_does_not_show_that_the_ranges_have_changed_back(factor, first):
    """Its points fit the ranges before the change by a translation."""
    pose, watch = np.array(LANE[0][:3], float), ScaleWatch()
    clean = ranges(HALL, pose)
    wall = np.where((np.arange(len(clean)) >= first) & (np.arange(len(clean)) < first + 40), factor * clean, np.nan)
    seen = (clean, factor * clean, wall, factor * clean, clean)
    found = [watch.change(revolution(one), [np.zeros(3)] * 2) for one in seen]
    assert found == [None, pytest.approx(factor, rel=0.01), None, None, pytest.approx(1.0 / factor, rel=0.01)]


def test_a_lidar_that_was_restarted_has_no_earlier_scale():
    pose, watch = np.array(LANE[0][:3], float), ScaleWatch()
    clean, still = revolution(ranges(HALL, pose)), [np.zeros(3)] * 2
    changed = revolution(1.6 * ranges(HALL, pose))
    assert [watch.change(one, still) for one in (clean, changed)] == [None, pytest.approx(1.6, rel=0.01)]
    watch.restart(None)
    assert [watch.change(clean, still) for _ in range(2)] == [None, None]


def test_a_wall_that_the_robot_approaches_far_between_two_revolutions_changes_no_scale():
    """All ranges shrink by one factor; the wheels lead the registration, which does not reach so far by itself."""
    wall, moved = [((2.0, -20.0), (2.0, 20.0))], np.array((0.5, 0.0, 0.0))
    before, after = (ranges(wall, pose) for pose in (np.array((-2.0, 0.0, 0.0)), np.array((-1.5, 0.0, 0.0))))
    earlier, newest = (revolution(seen) for seen in (before, after))
    assert scale_change(newest, earlier, [np.zeros(3)]) == pytest.approx(0.875, abs=0.01)
    assert scale_change(newest, earlier, [moved, np.zeros(3)]) == 1.0


def test_it_ends_when_the_ranges_change_back_or_the_lidar_has_been_silent():
    for end in (StepOutput(SECOND + PERIOD, None, scale=2.0), StepOutput(4 * SECOND, None)):
        monitor = ConsistencyMonitor(ConsistencyConfig(), SENSORS)
        monitor.observe_scan(StepOutput(SECOND, None, scale=0.5))
        monitor.activate(SECOND + 1)
        assert [doubt.sensor for doubt in monitor.findings()] == [SENSORS[Measure.SCANS]]
        monitor.observe_scan(end)
        assert monitor.findings() == ()
