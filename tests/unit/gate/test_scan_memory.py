"""What earlier scans saw guards the truck where its lidar does not look."""

import itertools
import math

import numpy as np
import pytest

from monstertruck_estimation.odometry import PlanarCovariance
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints, first_contact, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import HIDDEN, DriveMode
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.obstacles import ObstacleCheck, ObstacleGuard, at_poses
from monstertruckd.gate.scan_memory import DRIFT, MAP_CELL, MAP_SIZE, ScanMemory, elsewhere, spaced
from tests.unit.gate.rig import TICK, Rig, check_of, scan

FOOTPRINT = Footprint()
BACK = FOOTPRINT.half_length - FOOTPRINT.offset
MOUNT = (0.14, 0.0, 0.0)


def memory(distance=2.0):
    return ScanMemory(FOOTPRINT, [MOUNT], distance, 30.0)


def drive(remembered, metres, turn=0.0, now=SECOND, speed=0.2):
    """Move on an arc in ticks; returns the time at its end."""
    for _ in range(round(abs(metres) / speed / 0.02)):
        now += TICK
        remembered.move(now, (math.copysign(speed, metres), 0.0, turn), 0.02)
    return now


def points_of(message):
    seen = np.isfinite(message.ranges).nonzero()[0]
    bearing = message.start_angle + message.angle_increment * seen
    points = np.column_stack((0.14 + message.ranges[seen] * np.cos(bearing), message.ranges[seen] * np.sin(bearing)))
    return points[np.hypot(*points.T) < 1.0]


def see(remembered, now, *obstacles):
    """Take a scan; returns the remembered points."""
    message = scan(now, *obstacles)
    remembered.observe(message, points_of(message))
    return remembered.points()


def test_without_a_scan_nothing_is_known():
    assert memory().points().shape == (0, 2)
    assert seen(memory(), 0.0, 0.6, -BACK - DRIFT + 0.01) == [True, False, True], "but what is under the body"


def test_a_point_stays_where_it_was_seen_as_the_truck_passes_it():
    remembered = memory()
    assert len(see(remembered, SECOND, (0.3, 0.4))) == 0
    now = drive(remembered, 0.6)
    ((x, y),) = see(remembered, now)
    assert (x, y) == pytest.approx((-0.3, 0.4), abs=0.01)


@pytest.mark.parametrize(("metres", "remembered_points"), [(0.11, 1), (0.09, 0)])
def test_another_scan_is_remembered_a_tenth_of_a_metre_further_on(metres, remembered_points):
    remembered = memory()
    see(remembered, SECOND)
    now = drive(remembered, metres, speed=0.1)
    see(remembered, now, (0.3, 0.4))
    assert len(see(remembered, drive(remembered, 0.6, now=now))) == remembered_points


def test_a_point_turns_about_a_turning_truck():
    remembered = memory()
    see(remembered, SECOND, (0.4, -0.3))
    now = drive(remembered, 0.2 * math.pi / 2, turn=1.0)  # a quarter of a circle of 0.2 m
    ((x, y),) = see(remembered, now)
    assert (x, y) == pytest.approx((-0.3 - 0.2, -(0.4 - 0.2)), abs=0.02)


def test_where_the_lidar_looks_its_scan_counts():
    remembered = memory()
    see(remembered, SECOND, (0.5, 0.0))
    assert len(see(remembered, drive(remembered, 0.02))) == 0
    assert len(see(remembered, drive(remembered, 0.1))) == 0


def test_a_scan_is_placed_where_it_was_taken():
    remembered = memory()
    now = drive(remembered, 0.2)
    see(remembered, SECOND, (0.3, 0.4))  # comes late: taken before the truck moved
    ((x, _),) = see(remembered, drive(remembered, 0.4, now=now))
    assert x == pytest.approx(-0.3, abs=0.015)


def test_points_are_forgotten_after_their_distance_and_time():
    remembered = memory(distance=0.5)
    see(remembered, SECOND, (0.2, 0.4))
    now = drive(remembered, 0.45)
    assert len(see(remembered, now)) == 1
    assert len(see(remembered, 31 * SECOND - 1)) == 1
    assert len(see(remembered, 31 * SECOND)) == 0
    assert len(see(remembered, drive(remembered, 0.1, now=now))) == 0


@pytest.mark.parametrize(("inside", "kept"), [(-2.0, 1), (2.0, 1), (5.0, 1), (6.5, 0), (20.0, 0)])
@pytest.mark.parametrize("side", [1, -1])
def test_points_at_the_edge_of_the_lidars_field_are_remembered(side, inside, kept):
    """Within 0.1 rad, 5.7 degrees; ``inside`` are the degrees from the edge of the field."""
    remembered = memory()
    bearing = side * math.radians(120 - inside)
    there = np.array([(0.14 + 0.6 * math.cos(bearing), 0.6 * math.sin(bearing))])
    remembered.observe(scan(SECOND), there)
    remembered.observe(scan(SECOND), np.empty((0, 2)))
    assert len(remembered.points()) == kept


@pytest.mark.parametrize(("inside", "kept"), [(10.0, 1), (1.0, 1), (-2.0, 1), (-5.0, 1), (-6.5, 0), (-20.0, 0)])
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("middle", [0.0, 180.0])
def test_points_behind_a_mast_are_remembered(middle, side, inside, kept):
    """``inside`` are the degrees from the edge of a hidden sector of 60 degrees, of a lidar that looks all around."""
    remembered = ScanMemory(FOOTPRINT, [(0.0, 0.0, 0.0)], 2.0, 30.0)
    around = fan(SECOND, 720, increment=math.tau / 720, reach=2.0)
    bearings = around.start_angle + around.angle_increment * np.arange(720)
    hidden = np.cos(bearings - math.radians(middle)) > math.cos(math.radians(30.0))
    masked = around.model_copy(update={"codes": np.where(hidden, np.uint8(HIDDEN), around.codes)})
    bearing = math.radians(middle + side * (30.0 - inside))
    remembered.observe(around, 0.6 * np.array([(math.cos(bearing), math.sin(bearing))]))
    assert len(remembered.points()) == 0
    remembered.observe(masked, np.empty((0, 2)))
    assert len(remembered.points()) == kept


