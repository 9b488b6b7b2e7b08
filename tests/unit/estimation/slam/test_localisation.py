"""Localisation: never at once, never against the evidence of the grid, checked afterwards, and outside of the map."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_estimation.slam import global_search, localisation
from monstertruck_estimation.slam.budget import ScanBudget
from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.correlation import correlation
from monstertruck_estimation.slam.localisation import LocalisationEstimator
from monstertruck_estimation.slam.scan_matcher import MatchStatus, ScanMatch
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.storage import SavedMap
from monstertruck_estimation.slam.worker_io import ScanInput, SlamEstimate
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap
from monstertruck_schemas.health import MATCHED, LocalisationStatus
from tests.unit.estimation.slam.kit import LIDAR, ROOM, box, ranges, rounds
from tests.unit.estimation.slam.test_map_evidence import ORIGIN, drawn

PLACED = MATCHED | {LocalisationStatus.LOST}
ACCEPTED = MatchStatus.ACCEPTED
EMPTY = [*ROOM[:4], *ROOM[8:]]
"""The same room without the box in its middle."""


def followed(saved: SavedMap, walls, truth, *, odom=True, start=None, wheels=None) -> list[SlamEstimate]:
    """Estimates at the true poses, ten a second; odometry is true, too, or what ``wheels`` say."""
    wheels = truth if wheels is None else wheels
    estimator, rng = LocalisationEstimator(saved, MapperConfig(), start), np.random.default_rng(3)
    estimates = []
    for k, pose in enumerate(truth):
        inputs = ScanInput(
            stamp=SECOND + k * SECOND // 10,
            ranges=ranges(walls, pose, noise=0.01, rng=rng),
            start_angle=LIDAR.start_angle,
            angle_increment=LIDAR.angle_increment,
            range_min=LIDAR.range_min,
            range_max=LIDAR.range_max,
            odom=tuple(between(wheels[0], wheels[k]).tolist()) if odom else None,
        )
        estimate = estimator.step(prepare_input(inputs, 30.0, estimator.twist), inputs)
        assert estimate is not None
        estimates.append(estimate)
    return estimates


@pytest.mark.parametrize("odom", [True, False])
def test_a_place_is_found_by_a_second_look_and_is_right(odom: bool):
    truth = rounds(80, laps=0.6)
    estimates = followed(SavedMap(drawn(), None), ROOM, truth, odom=odom)
    found = next(k for k, estimate in enumerate(estimates) if estimate.status in PLACED)
    way = np.hypot(*np.diff(truth[: found + 1, :2], axis=0).T).sum()
    assert 0.8 <= way < 3.0
    for estimate, pose in zip(estimates[found:], truth[found:], strict=True):
        assert estimate.status in PLACED
        assert math.hypot(*(np.array(estimate.pose) - pose)[:2]) < 0.1


def test_a_place_without_a_rival_is_found_where_a_fifth_of_the_beams_contradict_the_map():
    truth = rounds(80, laps=0.25)
    # Of the box in the middle, a third has been taken away.
    estimates = followed(SavedMap(drawn(), None), [*EMPTY, *box(-1.0, -0.6, 0.4, 0.7)], truth)
    assert estimates[-1].status in PLACED
    assert math.hypot(*(np.array(estimates[-1].pose) - truth[-1])[:2]) < 0.1


@pytest.fixture
def ended_early(monkeypatch: pytest.MonkeyPatch):
    """Makes every search for rivals end before it has ruled them out."""

    def cut(*arguments):
        peak = yield from correlation(*arguments)
        return peak and replace(peak, unseen=peak.score)

    monkeypatch.setattr(global_search, "correlation", cut)


@pytest.mark.usefixtures("ended_early")
def test_a_place_that_fits_without_proof_of_its_uniqueness_is_not_outside():
    estimates = followed(SavedMap(drawn(), None), [*EMPTY, *box(-1.0, -0.6, 0.3, 0.5)], rounds(160, laps=1.0))
    assert {estimate.status for estimate in estimates} == {LocalisationStatus.SEARCHING}


@pytest.mark.parametrize("odom", [True, False])
def test_a_robot_that_is_carried_while_it_is_searched_for_is_found_where_it_then_is(odom: bool):
    walls = [*ROOM, *box(-19.0, -1.0, -13.0, 4.0), *box(-17.0, 1.5, -16.0, 2.5)]
    before = np.linspace((-18.0, 0.0, 0.0), (-14.5, 0.0, 0.0), 50)
    truth = np.concatenate((before, rounds(160, laps=1.2)))
    estimates = followed(SavedMap(drawn(), None), walls, truth, odom=odom)
    assert not PLACED & {estimate.status for estimate in estimates[:50]}
    assert estimates[-1].status in PLACED
    assert math.hypot(*(np.array(estimates[-1].pose) - truth[-1])[:2]) < 0.1


@pytest.mark.parametrize("odom", [True, False])
def test_a_room_that_only_fits_is_outside_the_map(odom: bool):
    truth = rounds(160, laps=1.0)
    estimates = followed(SavedMap(drawn(), None), EMPTY, truth, odom=odom)
    assert not PLACED & {estimate.status for estimate in estimates}
    assert estimates[99].status is LocalisationStatus.SEARCHING
    assert estimates[-1].status is LocalisationStatus.OUTSIDE


def test_of_twin_rooms_neither_is_taken():
    east = [((a + 7.0, b), (c + 7.0, d)) for (a, b), (c, d) in ROOM]
    cells = np.concatenate((drawn().cells[:, 10:150], drawn().cells[:, 10:150]), axis=1)
    twins = replace(drawn(), cells=cells, origin=(ORIGIN[0] + 0.5, ORIGIN[1]))
    estimates = followed(SavedMap(twins, None), [*ROOM, *east], rounds(120, laps=1.0))
    assert not PLACED & {estimate.status for estimate in estimates}
    assert estimates[-1].status is LocalisationStatus.SEARCHING, "on the map, at one of two places"


def test_a_search_that_takes_many_scans_finds_where_the_robot_is_when_it_ends(monkeypatch):
    """With one piece of a search at each scan."""
    monkeypatch.setattr(global_search, "ScanBudget", lambda units: ScanBudget(1e-3 * units))
    truth = rounds(160, laps=1.2)
    estimates = followed(SavedMap(drawn(), None), ROOM, truth)
    found = next(k for k, estimate in enumerate(estimates) if estimate.status in PLACED)
    for estimate, pose in zip(estimates[found:], truth[found:], strict=True):
        assert math.hypot(*(np.array(estimate.pose) - pose)[:2]) < 0.1


def test_a_robot_that_stands_still_outside_the_map_is_reported():
    walls = box(-9.0, -1.0, -6.0, 4.0)
    estimates = followed(SavedMap(drawn(), None), walls, np.tile((-8.0, 1.0, 0.3), (120, 1)))
    assert estimates[-1].status is LocalisationStatus.OUTSIDE


DOOR = [*box(-3.0, -2.0, 3.0, 2.5)[:1], ((3.0, -2.0), (3.0, -0.5)), ((3.0, 0.5), (3.0, 2.5)), *ROOM[2:]]
"""The same room with a door on its right side."""
BEYOND = [*box(3.0, -3.0, 9.0, 3.0)[:3], *box(6.0, 1.0, 7.0, 2.0), *box(4.0, -2.5, 5.5, -1.5)]
"""What is behind it."""


def along(legs):
    """Poses, 40 per leg, from one of ``legs`` to the next."""
    share = np.linspace(0.0, 1.0, 40)[:, None]
    return np.concatenate([np.array(a) + share * (np.array(b) - np.array(a)) for a, b in itertools.pairwise(legs)])


@pytest.mark.parametrize("odom", [True, False])
def test_a_robot_that_was_off_the_map_meanwhile_is_found_when_it_is_back(odom: bool):
    """One look finds it before it leaves; what it then sees behind the door fits nowhere, but contradicts nothing."""
    out = [(2.0, 0.0, 1.6), (2.1, 0.0, 0.0), (5.5, 0.0, 0.0), (5.5, 0.0, math.pi)]
    back = [(2.0, 0.0, math.pi), (1.8, 1.4, 2.6), (-1.8, 1.4, math.pi)]
    truth = along([*out, *back])
    estimates = followed(SavedMap(drawn(DOOR), None), [*DOOR, *BEYOND], truth, odom=odom)
    assert not PLACED & {estimate.status for estimate in estimates[:160]}
    found = [k for k, estimate in enumerate(estimates) if estimate.status in PLACED]
    assert found
    for k in found:
        assert math.hypot(*(np.array(estimates[k].pose) - truth[k])[:2]) < 0.1


def test_a_place_is_not_taken_against_what_was_seen_since_its_first_look():
    """As before, but where the robot then is, the map has no walls: it is the other room's map."""
    lobby = box(3.0, -2.8, 3.85, 2.8)[:3]
    out = [(1.95, 0.45, 2.6), (2.05, 0.2, 2.0), (2.1, 0.0, 0.0), (3.4, 0.0, 0.0), (3.4, 0.0, math.pi)]
    truth = along([*out, (2.0, 0.0, math.pi), (1.8, 1.4, 2.6), (-1.8, 1.4, math.pi)])
    estimates = followed(SavedMap(drawn(DOOR, half_width=4.0), None), [*DOOR, *lobby], truth)
    assert not PLACED & {estimate.status for estimate in estimates}


