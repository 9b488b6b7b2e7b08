"""A lidar that does not see: covered, dazzled, mirrored, or blind."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint, on_body, scan_points, swept_poses
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.sensor import HIDDEN, VALID_BEAM
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.obstacles import OUTLINE, ObstacleCheck, ground_ahead
from monstertruckd.gate.visibility import SECTORS, Visibility, travelled
from tests.unit.gate.rig import Rig, check_of, scan

FOOTPRINT = Footprint()
MOUNT = (0.14, 0.0, 0.0)
ALL = (-120.0, 120.0)
AHEAD = swept_poses((1.0, 0.0, 0.0), np.linspace(0.0, 0.4, 20))
LEFT = swept_poses((1.0, 0.0, 2.0), np.linspace(0.0, 0.4, 40))


def travelled_by(visibility, poses, body=FOOTPRINT):
    """Sectors of the ground that the body newly covers at poses."""
    (sectors,) = travelled(
        [visibility], body, ground_ahead(body, body.edge_points(OUTLINE, OUTLINE), poses).reshape(-1, 2)
    )
    return sectors


def seen(message):
    """Sectors that one scan sees, of those ahead."""
    visibility = Visibility(Footprint(), MOUNT, 0.5)
    visibility.observe(message, scan_points(message, MOUNT))
    return visibility.last_seen(travelled_by(visibility, AHEAD)) > 0


@pytest.mark.parametrize("code", [3, 4, 5, *range(6, 20)])
def test_codes_that_say_nothing_stop_the_truck_within_half_a_second(code):
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((-119.0, 120.0, code),)
    rig.tick()
    assert Reason.LIDAR_SLOW in rig.out.reasons
    assert rig.out.speed_limit == 0.1
    rig.tick(25)
    assert Reason.LIDAR_BLIND in rig.out.reasons
    assert rig.speed == 0.0
    assert [trip.reason for trip in rig.trips] == [Reason.LIDAR_BLIND]
    assert Reason.LIDAR_BLIND in {event.reason for event in rig.events}


@pytest.mark.parametrize("code", [0, 1, 2])
def test_codes_that_say_nothing_is_there_are_free_ground(code):
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((-119.0, 120.0, code),)
    rig.tick(50)
    assert rig.out.reasons == ()
    assert rig.speed == pytest.approx(0.2)


@pytest.mark.parametrize("code", [0, 2, 7, 19])
def test_a_scan_without_any_range_is_blind_whatever_its_codes(code):
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((*ALL, code),)
    rig.tick(40)
    assert rig.speed == 0.0
    assert Reason.SCAN_STALE in rig.out.reasons
    measured = {figure.name: figure.value for figure in rig.trips[0].causes[0].measurements}
    assert measured["beams with a range"] == 0.0


def test_a_blind_truck_cannot_be_armed():
    rig = Rig()
    rig.unknown = ((*ALL, 19),)
    rig.tick(3)
    assert rig.order(Order.ARM) is Reason.SCAN_STALE


def test_open_ground_has_to_be_configured():
    rig = Rig(obstacle={"open_ground": True}).driving(speed=0.2)
    rig.unknown = ((*ALL, 0),)
    rig.tick(50)
    assert rig.speed == pytest.approx(0.2)
    rig.unknown = ((*ALL, 7),)
    rig.tick(50)
    assert rig.speed == 0.0


@pytest.mark.parametrize("covered", [(0.0, 120.0), (-119.0, 0.0), (-30.0, 30.0), (-6.0, 6.0)])
def test_a_covered_part_ahead_stops_but_leaves_the_way_back(covered):
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((*covered, 6),)
    rig.tick(30)
    assert rig.speed == 0.0
    assert Reason.LIDAR_BLIND in rig.out.reasons
    rig.driver = {"speed": -0.1}
    rig.tick(40)
    assert rig.speed == pytest.approx(-0.1)


def test_what_is_covered_aside_of_the_way_does_not_matter():
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((100.0, 119.0, 6),)
    rig.tick(30)
    assert rig.speed == pytest.approx(0.2)


def test_one_scan_that_does_not_see_slows_and_does_not_stop():
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((-20.0, 20.0, 10),)
    rig.tick(5)
    assert 0.1 <= rig.speed < 0.2
    rig.unknown = ()
    rig.tick(30)
    assert rig.speed == pytest.approx(0.2)
    assert not rig.trips


def test_an_obstacle_stays_where_it_was_seen_while_its_sector_is_not_seen():
    rig = Rig().driving(speed=0.2)
    rig.obstacles = tuple((0.40, y) for y in np.linspace(-0.1, 0.1, 9))
    rig.tick(3)
    slow = rig.out.speed_limit
    rig.unknown = ((-40.0, 40.0, 18),)
    rig.tick()
    assert rig.out.speed_limit <= slow


def test_a_hand_before_the_window_is_no_view():
    """Its ranges end within the body."""
    message = scan(SECOND, *((0.14 + 0.04 * math.cos(a), 0.04 * math.sin(a)) for a in np.linspace(-1.0, 1.0, 500)))
    assert not seen(message).all()


def test_few_failed_beams_are_a_view():
    """A recorded URG-04LX fails on two to five beams of a hundred."""
    message = scan(SECOND, unknown=tuple((angle, angle + 1.0, 7) for angle in range(-60, 60, 5)))
    assert seen(message).all()


def test_sectors_of_travel_are_those_of_the_ground_it_takes():
    visibility = Visibility(Footprint(), MOUNT, 0.5)
    visibility.observe(message := scan(SECOND), scan_points(message, MOUNT))
    ahead, left = travelled_by(visibility, AHEAD), travelled_by(visibility, LEFT)
    middle = SECTORS // 2
    assert {middle - 1, middle} <= set(ahead)
    assert {middle - 9, middle + 8}.isdisjoint(ahead)
    assert max(left) > max(ahead)
    back = travelled_by(visibility, swept_poses((-1.0, 0.0, 0.0), np.linspace(0.0, 0.4, 20)))
    assert (visibility.last_seen(back) < 0).any()


def test_a_lidar_that_has_never_seen_the_way_keeps_the_truck_standing():
    rig = Rig()
    rig.unknown = ((-119.0, 120.0, 7),)
    rig.driving(speed=0.2)
    assert Reason.LIDAR_BLIND in rig.out.reasons
    assert rig.travelled == 0.0


def test_a_way_not_seen_for_the_scans_limit_itself_is_driven_slowly():
    rig = Rig(scan={"stale_after": 0.24}).driving(speed=0.2)
    rig.unknown = ((-119.0, 120.0, 7),)
    rig.tick(12)
    assert check_of(rig.gate, ObstacleCheck).guard.unseen == 0.24
    assert Reason.LIDAR_SLOW in rig.out.reasons
    rig.tick()
    assert Reason.LIDAR_BLIND in rig.out.reasons


def test_the_mode_stays_driving_and_goes_on_when_the_lidar_sees_again():
    rig = Rig().driving(speed=0.2)
    rig.unknown = ((-30.0, 30.0, 6),)
    rig.tick(30)
    assert rig.out.mode is GateMode.DRIVING
    rig.unknown = ()
    rig.tick(40)
    assert rig.speed == pytest.approx(0.2)


EDGE = np.linspace(-1.0, 1.0, 9)
LENGTH, WIDTH = Footprint().half_length, Footprint().half_width
ENDS = [
    ((1.0, 0.0, 0.0), [(LENGTH + 0.2, y * WIDTH) for y in EDGE]),
    ((-1.0, 0.0, 0.0), [(-LENGTH - 0.2, y * WIDTH) for y in EDGE]),
    ((0.0, 1.0, 0.0), [(x * LENGTH, WIDTH + 0.2) for x in EDGE]),
    ((0.0, -1.0, 0.0), [(x * LENGTH, -WIDTH - 0.2) for x in EDGE]),
]


@pytest.mark.parametrize(("way", "ground"), ENDS)
@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_every_part_of_the_outline_travels_over_its_ground(way, ground, offset):
    body = Footprint(offset=offset)
    visibility = Visibility(body, MOUNT, 0.5)
    sectors = travelled_by(visibility, swept_poses(way, np.linspace(0.0, 0.2, 20)), body)
    points = np.array(ground) + np.array((offset, 0.0))
    assert set(visibility.sectors_of(points)) <= set(sectors)
    middle = points.mean(axis=0)
    opposite = visibility.sectors_of(np.array([(2 * offset - middle[0], -middle[1])]))
    assert set(opposite).isdisjoint(sectors)


@pytest.mark.parametrize(("way", "travels"), [(0.004, False), (0.006, True), (-0.004, False), (-0.006, True)])
def test_ground_within_half_a_centimetre_of_the_body_is_not_travelled(way, travels):
    visibility = Visibility(Footprint(), MOUNT, 0.5)
    for pose in ((way, 0.0, 0.0), (0.0, way, 0.0)):
        assert (len(travelled_by(visibility, np.array([(0.0, 0.0, 0.0), pose]))) > 0) is travels


@pytest.mark.parametrize("body", [FOOTPRINT, Footprint(offset=0.1)])
def test_a_step_covers_the_ground_that_its_leading_edge_reaches(body):
    front, back = body.offset + body.half_length, body.offset - body.half_length
    for sign, edge in ((1.0, front), (-1.0, back)):
        ground = ground_ahead(
            body, body.edge_points(OUTLINE, OUTLINE), swept_poses((sign, 0.0, 0.0), np.linspace(0.0, 0.2, 5))
        )
        for points, distance in zip(ground, (0.05, 0.1, 0.15, 0.2), strict=True):
            assert points[:, 0].min() >= min(edge, edge + sign * distance) - 1e-9
            assert points[:, 0].max() <= max(edge, edge + sign * distance) + 1e-9
            inner = np.abs(points[:, 1]) < body.half_width - 0.01
            assert points[inner, 0] == pytest.approx(edge + sign * distance)
            assert inner.sum() > 8
            assert np.abs(points[:, 1]).max() == pytest.approx(body.half_width)


def test_a_tail_that_swings_out_by_a_millimetre_a_step_covers_ground():
    poses = swept_poses((1.0, 0.0, 0.5), np.linspace(0.0, 0.2, 41))
    ground = ground_ahead(FOOTPRINT, FOOTPRINT.edge_points(OUTLINE, OUTLINE), poses)
    tail = ground[..., 0] < -LENGTH + 0.1
    assert ground[tail][:, 1].min() < -WIDTH - 0.008
    assert len(ground_ahead(FOOTPRINT, FOOTPRINT.edge_points(OUTLINE, OUTLINE), np.zeros((5, 3))).reshape(-1, 2)) == 0


def test_a_turn_on_the_spot_travels_over_the_ground_of_all_corners():
    visibility = Visibility(Footprint(), MOUNT, 0.5)
    sectors = travelled_by(visibility, swept_poses((0.0, 0.0, 5.0), np.linspace(0.0, 0.1, 20)))
    turned = np.array([math.atan2(y, x) + 0.4 for x in (LENGTH, -LENGTH) for y in (WIDTH, -WIDTH)])
    corners = math.hypot(LENGTH, WIDTH) * np.column_stack((np.cos(turned), np.sin(turned)))
    assert set(visibility.sectors_of(corners)) <= set(sectors)


def test_a_lidar_that_is_mounted_aside_and_turned_looks_from_there():
    visibility = Visibility(Footprint(), (0.1, 0.05, math.pi / 2), 0.5)
    middle = SECTORS // 2
    (left,) = visibility.sectors_of(np.array([(0.1 - 0.001, 1.05)]))
    (ahead,) = visibility.sectors_of(np.array([(0.2, 0.05 + 0.001)]))
    assert left in (middle - 1, middle)
    assert ahead == middle - SECTORS // 4


# Sectors at their limits: a lidar at the origin with four beams to a sector, each in the middle of its quarter


BEAMS = 4
FAR, CLOSE = 2.0, 0.1
MIDDLE = SECTORS // 2


def looked(visibility, ranges, codes=None, *, stamp=SECOND, first=MIDDLE * BEAMS, left=True):
    """When each sector of the field was seen, after a scan whose beams begin at the ``first`` one from the rear."""
    step = math.tau / SECTORS / BEAMS
    ends = [-math.pi + (first + i + 0.5) * step for i in (0, len(ranges) - 1)]
    begin, end = ends if left else reversed(ends)
    codes = [255 if math.isfinite(distance) else 7 for distance in ranges] if codes is None else codes
    arrays = {"ranges": np.array(ranges), "codes": np.array(codes, dtype=np.uint8)}
    message = scan(stamp).model_copy(update={"start_angle": begin, "end_angle": end, **arrays})
    visibility.observe(message, scan_points(message, (0.0, 0.0, 0.0)))
    field = np.flatnonzero(visibility._field)
    return dict(zip(field.tolist(), visibility.last_seen(field).tolist(), strict=True))


def view(share=0.5):
    return Visibility(Footprint(), (0.0, 0.0, 0.0), share)


@pytest.mark.parametrize(
    ("distance", "code", "sees"),
    [
        (FAR, 255, True),
        (LENGTH + 0.01, 255, True),
        (LENGTH - 0.01, 255, False),
        (CLOSE, 255, False),
        (math.inf, 255, False),
        (math.inf, 0, True),
        (math.inf, 2, True),
        (math.inf, 3, False),
        (FAR, 3, False),
    ],
)
def test_a_beam_sees_what_lies_outside_the_body_or_that_nothing_is_there(distance, code, sees):
    assert looked(view(), [distance] * BEAMS, [code] * BEAMS) == {MIDDLE: SECOND if sees else 0}


def test_a_range_that_ends_at_the_edge_of_the_body_is_outside():
    edges = np.array([(LENGTH, 0.0), (-LENGTH, 0.0), (0.0, WIDTH), (0.0, -WIDTH)])
    assert not on_body(Footprint(), edges, 0.0).any()
    assert on_body(Footprint(), edges * 0.999, 0.0).all()
    assert on_body(Footprint(), edges, 0.005).all()
    assert not on_body(Footprint(), edges * 1.05, 0.005).any()


@pytest.mark.parametrize(("failed", "sees"), [(1, True), (2, True), (3, False), (4, False)])
def test_a_sector_is_seen_by_half_of_its_beams(failed, sees):
    ranges = [math.inf] * failed + [FAR] * (BEAMS - failed)
    assert looked(view(), ranges) == {MIDDLE: SECOND if sees else 0}


@pytest.mark.parametrize(("beams", "known"), [(2, False), (3, True)])
@pytest.mark.parametrize("left", [True, False])
def test_a_sector_is_in_the_field_by_more_than_half_of_its_beams(beams, known, left):
    assert looked(view(), [FAR] * beams, left=left) == ({MIDDLE: SECOND} if known else {})


def test_every_sector_has_its_own_time_and_keeps_it_while_it_is_not_seen():
    visibility, blind, clear = view(), [math.inf] * BEAMS, [FAR] * BEAMS
    assert looked(visibility, [*clear, *blind]) == {MIDDLE: SECOND, MIDDLE + 1: 0}
    assert looked(visibility, [*blind, *clear], stamp=SECOND + 5) == {MIDDLE: SECOND, MIDDLE + 1: SECOND + 5}
    ahead_and_aside = np.array([(1.0, 0.01), (1.0, 0.25), (-1.0, 0.0)])
    assert visibility.age(ahead_and_aside, SECOND + 7).tolist() == [7, 2, SECOND + 7]


def test_a_scan_of_another_geometry_has_its_own_sectors():
    visibility, clear = view(), [FAR] * BEAMS
    for count, (first, sector) in enumerate([(MIDDLE, MIDDLE), (MIDDLE + 2, MIDDLE + 2), (MIDDLE, MIDDLE)]):
        assert looked(visibility, clear, stamp=SECOND + count, first=first * BEAMS)[sector] == SECOND + count
    assert looked(visibility, 2 * clear, stamp=9) == {MIDDLE: 9, MIDDLE + 1: 9}
    assert looked(visibility, clear, stamp=9, left=False) == {MIDDLE: 9}


def test_sectors_go_once_round_the_lidar():
    bearings = -math.pi + (np.arange(36) + 0.5) * math.radians(10)
    points = np.column_stack((np.cos(bearings), np.sin(bearings)))
    assert view().sectors_of(points).tolist() == list(range(36))
    assert view().sectors_of(np.array([(-1.0, 0.0)])).tolist() == [0], "straight behind begins anew"


def test_a_sector_behind_a_mast_is_outside_the_field_of_view():
    visibility = view()
    ranges, codes = np.full(BEAMS * SECTORS, FAR), np.full(BEAMS * SECTORS, VALID_BEAM)
    mast = slice(0, 2 * BEAMS)
    ranges[mast] = CLOSE
    field = looked(visibility, ranges, codes, first=0)
    assert field[0] == field[1] == 0, "its returns show that nothing is seen"
    ranges[mast], codes[mast] = math.inf, HIDDEN
    field = looked(visibility, ranges, codes, first=0)
    assert {0, 1}.isdisjoint(field)
    assert len(field) == SECTORS - 2
    assert all(field.values())


@pytest.mark.parametrize("hidden", [(0.0, 120.0), (-119.0, 0.0), (-30.0, 30.0), (-9.0, 9.0)])
def test_before_ground_ahead_that_the_lidar_cannot_see_it_stops(hidden):
    rig = Rig()
    rig.unknown = ((*hidden, HIDDEN),)
    rig.driving(speed=0.2, ticks=30)
    assert rig.speed == 0.0
    assert rig.out.reasons[0] is Reason.UNSEEN_STOP
    rig.driver = {"speed": 0.2, "unseen": True}
    rig.tick(40)
    assert rig.speed == pytest.approx(0.05), "the operator holds the second control"


def test_a_mast_beside_the_way_ahead_does_not_matter():
    rig = Rig()
    rig.unknown = ((100.0, 119.0, HIDDEN),)
    assert rig.driving(speed=0.2, ticks=30).speed == pytest.approx(0.2)