def test_a_scan_of_a_single_beam_is_remembered():
    remembered = memory()
    one = {"end_angle": -math.radians(120), "ranges": np.array([0.5]), "codes": np.full(1, 255, np.uint8)}
    remembered.observe(scan(SECOND).model_copy(update=one), np.array([(0.0, -0.5)]))
    assert remembered.points() == pytest.approx(np.array([(0.0, -0.5)]))


def test_points_that_the_body_stands_on_are_none():
    remembered = memory()
    see(remembered, SECOND, (0.3, FOOTPRINT.half_width - 0.01))
    assert len(see(remembered, drive(remembered, 0.5))) == 0


def test_how_far_the_truck_has_come_before_does_not_matter():
    remembered = memory(distance=0.5)
    now = drive(remembered, 2.0)
    see(remembered, now, (0.2, 0.4))
    assert len(see(remembered, drive(remembered, 0.45, now=now))) == 1


def seen(remembered, *xs):
    """Which points on the middle of the way are seen; a single one alone."""
    found = remembered.seen(np.array([(x, 0.0) for x in xs]))
    return bool(found[0]) if len(xs) == 1 else found.tolist()


def test_ground_is_seen_where_beams_pass_and_the_body_stood():
    remembered = memory()
    see(remembered, SECOND)
    assert seen(remembered, 0.0, 0.3, 0.6) == [True, True, True]
    assert seen(remembered, -BACK + 0.01, -BACK - DRIFT + 0.01) == [True, True]
    assert seen(remembered, -BACK - DRIFT - 0.01, -0.6) == [False, False]
    see(remembered, drive(remembered, 0.4))
    assert seen(remembered, -BACK - 0.3, -BACK - 0.4 - DRIFT + 0.01) == [True, True]
    assert not seen(remembered, -BACK - 0.4 - DRIFT - 0.01)


def test_ground_behind_an_obstacle_or_a_beam_without_an_answer_is_not_seen():
    remembered = memory()
    see(remembered, SECOND, *[(0.5, y / 200) for y in range(-120, 121)])
    assert seen(remembered, 0.45, 0.55) == [True, False]
    remembered = memory()
    blind = scan(SECOND)
    remembered.observe(blind.model_copy(update={"codes": np.full(682, 7, np.uint8)}), np.empty((0, 2)))
    assert not seen(remembered, 0.6)


def test_seen_ground_ages():
    remembered = memory()
    see(remembered, SECOND)
    now = drive(remembered, 0.4)
    see(remembered, now)
    assert seen(remembered, -BACK - 0.3)
    see(remembered, 31 * SECOND - 1)
    assert seen(remembered, -BACK - 0.3)
    see(remembered, 31 * SECOND)
    assert not seen(remembered, -BACK - 0.3)


def test_ground_is_known_by_a_few_scans_of_the_way_here():
    remembered = memory()
    now = SECOND
    for _ in range(20):
        see(remembered, now)
        now = drive(remembered, 0.1, now=now)
    see(remembered, now)
    assert all(seen(remembered, *np.arange(-1.2, 1.0, 0.01)))
    for _ in range(30):
        see(remembered, now)
        now = drive(remembered, 0.1, now=now)
    see(remembered, now)
    assert all(seen(remembered, *np.arange(-4.5, 1.0, 0.01))), "all that was driven over lately"


def test_ground_that_the_corners_of_a_turning_truck_pass_is_known():
    remembered = memory()
    now = SECOND
    for _ in range(20):
        see(remembered, now)
        for _ in range(6):
            now += TICK
            remembered.move(now, (0.0, 0.0, 1.0), 0.02)
    see(remembered, now)
    around = np.linspace(0.0, 2 * math.pi, 60)
    assert remembered.seen(FOOTPRINT.circumscribed_radius * np.column_stack((np.cos(around), np.sin(around)))).all()


def fan(stamp, beams, bearing=0.0, increment=0.1, reach=1.0):
    """A scan of so many beams about a bearing, all of which end at ``reach``."""
    half = increment * (beams - 1) / 2
    figures = {"start_angle": bearing - half, "end_angle": bearing + half}
    return scan(stamp).model_copy(
        update={"ranges": np.full(beams, reach), "codes": np.full(beams, 255, np.uint8), **figures}
    )


def test_a_scan_sees_as_far_as_its_beams_reach_and_as_wide_as_they_are():
    remembered = ScanMemory(FOOTPRINT, [(0.0, 0.0, 0.0)], 2.0, 30.0)
    remembered.observe(fan(SECOND, 11), np.empty((0, 2)))

    def sees(bearing, distance):
        return bool(remembered.seen(distance * np.array([(math.cos(bearing), math.sin(bearing))]))[0])

    for bearing in (-0.54, -0.5, 0.0, 0.5, 0.54):
        assert sees(bearing, 0.99)
        assert not sees(bearing, 1.01)
    assert not sees(-0.56, 0.9)
    assert not sees(0.56, 0.9)
    assert not sees(math.pi - 0.1, 0.9)