def test_a_wrong_place_is_refuted_within_metres():
    """A closed room of the map looks as the robot's, which has a door: driven through it, the robot is elsewhere."""
    walls = [*DOOR, *box(3.0, -3.0, 9.0, 3.0)[:3]]
    truth = along([(-2.4, 0.0, -1.0), (-1.8, -1.3, 0.0), (2.0, -1.3, 0.7), (2.2, 0.0, 0.0), (7.0, 0.0, 0.0)])
    saved = SavedMap(drawn(), None)
    estimates = followed(saved, walls, truth, start=tuple(truth[0].tolist()))
    inside = [estimate.status for estimate in estimates[:60]]
    assert set(inside) <= PLACED
    beyond = [k for k, pose in enumerate(truth) if pose[0] > 4.0]
    assert estimates[-1].status not in MATCHED
    assert any(estimates[k].status not in PLACED for k in beyond)


def test_one_wrong_odometry_moves_nothing():
    truth = rounds(30, laps=0.2)
    wheels = truth.copy()
    wheels[15] += (1.4, 0.0, 2.5)
    estimates = followed(SavedMap(drawn(), None), ROOM, truth, start=tuple(truth[0].tolist()), wheels=wheels)
    for estimate, pose in zip(estimates, truth, strict=True):
        assert math.hypot(*(np.array(estimate.pose) - pose)[:2]) < 0.1


