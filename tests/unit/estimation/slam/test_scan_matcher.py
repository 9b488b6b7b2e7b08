import dataclasses
import math

import numpy as np
import pytest

from monstertruck_estimation.slam.correlation import (
    PIECE,
    LikelihoodGrid,
    RivalSearch,
    Submap,
    correlate,
    correlation,
    merged,
)
from monstertruck_estimation.slam.kiss import KissMatcher
from monstertruck_estimation.slam.registration import Cloud, Fit, register
from monstertruck_estimation.slam.scan_matcher import (
    MatchStatus,
    PlanarMatcher,
    gated,
)
from monstertruck_estimation.slam.scans import Scan, ScanGeometry, prepare
from monstertruck_kinematics.se2 import between, compose, inverse, transform
from tests.unit.estimation.slam.kit import CORRIDOR, ROOM, box, scan

PLACE = np.array((1.8, 0.2, 1.2))
WIDE = np.diag((0.3**2, 0.3**2, 0.2**2))


def seen_from(walls, *poses):
    poses = np.array(poses)
    return Submap(Cloud.of(merged([scan(walls, pose) for pose in poses], poses)))


def dots(points):
    ones = np.ones((len(points), 2))
    return Cloud.of(Scan(points, ones, ones, np.zeros(len(points))))


def test_the_fine_fit_finds_the_place_and_knows_how_well():
    submap = seen_from(ROOM, PLACE, PLACE + np.array((0.1, 0.3, 0.4)))
    fit = register(scan(ROOM, PLACE + np.array((0.05, 0.1, 0.1))), submap.cloud, PLACE)
    assert fit.pose == pytest.approx(PLACE + np.array((0.05, 0.1, 0.1)), abs=0.004)
    assert fit.overlap > 0.9
    assert fit.residual < 0.012
    assert np.linalg.eigvalsh(fit.information)[0] > 100