@pytest.mark.parametrize(
    ("mount", "point"), [((0.2, 0.1, math.pi / 2), (0.2, 1.0)), ((-0.2, 0.1, math.pi), (-1.1, 0.1))]
)
def test_a_scan_is_seen_from_where_its_lidar_is_mounted(mount, point):
    remembered = ScanMemory(FOOTPRINT, [mount], 2.0, 30.0)
    remembered.observe(fan(SECOND, 3), np.empty((0, 2)))
    (x, y), (ahead_x, ahead_y) = point, (math.cos(mount[2]), math.sin(mount[2]))
    here, beyond, aside = (x, y), (x + 0.2 * ahead_x, y + 0.2 * ahead_y), (x + 0.3 * ahead_y, y + 0.3 * ahead_x)
    assert remembered.seen(np.array([here, beyond, aside])).tolist() == [True, False, False]


@pytest.mark.parametrize("code", range(21))
def test_beams_that_met_nothing_see_free_ground_and_those_that_say_nothing_do_not(code):
    remembered = ScanMemory(FOOTPRINT, [(0.0, 0.0, 0.0)], 2.0, 30.0)
    message = fan(SECOND, 11, reach=math.inf)
    remembered.observe(message.model_copy(update={"codes": np.full(11, code, np.uint8)}), np.empty((0, 2)))
    assert seen(remembered, 0.9) is (code <= 2)


def test_scans_of_different_geometry_are_remembered_each_by_its_own():
    remembered = ScanMemory(FOOTPRINT, [(0.0, 0.0, 0.0)], 2.0, 30.0)
    for second, (beams, bearing) in enumerate([(21, 2.0), (5, 0.0), (11, math.pi / 2)], 1):
        now = second * SECOND
        remembered.observe(fan(now, beams, bearing), np.empty((0, 2)))
        remembered.move(now, (0.3, 0.0, 0.0), 1.0)
    remembered.observe(fan(now, 3, -math.pi / 2), np.empty((0, 2)))
    there = np.array([(-1.4, 0.7), (-0.3, 0.9), (-0.3, -0.9), (0.3, 0.0), (0.0, -0.9), (0.45, 0.0)])
    assert remembered.seen(there).tolist() == [True, True, False, True, True, False]


@pytest.mark.parametrize("turn", [math.radians(240), math.tau - math.tau / 181])
def test_scans_of_lidars_that_turn_the_other_way_are_remembered_as_well(turn):
    there = np.column_stack((np.tile(np.linspace(-1.5, 1.5, 13), 13), np.repeat(np.linspace(-1.5, 1.5, 13), 13)))
    found = []
    for sense in (1, -1):
        remembered = ScanMemory(FOOTPRINT, [MOUNT], 2.0, 30.0)
        ranges = 1.0 + 0.4 * np.sin(2 * np.linspace(-turn / 2, turn / 2, 181) * sense)
        message = scan(SECOND).model_copy(
            update={
                "start_angle": -sense * turn / 2, "end_angle": sense * turn / 2, "ranges": ranges,
                "codes": np.full(181, 255, np.uint8),
            }
        )  # fmt: skip
        remembered.observe(message, points_of(message))
        drive(remembered, 0.3)
        later = message.model_copy(update={"stamp": 3 * SECOND, "ranges": ranges + 0.5})
        remembered.observe(later, np.empty((0, 2)))
        found.append((remembered.seen(there), remembered.points()))
    (seen_one, points), (seen_other, others) = found
    assert seen_one.tolist() == seen_other.tolist()
    assert seen_one.any()
    assert (len(points) == 0) is (turn > 6.0), "a full turn has no edge beyond which it does not look"
    assert len(points) == pytest.approx(len(others), abs=2)
    if len(points):
        assert np.hypot(*(points[:, None] - others[None]).transpose(2, 0, 1)).min(axis=1).max() < 0.04


def test_a_varying_number_of_beams_does_not_make_another_place():
    here, fewer = wall(SECOND, 2.0), wall(SECOND, 2.0)
    bearings = np.linspace(0, 681, 640).round().astype(int)
    fewer = fewer.model_copy(update={"ranges": fewer.ranges[bearings], "codes": fewer.codes[bearings]})
    nothing = here.model_copy(update={"ranges": np.empty(0), "codes": np.empty(0, np.uint8)})
    assert not elsewhere(here, fewer)
    assert not elsewhere(fewer, here)
    assert not elsewhere(here, nothing), "a scan that says nothing"


def test_of_an_outline_points_are_remembered_that_are_two_centimetres_apart():
    wall = np.column_stack((np.linspace(0.0, 1.0, 501), np.full(501, 0.5)))
    post = np.array([(0.5, 0.3)])
    kept = spaced(np.concatenate((wall[:250], post, wall[250:])), 0.02)
    assert len(kept) == pytest.approx(52, abs=2)
    assert (post == kept).all(axis=1).any()
    assert np.diff(kept[:, 0]).max() < 0.025
    assert (kept[0] == wall[0]).all()
    assert spaced(wall[:0], 0.02).shape == (0, 2)
    remembered = memory()
    remembered.observe(scan(SECOND), wall - np.array((1.5, 0.0)))
    assert len(remembered.points()) == pytest.approx(50, abs=1)


# In the gate


def guarding(*obstacles):
    """A guard that has taken one scan."""
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    guard.observe(scan(SECOND, *obstacles))
    return guard


BESIDE = [(x, side * 0.24) for x in np.arange(0.02, 0.6, 0.005) for side in (1, -1)]
"""Walls 5 cm from the body, as far back as the lidar looks."""