@pytest.mark.parametrize(
    ("away", "overlap", "taken"), [((0.0, 0.0), 0.95, True), ((2.0, 0.3), 0.95, False), ((2.0, 0.3), 0.5, False)]
)
def test_a_match_elsewhere_counts_only_if_all_of_it_fits(monkeypatch, away, overlap, taken):
    """A robot that leaves the map must not be moved back into it, to where half a scan fits."""
    truth = rounds(80, laps=0.6)[0]
    said, believed = truth + np.array((*away, 0.0)), truth + np.array((1.0, 0.0, 0.0))

    class Matcher:
        def match(self, _scan, _delta, guess, covariance, _submap):
            return ScanMatch(said, covariance, overlap, 0.01, 1.0, 0.0, MatchStatus.ACCEPTED, np.eye(3))

    monkeypatch.setattr(localisation, "PlanarMatcher", Matcher)
    estimate = followed(SavedMap(drawn(), None), ROOM, [truth], start=tuple(believed.tolist()))[-1]
    assert np.array(estimate.pose) == pytest.approx(said if taken else believed)
    assert ("rejected" in estimate.events) is not taken


@pytest.mark.parametrize("there", [MatchStatus.ACCEPTED, MatchStatus.FAR])
@pytest.mark.parametrize("odom", [True, False])
def test_by_scans_alone_half_a_scan_counts_where_the_robot_last_was_if_none_does_where_the_motion_led(
    monkeypatch, there, odom: bool
):
    """As a robot leaves the map, one wrong motion must not move it on; wheels that drive on are believed."""
    first = rounds(80, laps=0.6)[0]
    stopped = compose(first, np.array((0.45, 0.0, 0.0)))
    truth, wheels = (
        np.array((first, stopped, stopped)),
        np.array((first, stopped, compose(stopped, np.array((0.45, 0.0, 0.0))))),
    )

    class Matcher:
        scans = []

        def match(self, scan, _delta, guess, covariance, _submap):
            if not any(scan is known for known in self.scans):
                self.scans.append(scan)
            if len(self.scans) < 3:
                return ScanMatch(
                    truth[len(self.scans) - 1], covariance, 0.95, 0.01, 1.0, 0.0, ACCEPTED, 1e4 * np.eye(3)
                )
            near = math.hypot(*(guess - stopped)[:2]) < 0.3
            away = guess + np.array((2.0, 0.0, 0.0)) if there is ACCEPTED else guess
            said, status = (stopped, ACCEPTED) if near else (away, there)
            return ScanMatch(said, covariance, 0.5, 0.01, 1.0, 0.0, status, np.eye(3))

    monkeypatch.setattr(localisation, "PlanarMatcher", Matcher)
    start = tuple(first.tolist())
    estimate = followed(SavedMap(drawn(), None), ROOM, truth, start=start, odom=odom, wheels=wheels)[-1]
    assert np.array(estimate.pose) == pytest.approx(wheels[-1] if odom else stopped)
    assert ("rejected" in estimate.events) is odom