@pytest.mark.parametrize(
    ("overlap", "pairs", "off", "verdict"),
    [
        (0.9, 200, 5.9, MatchStatus.ACCEPTED),
        (0.9, 200, 6.1, MatchStatus.FAR),
        (0.59, 200, 2.9, MatchStatus.ACCEPTED),
        (0.59, 200, 3.1, MatchStatus.FAR),
        (0.36, 200, 1.0, MatchStatus.ACCEPTED),
        (0.34, 200, 1.0, MatchStatus.OVERLAP),
        (0.9, 12, 1.0, MatchStatus.ACCEPTED),
        (0.9, 11, 1.0, MatchStatus.EMPTY),
    ],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_gate(axis: int, overlap: float, pairs: int, off: float, verdict: MatchStatus):
    guess, deviations = np.array((1.0, -2.0, math.pi)), np.array((0.1, 0.2, 0.05))
    fitted = guess.copy()
    fitted[axis] += off * deviations[axis]
    fitted[2] = math.remainder(fitted[2], math.tau)  # the other side of +-pi
    fit = Fit(fitted, np.diag((1e4, 1e4, 1e4)), overlap, 0.01, pairs, 0.0)
    match = gated(fit, guess, np.diag(deviations**2))
    assert match.verdict is verdict
    assert match.pose == pytest.approx(fitted if match.accepted else guess)


@pytest.mark.parametrize("moved", [0.1, 0.15, 0.2])
def test_a_thing_that_moves_beside_the_lidar_does_not_take_the_pose_along(moved):
    hall = [((-3, -3), (3, -3)), ((3, -3), (3, 3)), ((3, 3), (-3, 3)), ((-3, 3), (-3, -3))]
    submap = seen_from([*hall, *box(0.4, -0.25, 0.6, 0.25)], np.zeros(3))
    now = scan([*hall, *box(0.4 + moved, -0.2, 0.6 + moved, 0.3)], np.zeros(3))
    match = PlanarMatcher().match(now, np.zeros(3), np.zeros(3), np.diag((0.05**2, 0.05**2, 0.05**2)), submap)
    assert match.accepted
    assert match.pose == pytest.approx(np.zeros(3), abs=0.03)  # by beams, a quarter of them, it took the pose along


@pytest.mark.parametrize("bend", [-0.05, -0.1, -0.15])
def test_how_a_wall_goes_on_beyond_what_is_known_does_not_turn_the_scan(bend):
    known = [((-2, 0.6), (1.2, 0.6)), ((-2, -0.6), (1.2, -0.6))]
    new = [((1.2, 0.6), (1.5, 0.6 + bend)), ((1.2, -0.6), (1.5, -0.6))]
    place = np.array((0.8, 0.0, 0.0))
    fit = register(scan([*known, *new], place), seen_from(known, np.zeros(3)).cloud, place)
    assert fit.overlap > 0.95
    assert fit.pose[1:] == pytest.approx(place[1:], abs=0.005)  # 0.012 to 0.032 rad with pairs of what is new


def test_the_search_returns_the_greatest_score_of_its_window():
    rng = np.random.default_rng(3)
    grid = LikelihoodGrid.of(dots(rng.uniform(-2, 2, (60, 2))), 5)
    points = rng.uniform(-2, 2, (40, 2))
    guess = np.array((0.1, -0.2, 0.3))
    peak = correlate(grid, points, guess, (0.5, 0.2), (1e3, 1e3), 0.0)
    assert peak is not None
    best = 0.0
    # Every pose of the window, one by one: the smallest windows round the poses of the search's own lattice.
    step = 0.05 / max(float(np.percentile(np.hypot(*points.T), 80)), 1.0)
    for turn in np.arange(-math.ceil(0.2 / step), math.ceil(0.2 / step) + 1) * step:
        for x in np.arange(-10, 11) * 0.05:
            at = guess + np.array((x, 0.0, turn))
            column = correlate(grid, points, at, (0.5, 1e-9), (1e3, 1e3), 0.0)
            best = max(best, column.score)
    assert peak.score == pytest.approx(best, abs=0.02)


def test_a_search_that_ends_early_has_looked_at_the_most_promising_places_of_the_whole_window():
    rng = np.random.default_rng(3)
    clutter, sparse = rng.uniform((-10, -10), (2, 10), (1000, 2)), rng.uniform((2, -10), (10, 10), (200, 2))
    points, place = np.concatenate((clutter, sparse)), np.array((6.0, -5.0, 1.0))
    seen = transform(inverse(place), points)
    query = seen[np.hypot(*seen.T) < 4.0]
    # Depth first, the clutter took all of the work, and a place of a score of 0.3 was the result.
    grid = LikelihoodGrid.of(dots(points), 7)
    peak = correlate(grid, query, np.zeros(3), (11.0, math.pi), (1e6, 1e6), 0.3)
    assert peak is not None
    assert peak.score > 0.9
    assert peak.pose == pytest.approx(place, abs=0.05)
    # A search for rivals that ends early says what one may score.
    near = correlate(grid, query, place, (11.0, 0.1), (1e6, 1e6), 0.3, apart=1.0, work=5_000)
    assert near is not None
    assert near.rival < near.unseen < near.score
    assert correlate(grid, query, place, (11.0, 0.1), (1e6, 1e6), 0.3, apart=1.0).unseen == 0.0


def test_a_search_in_pieces_knows_the_real_rival_and_no_piece_is_long():
    rng = np.random.default_rng(3)
    points, place = rng.uniform((-10, -10), (10, 10), (1200, 2)), np.array((6.0, -5.0, 1.0))
    seen = transform(inverse(place), points)
    query = seen[np.hypot(*seen.T) < 4.0]
    grid, window = LikelihoodGrid.of(dots(points), 7), (11.0, math.pi)
    pieces, costs = correlation(grid, query, np.zeros(3), window, (1e6, 1e6), 0.6, RivalSearch(1.0, 0.85, 0.97)), []
    while True:
        try:
            costs.append(next(pieces))
        except StopIteration as end:
            peak = end.value
            break
    assert peak.pose == pytest.approx(place, abs=0.05)
    assert (peak.rival, peak.unseen) == (0.0, 0.0), "no other place scores 0.85 of it"
    assert len(costs) > 20
    assert max(costs) <= PIECE


def test_a_square_room_is_its_own_rival():
    square = [((-2, -2), (2, -2)), ((2, -2), (2, 2)), ((2, 2), (-2, 2)), ((-2, 2), (-2, -2))]
    submap = seen_from(square, (0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 4.0))
    query = scan(square, (0.5, 0.3, 0.2)).points
    peak = correlate(submap.grid(7), query, np.array((0.0, 0.0, 0.2)), (2.0, 3.0), (2.0, 3.0), 0.3, apart=1.0)
    assert peak is not None
    assert peak.rival > 0.9 * peak.score


def test_nothing_scores_where_nothing_is():
    grid = LikelihoodGrid.of(dots(np.array(((50.0, 50.0),))), 4)
    assert correlate(grid, np.array(((1.0, 0.0),)), np.zeros(3), (0.5, 0.1), (0.1, 0.1), 0.1) is None
    assert correlate(grid, np.zeros((0, 2)), np.zeros(3), (0.5, 0.1), (0.1, 0.1), 0.1) is None


@pytest.mark.parametrize("off", [(0.3, -0.2, 0.25), (-0.5, 0.4, -0.3), (0.0, 0.0, 0.0)])
def test_the_front_end_finds_the_scan_in_the_window_of_its_uncertainty(off):
    submap = seen_from(ROOM, PLACE, PLACE + np.array((0.0, 0.4, 0.3)))
    match = PlanarMatcher().match(scan(ROOM, PLACE), np.zeros(3), PLACE + off, WIDE, submap)
    assert match.accepted
    assert match.pose == pytest.approx(PLACE, abs=0.01)
    assert not match.degenerate


def test_a_slip_beyond_the_covariance_is_found_by_looking_further():
    submap = seen_from(ROOM, PLACE, PLACE + np.array((0.0, 0.4, 0.3)))
    tight = np.diag((0.03**2, 0.03**2, 0.08**2))
    match = PlanarMatcher().match(scan(ROOM, PLACE), np.zeros(3), PLACE + np.array((0.02, 0.01, 0.45)), tight, submap)
    assert match.accepted
    assert match.pose == pytest.approx(PLACE, abs=0.01)


def test_a_corridor_is_reported_and_leaves_the_way_along_it_to_the_wheels():
    submap = seen_from(CORRIDOR, (0.0, 0.1, 0.0), (0.5, 0.1, 0.0))
    guess = np.array((0.9, 0.0, 0.03))
    match = PlanarMatcher().match(
        scan(CORRIDOR, (0.6, 0.1, 0.0)), np.zeros(3), guess, np.diag((0.05**2, 0.05**2, 0.05**2)), submap
    )
    assert match.accepted
    assert match.degenerate
    assert match.direction == pytest.approx(0.0, abs=0.1)
    assert match.pose == pytest.approx((0.9, 0.1, 0.0), abs=0.02)
    assert match.covariance[0, 0] > 10 * match.covariance[1, 1]


@pytest.mark.parametrize(("moving", "degenerate"), [(0.0, False), (0.05, False), (0.2, True)])
def test_people_may_explain_what_constrains_the_weak_direction(moving, degenerate):
    fit = Fit(np.zeros(3), np.diag((1e3, 1e4, 1e4)), 0.9, 0.01, 100, 0.0)
    match = gated(fit, np.zeros(3), np.eye(3))
    assert dataclasses.replace(match, moving=moving).degenerate is degenerate


def test_a_foreign_scan_is_rejected_and_the_guess_stands():
    submap = seen_from(ROOM, PLACE)
    hexagon = np.array([(math.cos(a), math.sin(a)) for a in np.arange(7) * math.pi / 3])
    walls = [(tuple(a), tuple(b)) for a, b in zip(0.4 * hexagon[:-1], 0.4 * hexagon[1:], strict=True)]
    match = PlanarMatcher().match(scan(walls, (0.0, 0.0, 0.0)), np.zeros(3), PLACE, np.diag((1e-3, 1e-3, 1e-3)), submap)
    assert match.verdict in {MatchStatus.OVERLAP, MatchStatus.EMPTY}
    assert match.pose == pytest.approx(PLACE)


@pytest.mark.parametrize("count", [0, 3])
def test_a_handful_of_points_is_no_scan(count):
    values = np.full(181, np.inf)
    values[:count] = 1.0
    few = prepare(values, ScanGeometry(-math.pi / 2, math.pi / 180, 0.1, 30.0))
    match = PlanarMatcher().match(few, np.zeros(3), PLACE, WIDE, seen_from(ROOM, PLACE))
    assert match.verdict is MatchStatus.EMPTY
    assert match.pose == pytest.approx(PLACE)
    assert np.array_equal(match.covariance, WIDE)


def test_kiss_is_judged_like_the_other():
    front = KissMatcher()
    submap = seen_from(ROOM, PLACE, PLACE + np.array((0.0, 0.4, 0.3)))
    first = front.match(scan(ROOM, PLACE), np.zeros(3), PLACE, WIDE, submap)
    assert first.accepted
    moved = np.array((0.1, 0.0, 0.05))
    wrong = moved + np.array((0.02, 0.01, -0.02))
    second = front.match(scan(ROOM, compose(PLACE, moved)), wrong, compose(PLACE, wrong), WIDE, submap)
    assert second.accepted
    assert np.hypot(*between(PLACE, second.pose)[:2] - moved[:2]) < 0.03
    away = front.match(scan(CORRIDOR, (0.0, 0.5, 0.6)), moved, compose(PLACE, moved), WIDE / 100, submap)
    assert not away.accepted