@pytest.mark.parametrize("x", [1.0, 0.7, 0.0, -0.01, -0.7, -1.0])
def test_unseen_ground_counts_whichever_way_the_motion_goes(x):
    """It stops what goes backwards or sideways at all, whether or not anything was measured near to it."""
    for obstacles in ((), BESIDE):
        guard = guarding(*obstacles)
        guard.free_distance(((x, math.sqrt(1.0 - x**2), 0.0),))
        if x == 1.0:
            assert guard.known == guard.known_slowly == math.inf, "straight on leads to where the lidar looks"
        else:
            assert guard.known < 0.1
            assert guard.known_slowly == math.inf


@pytest.mark.parametrize(
    ("motion", "stops"),
    [((0.3, 0.95, 0.0), True), ((0.3, 0.95, 1.0), True), ((0.7, 0.7, 0.0), True), ((0.98, 0.2, 0.0), False)],
)
def test_a_motion_that_leads_beside_the_body_stops_before_unseen_ground(motion, stops):
    """A motion that leads ahead shows the lidar the ground beside it; a tracker that corrects its path is no crab."""
    guard = guarding()
    guard.free_distance((motion,))
    assert math.isfinite(guard.known) is stops


def passing(*obstacles, metres=0.6):
    """A guard that has driven straight on, past obstacles in the base where it began."""
    guard, now = guarding(*obstacles), SECOND
    for x in np.arange(0.0, metres + 0.001, 0.02):
        there = [(ox - x, oy) for ox, oy in obstacles]
        ahead = [(ox, oy) for ox, oy in there if abs(math.atan2(oy, ox - 0.14)) < math.radians(118)]
        guard.observe(scan(now, *ahead))
        now += TICK
        guard.move(now, (1.0, 0.0, 0.0), 0.02)
    guard.observe(scan(now))
    return guard


@pytest.mark.parametrize("motion", [(0.4, -0.4, 3.0), (0.2, -0.2, 3.0)])
def test_a_turn_about_a_point_under_the_body_stays_off_unseen_ground_near_a_wall(motion):
    """The tail swings out of sight behind walls 18 cm beside the body; it need not turn about the middle for that."""
    assert guarding().free_distance((motion,)) == math.inf
    assert guarding(*((x, math.copysign(0.38, y)) for x, y in BESIDE)).free_distance((motion,)) < 0.1


def ahead(front, rear):
    """Unit twist of the truck with these axle angles."""
    return FourWheelSteering().body_twist(1.0, front, rear)


@pytest.mark.parametrize("rear", [0.4, -0.4])
def test_ahead_the_tail_does_not_swing_onto_ground_that_no_scan_has_seen(rear):
    guard = guarding(*BESIDE)
    guard.free_distance((ahead(0.0, rear),))
    poses = swept_poses(ahead(0.0, rear), np.array([guard.known, guard.known + 0.05]))
    corner = np.array([(-FOOTPRINT.half_length, math.copysign(FOOTPRINT.half_width, rear))])
    swung = [abs(y) - FOOTPRINT.half_width for y in at_poses(corner, poses)[:, 0, 1]]
    assert 0.0 < swung[0] < DRIFT < swung[1]
    passed = passing()
    passed.free_distance((ahead(0.0, rear),))
    assert passed.known == passed.known_slowly == math.inf, "the lidar has passed that ground"


@pytest.mark.parametrize(
    ("ahead_of_it", "beside_it", "stops"),
    [(0.28, 0.02, True), (0.5, 0.02, False), (0.2, 0.06, True), (0.2, 0.2, False)],
)
def test_a_wall_along_the_body_stops_the_tail_and_one_further_off_slows_it(ahead_of_it, beside_it, stops):
    """A corridor of 0.9 m leaves 0.2 m beside a tail that swings out."""
    guard = guarding((-FOOTPRINT.half_length + ahead_of_it + 0.03, FOOTPRINT.half_width + 0.03 + beside_it))
    guard.free_distance((ahead(0.0, 0.4),))
    assert (guard.known < 0.1) is stops
    assert guard.known_slowly < 0.1


@pytest.mark.parametrize(
    "motion", [(0.0, 0.4), (0.3, 0.3), (-0.4, 0.4), (0.2, 0.4)], ids=["rear", "parallel", "counter", "both"]
)
def test_a_body_does_not_creep_sideways_onto_unseen_ground(motion):
    """Each scan would allow it as much again if ground beside a moving body counted as free."""
    guard, now, twist, travelled = guarding(*BESIDE), SECOND, ahead(*motion), 0.0
    for _ in range(300):
        guard.free_distance((twist,))
        if (pace := min(guard.allowed_before_unseen(now), 0.2)) < GateConfig().obstacle.crawl:
            break
        for _ in range(5):
            now += TICK
            guard.move(now, tuple(pace * part for part in twist), 0.02)
            travelled += pace * 0.02
        guard.observe(scan(now, *BESIDE))
    before = FOOTPRINT.edge_points(9, 9)
    (after,) = at_poses(before, swept_poses(twist, np.array([travelled])))
    behind = before[:, 0] < 0
    assert 0.0 < np.abs(after - before)[behind, 1].max() < DRIFT


@pytest.mark.parametrize("front", [0.436, 0.2, 0.0, -0.436])
def test_ahead_a_truck_that_has_seen_nothing_yet_may_steer_with_its_front_axle(front):
    guard = guarding()
    assert guard.free_distance((ahead(front, 0.0),)) == math.inf
    assert guard.known == guard.known_slowly == math.inf


@pytest.mark.parametrize(("rear", "free"), [(0.4, False), (-0.4, True)])
def test_ahead_the_tail_does_not_swing_against_what_the_lidar_has_left_behind(rear, free):
    post = (0.5, FOOTPRINT.half_width + 0.03)  # beside the tail at the end
    assert (passing(post).free_distance((ahead(0.0, rear),)) == math.inf) is free