def test_a_match_that_the_grid_contradicts_is_tried_again_where_the_robot_last_was(monkeypatch):
    truth = np.repeat(rounds(80, laps=0.6)[:1], 2, axis=0)
    wheels = truth + np.array(((0.0, 0.0, 0.0), (0.0, 0.0, -0.5)))

    class Matcher:
        def match(self, _scan, _delta, guess, covariance, _submap):
            said = truth[0] if abs(guess[2] - truth[0, 2]) < 0.2 else guess - np.array((0.0, 0.0, 0.3))
            return ScanMatch(said, covariance, 0.7, 0.01, 1.0, 0.0, MatchStatus.ACCEPTED, np.eye(3))

    monkeypatch.setattr(localisation, "PlanarMatcher", Matcher)
    estimate = followed(SavedMap(drawn(), None), ROOM, truth, start=tuple(truth[0].tolist()), wheels=wheels)[-1]
    assert np.array(estimate.pose) == pytest.approx(truth[0])
    assert "rejected" not in estimate.events


@pytest.mark.parametrize(("along", "overlap"), [(20.0, 0.95), (1e4, 0.5)])
def test_the_covariance_is_that_of_the_motion_along_a_corridor_and_where_half_of_a_scan_fits(
    monkeypatch, along, overlap
):
    """The ends of the visible walls move along with the robot: however often they fit, they say nothing of its way."""
    truth = np.tile(rounds(80)[0], (51, 1))
    vague = range(20, 45)

    class Matcher:
        def __init__(self):
            self.scans = []

        def match(self, scan, _delta, guess, covariance, _submap):
            if not self.scans or self.scans[-1] is not scan:
                self.scans.append(scan)
            clear = len(self.scans) - 1 not in vague
            information = np.diag((1e4 if clear else along, 1e4, 1e4))
            posterior = np.linalg.inv(information + np.linalg.inv(covariance))
            said = 0.95 if clear else overlap, 0.01, float(information[0, 0]) / 1e4, 0.0
            return ScanMatch(guess, posterior, *said, MatchStatus.ACCEPTED, information)

    monkeypatch.setattr(localisation, "PlanarMatcher", Matcher)
    estimates = followed(SavedMap(drawn(), None), ROOM, truth, odom=False, start=tuple(truth[0].tolist()))
    deviations = np.sqrt([np.diag(np.reshape(estimate.covariance, (3, 3))) for estimate in estimates])
    # Without odometry a step of 0.1 s has a standard deviation of 0.07 m; along a corridor the velocity may be wrong by
    # 0.5 m/s all the time.
    lasting = 0.5 * 0.1 * len(vague) if overlap > 0.9 else 0.0
    assert deviations[44, 0] == pytest.approx(math.hypot(0.07 * math.sqrt(len(vague)), lasting), rel=0.05)
    assert deviations[19, 0] < 0.02
    assert deviations[45, 0] < 0.02
    assert [estimates[k].status for k in (19, 44, 45)] == [
        LocalisationStatus.LOCALISED,
        LocalisationStatus.UNCERTAIN,
        LocalisationStatus.LOCALISED,
    ]