def test_a_lidar_that_looks_backwards_lets_it_drive_ahead_where_it_has_been():
    guard, now = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints((-0.14, 0.0, math.pi))]), SECOND
    guard.observe(scan(now))
    assert guard.free_distance((ahead(0.0, 0.0),)) == math.inf
    assert guard.known < DRIFT
    for _ in range(200):
        now += TICK
        guard.move(now, (-0.2, 0.0, 0.0), 0.02)
    guard.observe(scan(now))
    guard.free_distance((ahead(0.0, 0.0),))
    assert guard.known == math.inf


@pytest.mark.parametrize("angles", [(0.436, 0.0), (0.0, 0.2)])
def test_ground_under_the_body_is_known_though_it_is_not_known_how_it_moves(angles):
    guard = guarding()
    guard.move(2 * SECOND, None, 0.02)
    guard.free_distance((ahead(*angles),))
    assert guard.known_slowly > DRIFT


@pytest.mark.parametrize(("beside", "behind"), [(0.5, 0.35), (0.35, 0.5)])
def test_sideways_the_nearer_of_what_is_seen_and_what_is_remembered_counts(beside, behind):
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    guard.observe(scan(SECOND, (0.3, behind)))
    now = SECOND
    for _ in range(120):
        now += TICK
        guard.move(now, (0.2, 0.0, 0.0), 0.02)
    guard.observe(scan(now, (0.1, beside)))
    nearest = min(beside - GateConfig().obstacle.side_clearance, behind + FOOTPRINT.padding)
    assert guard.free_distance(((0.0, 1.0, 0.0),)) == pytest.approx(nearest - FOOTPRINT.half_width, abs=0.02)


@pytest.mark.parametrize(("aside", "stopped"), [(0.275, True), (0.295, False)])
def test_a_turn_grazes_nothing_that_the_lidar_has_left_behind(aside, stopped):
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    now = SECOND
    for x in np.arange(0.35, -0.05, -0.004):
        now += TICK
        guard.move(now, (0.2, 0.0, 0.0), 0.02)
        guard.observe(scan(now, *([(x, -aside)] if x > 0.0 else [])))
    for _ in range(20):
        now += TICK
        guard.move(now, (0.0, 0.0, 0.0), 0.02)
        guard.observe(scan(now))
    free = guard.free_distance(((0.0, 0.0, 7.0),))
    assert (free < 0.2) is stopped


def test_what_stands_beside_the_way_in_guards_the_way_out_again():
    """A truck passed a door, and touched its jamb when it backed out: 1.5 m travelled lay between."""
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    guard.observe(scan(SECOND, (0.35, 0.3)))
    now = SECOND
    for speed, seconds in ((0.2, 5.0), (-0.1, 5.5)):
        for _ in range(round(seconds / 0.02)):
            now += TICK
            guard.move(now, (speed, 0.0, 0.0), 0.02)
    guard.observe(scan(now))
    assert guard.free_distance(((0.0, 1.0, 0.0),)) < 0.3 + FOOTPRINT.padding - FOOTPRINT.half_width + 0.02


def person(x, y, angles):
    """Points around somebody who stands there, 0.2 m in radius; the first direction is the lidar's."""
    towards = math.atan2(-y, 0.14 - x)
    return [(x + 0.2 * math.cos(towards + angle), y + 0.2 * math.sin(towards + angle)) for angle in angles]


def test_a_turn_stops_before_the_side_of_somebody_that_the_lidar_does_not_see():
    somebody, turn = (-0.05, -0.42), (0.0, 0.0, 7.0)
    seen = [p for p in person(*somebody, np.linspace(-1.4, 1.4, 80)) if math.atan2(p[1], p[0] - 0.14) > -math.tau / 3]
    distances = np.linspace(0.0, 0.3, 301)
    contacts = [
        distances[first_contact(FOOTPRINT, swept_poses(turn, distances), np.array(points))]
        for points in (person(*somebody, np.linspace(0.0, math.tau, 200)), seen)
    ]
    assert contacts[0] < contacts[1] - 0.01, "it is the side that is not seen"
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    guard.observe(scan(SECOND, *seen))
    assert guard.free_distance((turn,)) < contacts[0]
    for twist in ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        assert guard.free_distance((twist,)) == math.inf, "in reverse and sideways such ground is no obstacle"
        assert min(guard.known, guard.known_slowly) < DRIFT


@pytest.mark.parametrize(("apart", "stopped"), [(0.16, True), (0.2, False)])
def test_ground_that_nobody_has_seen_is_not_turned_onto_next_to_something(apart, stopped):
    """The rear right corner moves on towards a point that it never touches."""
    corner = np.array((-FOOTPRINT.half_length, -FOOTPRINT.half_width))
    post = corner * (1.0 + apart / np.hypot(*corner))
    ahead = np.add(post, (0.6, 0.0))
    bearing = math.degrees(math.atan2(ahead[1], ahead[0] - 0.14))
    guard = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)])
    now = SECOND
    guard.observe(scan(now, tuple(ahead), unknown=((-120, bearing - 1, 3), (bearing + 1, 120, 3))))
    for _ in range(150):
        now += TICK
        guard.move(now, (0.2, 0.0, 0.0), 0.02)
    guard.observe(scan(now))
    assert (guard.free_distance(((0.0, 0.0, 7.0),)) < 0.1) is stopped


def surround(rig, *obstacles):
    """Scans of obstacles that stay where they are while the truck drives straight on."""
    sense = rig.sense

    def look():
        there = [(ox - rig.x, oy) for ox, oy in obstacles]
        rig.obstacles = [(x, y) for x, y in there if abs(math.atan2(y, x - 0.14)) < math.radians(120)]
        sense()

    rig.sense = look
    obey = rig._obey

    def moved():
        obey()
        rig.x += rig.speed * 0.02

    rig.x, rig._obey = 0.0, moved
    return rig


def test_in_reverse_the_truck_drives_where_it_came_from_and_stops_before_ground_that_no_scan_has_seen():
    rig = surround(Rig()).driving(speed=-0.15)
    assert rig.out.reasons == (Reason.UNSEEN_STOP,)
    assert rig.out.speeds[0] == 0.0
    rig = surround(Rig(disarm_after=5.0)).driving(ticks=200, speed=0.2)
    rig.driver = {"speed": -0.15}
    rig.tick(40)
    assert rig.out.reasons == ()
    assert rig.out.speeds[0] == pytest.approx(-0.15)
    rig.tick(400)
    assert rig.out.reasons == (Reason.UNSEEN_STOP,), "before the place where it began"
    assert 0.0 < rig.x < 0.1
    assert rig.trips[-1].reason is Reason.UNSEEN_STOP
    figure = rig.trips[-1].causes[0].measurements[0]
    assert (figure.name, figure.unit, figure.limit) == ("seen distance", "m", DRIFT)
    rig.driver = {"speed": -0.15, "unseen": True}
    rig.tick(100)
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)
    assert rig.out.speeds[0] == pytest.approx(-0.05), "the operator holds the second control"
    assert rig.x < 0.0


@pytest.mark.parametrize("shown", [0.3, 0.7])
def test_in_reverse_a_drive_that_reports_less_than_it_turns_does_not_pass_the_edge_of_seen_ground(shown):
    rig = surround(Rig(disarm_after=5.0)).driving(ticks=200, speed=0.2)
    rig.driver, rig.shown = {"speed": -0.15}, shown
    rig.tick(400)
    assert rig.out.reasons == (Reason.UNSEEN_STOP,)
    assert rig.x > -DRIFT


@pytest.mark.parametrize("shown", [0.7, 0.9])
def test_ahead_a_drive_that_reports_less_than_it_turns_is_not_limited_where_the_lidar_looks(shown):
    rig = surround(Rig(disarm_after=5.0))
    rig.shown = shown
    rig.driving(ticks=500, speed=0.2)
    assert check_of(rig.gate, ObstacleCheck).guard.memory.unsure > 0.0
    assert rig.out.reasons == ()
    assert rig.out.speeds[0] == pytest.approx(0.2)


def test_a_stop_before_unseen_ground_names_the_doubt_about_the_travelled_distance():
    rig = surround(Rig(disarm_after=5.0)).driving(ticks=200, speed=0.2)
    rig.driver, rig.shown = {"speed": -0.15}, 0.3
    rig.tick(400)
    distance, doubt = check_of(rig.gate, ObstacleCheck).figures(Reason.UNSEEN_STOP, rig.now)
    assert 0.0 <= distance.value <= 2 * DRIFT
    assert (doubt.name, doubt.unit) == ("travel doubt", "m")
    assert doubt.value > 0.05


def test_remembered_obstacles_are_nearer_by_the_doubt_about_the_travelled_distance_beyond_the_padding():
    def beside(doubt):
        guard, now = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)]), SECOND
        guard.observe(scan(now, (0.3, 0.35)))
        for _ in range(120):
            now += TICK
            guard.move(now, (0.2, 0.0, 0.0), 0.02, doubt)
        guard.observe(scan(now))
        return guard.free_distance(((0.0, 1.0, 0.0),))

    free, padding = beside(0.0), FOOTPRINT.padding
    assert 0.1 < free < 0.3
    assert beside(padding) == free
    assert beside(padding + 0.05) == beside(-padding - 0.05) == pytest.approx(free - 0.05)
    assert beside(10.0) == 0.0


def test_a_remembered_obstacle_is_nearer_only_by_the_doubt_since_it_was_seen():
    def beside(doubt):
        guard, now = ObstacleGuard(InForce(GateConfig()), FOOTPRINT, [ScanPoints(MOUNT)]), SECOND
        guard.observe(scan(now))
        for target in (None, (0.3, 0.35)):
            for _ in range(120):
                now += TICK
                guard.move(now, (0.2, 0.0, 0.0), 0.02, doubt)
            guard.observe(scan(now) if target is None else scan(now, target))
        for _ in range(120):
            now += TICK
            guard.move(now, (0.2, 0.0, 0.0), 0.02, doubt)
        guard.observe(scan(now))
        assert (guard.memory.unsure > 0.0) is (doubt > 0.0)
        return guard.free_distance(((0.0, 1.0, 0.0),))

    assert 0.1 < beside(0.5) == beside(0.0) < 0.3


def test_ahead_the_gate_slows_down_a_tail_that_swings_towards_unseen_ground():
    assert Reason.UNSEEN_SLOW in surround(Rig()).driving(speed=0.15, rear=0.4, ticks=20).out.reasons


def test_ground_may_only_slow_the_truck_where_that_is_configured():
    rig = surround(Rig(obstacle={"unseen": "slow"})).driving(speed=-0.15)
    assert rig.out.reasons == (Reason.UNSEEN_SLOW,)
    assert rig.out.speeds[0] == pytest.approx(-0.1)


def test_ground_only_slows_a_truck_that_is_armed_to_calibrate():
    rig = surround(Rig()).armed(calibrates=True)
    rig.driver = {"speed": -0.15}
    rig.tick(40)
    assert rig.out.reasons == (Reason.UNSEEN_SLOW,)
    assert rig.out.speeds[0] == pytest.approx(-0.1)


def test_the_second_control_is_for_operators_alone():
    rig = surround(Rig()).armed()
    rig.driver = {"speed": -0.15, "unseen": True, "source": "path", "role": Role.TRACKER, "inside": True}
    rig.tick(40)
    assert rig.out.reasons == (Reason.UNSEEN_STOP,)
    assert rig.out.speeds[0] == 0.0