MAPPED = [
    *[((-3.5, -1.0), (3.9, -1.0)), ((-3.5, 1.0), (3.9, 1.0)), ((-3.5, -1.0), (-3.5, 1.0))],
    *[*box(-1.0, 0.6, -0.6, 1.0), *box(2.9, -1.0, 3.3, -0.6)],
]
"""The mapped part of a corridor."""
UNMAPPED = [((3.9, -1.0), (14.0, -1.0)), ((3.9, 1.0), (14.0, 1.0)), ((14.0, -1.0), (14.0, 1.0))]
"""The part behind it, which is not mapped."""
POSTS = [*box(3.8, -1.0, 4.2, -0.6), *box(4.7, -1.0, 5.1, -0.6), *box(5.6, -1.0, 6.0, -0.6)]


@pytest.mark.parametrize("posts", [[], POSTS[:4], POSTS])
def test_a_robot_with_wheels_that_leaves_the_map_along_a_corridor_is_not_moved_back_along_it(posts):
    """What is off the map is matched to nothing on it: the pose is right within what its covariance says."""
    truth = along([(-2.0, 0.0, 0.0), (1.0, 0.1, 0.0), (3.5, 0.0, 0.0), (6.0, 0.0, 0.0)])
    saved = SavedMap(drawn(MAPPED, half_width=3.9), None)
    estimates = followed(saved, [*MAPPED, *UNMAPPED, *posts], truth, start=tuple(truth[0].tolist()))
    for estimate, pose in zip(estimates, truth, strict=True):
        if estimate.status in PLACED:
            off = np.array(estimate.pose) - pose
            deviation = np.sqrt(np.diag(np.reshape(estimate.covariance, (3, 3))))
            assert math.hypot(*off[:2]) < 0.5
            assert (np.abs(off[:2]) < 6.0 * deviation[:2] + 0.05).all()
    assert estimates[-1].status not in PLACED


LONG = [*box(0.0, -1.0, 20.0, 1.0), *box(1.6, 0.6, 2.0, 1.0), *box(2.6, -1.0, 3.0, -0.7)]
"""A corridor with two pillars at its beginning."""