@pytest.mark.parametrize(("side", "slows"), [(1.0, True), (-1.0, False)])
def test_in_reverse_the_truck_slows_down_for_what_it_has_passed(side, slows):
    post = (0.25, side * (FOOTPRINT.half_width + 0.03))  # free of the truck that drives straight on
    rig = surround(Rig(disarm_after=5.0), post).driving(ticks=150, speed=0.2)
    assert rig.out.mode is GateMode.DRIVING
    assert rig.x - BACK > post[0], "passed, and out of the lidar's sight"
    rig.driver = {"speed": -0.15, "front": 0.4, "rear": -0.4}  # the tail to the left
    reasons = {reason for _ in range(80) for reason in rig.tick().reasons}
    assert (Reason.OBSTACLE_SLOW in reasons) == slows


def rested(rig):
    """A truck that has come some way, and stands disarmed since."""
    rig = surround(rig).driving(ticks=200, speed=0.2)
    rig.driver = None
    rig.order(Order.DISARM)
    rig.tick(60)
    assert rig.out.mode is GateMode.DISARMED
    return rig


def backs_up(rig):
    rig.order(Order.ARM)
    rig.driver = {"speed": -0.15}
    rig.tick(40)
    return rig.out.reasons


def wall(now, distance, *people):
    """A scan of a wall across the way, and of people before it, each from one beam to another, m away."""
    bearing = np.linspace(-math.radians(120), math.radians(120), 682)
    ranges = np.minimum(distance / np.maximum(np.cos(bearing), 0.1), 3.9)
    for first, last, away in people:
        ranges[first:last] = away
    return scan(now).model_copy(update={"ranges": ranges, "codes": np.full(682, 255, np.uint8)})


def test_what_was_seen_counts_after_a_truck_that_has_stood_is_armed_again():
    assert backs_up(rested(Rig(disarm_after=5.0))) == ()


def test_a_truck_that_was_carried_or_pushed_while_it_was_not_armed_has_seen_nothing_behind_it():
    rig = rested(Rig(disarm_after=5.0))
    sense = rig.sense
    rig.sense = lambda: (sense(), rig.gate.observe(wall(rig.now, 1.5), topics.SCAN))
    rig.tick(20)
    assert backs_up(rig) == (Reason.UNSEEN_STOP,)
    rig = rested(Rig(disarm_after=5.0))
    rig._obey, rig.speed, rig.mode, rig.current = (lambda: None), 0.1, DriveMode.DISABLED, 0.0
    rig.tick(20)
    rig.speed, rig.mode = 0.0, DriveMode.ENABLED
    rig._obey = type(rig)._obey.__get__(rig)
    rig.tick(20)
    assert backs_up(rig) == (Reason.UNSEEN_STOP,)


def test_a_drive_whose_velocity_trembles_at_rest_does_not_hide_that_the_truck_was_carried():
    rig = rested(Rig(disarm_after=5.0))
    sense, obey = rig.sense, rig._obey
    rig._obey = lambda: None
    signs = itertools.cycle((1.0, -1.0))

    def trembling():
        rig.speed = 0.002 * next(signs)
        sense()

    rig.sense = trembling
    rig.tick(20)
    rig.silent = {"scan"}
    rig.sense = lambda: (trembling(), rig.gate.observe(wall(rig.now, 1.5), topics.SCAN))
    rig.tick(20)
    rig.sense, rig._obey, rig.silent = sense, obey, set()
    rig.speed = 0.0
    assert backs_up(rig) == (Reason.UNSEEN_STOP,)


def test_a_truck_that_has_driven_to_another_place_was_not_carried():
    rig = rested(Rig(disarm_after=5.0))
    rig.order(Order.ARM)
    sense, rig.silent = rig.sense, {"scan"}
    rig.sense = lambda: (sense(), rig.gate.observe(wall(rig.now, 3.0), topics.SCAN))
    rig.driver = {"speed": 0.2}
    rig.tick(50)
    rig.driver = None
    rig.order(Order.DISARM)
    rig.tick(60)
    assert backs_up(rig) == ()


def test_a_truck_whose_wheels_are_not_heard_may_have_been_moved():
    rig = rested(Rig(disarm_after=5.0))
    rig.silent.add("drive")
    rig.tick(20)
    rig.silent.clear()
    rig.tick(20)
    assert backs_up(rig) == (Reason.UNSEEN_STOP,)


def test_scans_of_another_place_differ_from_those_of_people_who_pass():
    here = wall(SECOND, 2.0)
    assert not elsewhere(here, wall(SECOND, 2.05)), "noise"
    assert elsewhere(here, wall(SECOND, 1.7))
    assert not elsewhere(here, wall(SECOND, 2.0, (300, 400, 0.6), (500, 560, 1.0)))
    assert elsewhere(here, here.model_copy(update={"ranges": np.ones(3), "codes": np.full(3, 255, np.uint8)}))
    open_ground = scan(SECOND, (1.0, 0.0))
    assert not elsewhere(open_ground, open_ground)
    assert elsewhere(here, open_ground)


def test_ground_seen_from_a_place_less_certain_counts_less_and_at_last_not_at_all():
    remembered = ScanMemory(FOOTPRINT, [MOUNT], 2.0, 30.0, 0.05)
    see(remembered, SECOND)
    now = drive(remembered, 0.4)

    def grown(deviation):
        remembered.doubt((0.0, 0.0), np.array([deviation**2, 0, 0, 0, 0.0, 0, 0, 0, 0.0]))
        see(remembered, now)

    edge = -BACK - 0.4 - DRIFT
    grown(0.0)
    assert seen(remembered, edge + 0.01)
    grown(0.03)
    assert seen(remembered, edge + 0.01, edge + 0.03) == [False, True], "the padding of the footprint is left"
    grown(0.0499)
    assert seen(remembered, -BACK - 0.3)
    grown(0.0501)
    assert not seen(remembered, -BACK - 0.3)
    assert seen(remembered, 0.6), "the newest scan"


def test_an_error_of_the_heading_counts_at_the_length_of_a_truck():
    remembered = ScanMemory(FOOTPRINT, [MOUNT], 2.0, 30.0, 0.05)
    see(remembered, SECOND)
    now = drive(remembered, 0.4)
    remembered.doubt((0.0, 0.0), np.array([0.0] * 8 + [0.06**2]))
    see(remembered, now)
    assert not seen(remembered, -BACK - 0.3)


@pytest.mark.parametrize("heading", [0.0, 2.0])
@pytest.mark.parametrize(("gained", "known"), [(0.0, True), (0.04, True), (0.06, False)])
def test_an_error_of_the_heading_from_before_a_scan_moves_no_ground_that_it_saw(heading, gained, known):
    remembered = ScanMemory(FOOTPRINT, [MOUNT], 2.0, 30.0, 0.05)
    lost = PlanarCovariance(xx=1.0, xy=0.2, yy=2.0, xw=0.3, yw=-0.1, ww=0.5)  # a long way without a compass
    remembered.doubt((7.0, -3.0), lost.matrix().ravel())
    see(remembered, SECOND)
    now = drive(remembered, 0.4)
    dx, dy = 0.4 * math.cos(heading), 0.4 * math.sin(heading)
    remembered.doubt((7.0 + dx, -3.0 + dy), lost.moved(dx, dy).plus((0, 0, 0, 0, 0, gained**2)).matrix().ravel())
    see(remembered, now)
    assert seen(remembered, -BACK - 0.3) is known


@pytest.mark.parametrize("unknown", [math.nan, math.inf])
def test_a_pose_that_is_no_number_makes_everything_unseen(unknown):
    remembered = memory()
    see(remembered, SECOND)
    now = drive(remembered, 0.4)
    for odometry in (((0.0, unknown), np.zeros(9)), ((0.0, 0.0), np.full(9, unknown))):
        remembered.doubt(*odometry)
        see(remembered, now)
        assert not seen(remembered, -BACK - 0.2)
        assert remembered.unsure == 0.0


@pytest.mark.parametrize("variance", [0.0, 0.04])
def test_odometry_whose_place_jumps_makes_everything_unseen(variance):
    for restarts in (False, True):
        remembered = ScanMemory(FOOTPRINT, [MOUNT], 2.0, 30.0, 0.1)
        remembered.doubt((20.0, 0.0), np.diag((0.04, 0.04, 0.0)).ravel())
        remembered.doubt((20.0, 0.0), np.diag((0.04, 0.04, 0.0)).ravel())
        see(remembered, SECOND)
        now = drive(remembered, 0.05)
        if restarts:
            remembered.doubt((0.0, 0.0), np.diag((variance, variance, 0.0)).ravel())
        see(remembered, now)
        assert seen(remembered, -BACK - 0.05) is not restarts


def test_a_survey_shrinks_by_the_doubt_about_the_travelled_distance():
    def cells(doubt):
        remembered = memory()
        see(remembered, SECOND)
        now = SECOND + TICK
        remembered.move(now, (0.2, 0.0, 0.0), 0.02, doubt)
        see(remembered, now)
        return surveyed(remembered)

    certain, doubtful = cells(0.0), cells(FOOTPRINT.padding + 0.12)
    assert (doubtful.ages < 0).sum() > (certain.ages < 0).sum()
    assert (certain.ages[doubtful.ages >= 0] >= 0).all()


def test_what_a_truck_that_stands_sees_does_not_age():
    remembered = memory()
    for second in range(1, 41):
        see(remembered, second * SECOND, (0.3, 0.4))
    now = drive(remembered, 0.6, now=40 * SECOND)
    assert len(see(remembered, now)) == 1
    assert seen(remembered, -BACK - 0.5)


def test_what_has_left_the_sight_of_a_truck_that_stands_is_remembered():
    remembered = memory()
    see(remembered, SECOND, (0.0, 0.4))
    for second in range(2, 10):
        see(remembered, second * SECOND)
    assert len(see(remembered, drive(remembered, 0.2, now=10 * SECOND))) == 1


def surveyed(remembered):
    steps = remembered.survey()
    try:
        while True:
            next(steps)
    except StopIteration as done:
        return done.value


def test_a_survey_shows_what_counts_as_seen_and_for_how_long():
    assert surveyed(memory()) is None
    remembered = memory()
    see(remembered, SECOND)
    now = drive(remembered, 0.8) + 12 * SECOND
    see(remembered, now)
    found = surveyed(remembered)
    assert found.stamp == now

    def at(x, y):
        return int(found.ages[round(y / MAP_CELL - 0.5) + MAP_SIZE // 2, round(x / MAP_CELL - 0.5) + MAP_SIZE // 2])

    assert at(1.0, 0.0) == at(0.0, 0.0) == 0, "seen now"
    assert at(-0.8, 0.0) == pytest.approx(100 * (now - SECOND) / (30 * SECOND), abs=1), "the body stood there"
    assert at(-1.4, 0.0) == -1
    middle = (np.arange(MAP_SIZE) + 0.5 - MAP_SIZE / 2) * MAP_CELL
    cells = np.column_stack((np.tile(middle, MAP_SIZE), np.repeat(middle, MAP_SIZE)))
    assert (remembered.seen(cells) == (found.ages.ravel() >= 0)).all()