def long_corridor(walls=LONG) -> SavedMap:
    cells = np.full((80, 440), UNKNOWN, np.int8)
    cells[20:60, 20:-20] = FREE
    for (x0, y0), (x1, y1) in walls:
        share = np.linspace(0.0, 1.0, 2000)
        rows, columns = (y0 + share * (y1 - y0) + 2.0) / 0.05, (x0 + share * (x1 - x0) + 1.0) / 0.05
        cells[rows.astype(int), columns.astype(int)] = OCCUPIED
    return SavedMap(WorldMap(cells, 0.05, (-1.0, -2.0)), None)


def test_the_covariance_covers_wheels_that_slip_in_a_corridor():
    """For 2.5 s they measure twice the distance, and nothing shows it."""
    truth = np.column_stack((np.arange(2.0, 9.0, 0.07), np.zeros((100, 2))))
    slip = 0.07 * np.clip(np.arange(100) - 60, 0, 25)
    wheels = truth + np.column_stack((slip, np.zeros((100, 2))))
    estimates = followed(long_corridor(), LONG, truth, start=tuple(truth[0].tolist()), wheels=wheels)
    off = np.array([estimate.pose[0] for estimate in estimates]) - truth[:, 0]
    deviation = np.sqrt([estimate.covariance[0] for estimate in estimates])
    assert off[-1] > 1.5
    assert (np.abs(off) < 3.0 * deviation + 0.05).all()
    assert all(estimate.status is LocalisationStatus.UNCERTAIN for estimate in estimates[-20:])
    assert estimates[5].status is LocalisationStatus.LOCALISED


def test_by_scans_alone_the_velocity_lasts_in_a_corridor():
    """The ends of the visible walls move along with the robot: a velocity taken from them runs away."""
    truth = np.column_stack((np.arange(1.0, 12.0, 0.05), np.zeros((220, 2))))
    estimates = followed(long_corridor(), LONG, truth, odom=False, start=tuple(truth[0].tolist()))
    along = np.array([estimate.pose[0] for estimate in estimates])
    deviation = np.sqrt([estimate.covariance[0] for estimate in estimates])
    assert estimates[-1].status is LocalisationStatus.UNCERTAIN
    assert (np.abs(along - truth[:, 0]) < 2.0 * deviation + 0.1).all()
    assert np.abs(np.diff(along)).max() < 0.2


def test_the_covariance_covers_another_velocity_in_a_corridor():
    """By scans alone nothing shows that the robot drives on four times as fast."""
    truth = np.column_stack((np.r_[np.arange(1.0, 5.0, 0.03), np.arange(5.0, 11.0, 0.12)], np.zeros((184, 2))))
    estimates = followed(long_corridor(), LONG, truth, odom=False, start=tuple(truth[0].tolist()))
    off = np.array([estimate.pose[0] for estimate in estimates]) - truth[:, 0]
    deviation = np.sqrt([estimate.covariance[0] for estimate in estimates])
    assert off[-1] < -2.5
    assert (np.abs(off) < 2.0 * deviation + 0.1).all()
    assert estimates[-1].status is LocalisationStatus.UNCERTAIN


def test_a_pillar_that_fits_at_another_place_too_does_not_end_the_uncertainty_of_a_corridor():
    """The wheels have slipped: the pillar's front fits at its back, or at the corridor's end, until more is seen."""
    walls = [*LONG, *box(17.0, 0.6, 17.4, 1.0)]
    truth = np.column_stack((np.arange(1.0, 18.0, 0.1), np.zeros((170, 2))))
    wheels = truth + np.column_stack((0.1 * np.clip(np.arange(170) - 75, 0, 13), np.zeros((170, 2))))
    estimates = followed(long_corridor(walls), walls, truth, start=tuple(truth[0].tolist()), wheels=wheels)
    off = np.abs(np.array([estimate.pose[0] for estimate in estimates]) - truth[:, 0])
    certain = [estimate.status is LocalisationStatus.LOCALISED for estimate in estimates]
    assert max(off) > 1.2
    assert max(off[certain]) < 0.1
    assert all(certain[-20:])
