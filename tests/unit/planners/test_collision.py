import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import (
    DiscFootprint,
    DistanceField,
    Footprint,
    clearance_to_points,
    first_contact,
    points_near,
    rectangle_distance,
    scan_points,
    swept_poses,
)
from monstertruck_planners.collision_kernels import segment_free
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid

BARE = Footprint(0.47, 0.34, 0.0)
ORIGIN = np.zeros((1, 3))
coordinate = st.floats(-2, 2)


def points(*rows):
    return np.array(rows, dtype=float)


def test_distances_of_a_known_rectangle():
    distance = rectangle_distance(BARE, ORIGIN, points((1.235, 0), (0, 1.17), (0.535, 0.57), (0, 0), (0.225, 0)))
    assert distance[0] == pytest.approx([1.0, 1.0, 0.5, -0.17, -0.01])


def test_padding_grows_every_side():
    padded = Footprint()
    assert clearance_to_points(padded, ORIGIN, points((1.245, 0)))[0] == pytest.approx(1.0)
    assert clearance_to_points(padded, ORIGIN, points((0, -1.18)))[0] == pytest.approx(1.0)
    assert padded.circumscribed_radius == pytest.approx(math.hypot(0.245, 0.18))
    assert padded.inscribed_radius == pytest.approx(0.18)


@given(coordinate, coordinate, st.floats(-4, 4), coordinate, coordinate)
@settings(max_examples=60, deadline=None)
def test_distance_is_the_same_seen_from_the_body(x, y, yaw, px, py):
    local = points((px, py))
    c, s = math.cos(yaw), math.sin(yaw)
    world = points((x + c * px - s * py, y + s * px + c * py))
    assert rectangle_distance(BARE, np.array([[x, y, yaw]]), world) == pytest.approx(
        rectangle_distance(BARE, ORIGIN, local), abs=1e-9
    )


@given(coordinate, coordinate)
@settings(max_examples=60, deadline=None)
def test_distance_agrees_with_a_dense_outline(px, py):
    t = np.linspace(-1, 1, 401)
    outline = np.concatenate(
        [np.column_stack((t * 0.235, np.full(401, side * 0.17))) for side in (-1, 1)]
        + [np.column_stack((np.full(401, side * 0.235), t * 0.17)) for side in (-1, 1)]
    )
    signed = rectangle_distance(BARE, ORIGIN, points((px, py)))[0, 0]
    assert abs(signed) == pytest.approx(np.hypot(*(outline - (px, py)).T).min(), abs=1e-3)
    assert (signed < 0) == (abs(px) < 0.235 and abs(py) < 0.17)


def test_no_points_are_infinitely_far():
    assert clearance_to_points(BARE, np.zeros((3, 3)), np.empty((0, 2))).tolist() == [math.inf] * 3
    assert first_contact(BARE, np.zeros((3, 3)), np.empty((0, 2))) is None


def test_impossible_footprints_are_refused():
    for bad in ((0, 0.3, 0), (0.4, -1, 0), (0.4, 0.3, -0.1)):
        with pytest.raises(InputError, match="footprint"):
            Footprint(*bad)


def test_covering_discs_cover_the_rectangle():
    footprint = Footprint()
    centres, radius = footprint.covering_discs()
    x, y = np.meshgrid(np.linspace(-0.245, 0.245, 50), np.linspace(-0.18, 0.18, 50))
    nearest = np.min([np.hypot(x - c, y) for c in centres], axis=0)
    assert (nearest <= radius + 1e-12).all()


def straight(length=0.5, count=51):
    return swept_poses((1.0, 0.0, 0.0), np.linspace(0, length, count))


def test_first_contact_of_a_straight_run():
    index = first_contact(BARE, straight(), points((0.435, 0.0)), margin=0.0)
    assert index == 21  # the nose is at 0.435 after 0.20 m; the next pose is inside


@given(st.integers(0, 10**6), st.integers(1, 700), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(0, 0.1))
@settings(max_examples=50)
def test_first_contact_is_what_all_distances_say(seed, count, front, rear, margin):
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-1, 1, (count, 2))
    poses = swept_poses(FourWheelSteering().body_twist(1.0, front, rear), np.linspace(0, rng.uniform(-0.5, 0.5), 20))
    distance = rectangle_distance(BARE, poses, cloud)
    hits = np.flatnonzero(((distance < margin) & (distance < distance[0] - 1e-9)).any(axis=1))
    assert first_contact(BARE, poses, cloud, margin) == (hits[0] if len(hits) else None)


def test_margin_comes_earlier():
    assert first_contact(BARE, straight(), points((0.435, 0.0)), margin=0.05) == 16


def test_points_beside_the_way_do_not_block():
    assert first_contact(BARE, straight(), points((0.3, 0.18)), margin=0.005) is None
    assert first_contact(BARE, straight(), points((0.3, 0.16)), margin=0.005) is not None


def test_a_truck_at_a_wall_may_leave_it_but_not_push_on():
    wall = np.column_stack((np.full(21, 0.236), np.linspace(-0.3, 0.3, 21)))
    assert first_contact(BARE, straight(-0.5), wall, margin=0.03) is None
    assert first_contact(BARE, straight(0.5), wall, margin=0.03) == 1


def sideways(angle, length=0.3, count=61):
    return swept_poses((math.cos(angle), math.sin(angle), 0.0), np.linspace(0, length, count))


@pytest.mark.parametrize("gap", [0.001, 0.005, 0.015])
def test_a_truck_beside_a_wall_may_leave_it_sideways_but_not_drive_along_it(gap):
    wall = np.column_stack((np.linspace(-0.4, 1.0, 141), np.full(141, -0.17 - gap)))
    leaving = 0.1 * np.linspace(0, 0.3, 61)
    assert first_contact(BARE, sideways(0.33), wall, 0.02) is not None
    assert first_contact(BARE, sideways(0.33), wall, 0.02, leaving) is None
    for angle in (0.0, 0.05, -0.33):
        assert first_contact(BARE, sideways(angle), wall, 0.02, leaving) is not None
    ahead = np.vstack((wall, points((0.5, 0.0))))
    assert first_contact(BARE, sideways(0.33), ahead, 0.02, leaving) is not None


def test_what_is_further_than_the_margin_keeps_it_when_leaving_too():
    wall = np.column_stack((np.linspace(-0.4, 1.0, 141), np.full(141, -0.17 - 0.021)))
    leaving = np.zeros(61)
    assert first_contact(BARE, sideways(-0.1), wall, 0.02, leaving) == first_contact(BARE, sideways(-0.1), wall, 0.02)
    assert first_contact(BARE, sideways(-0.1), wall, 0.02) is not None


def test_a_part_of_the_robot_itself_lets_it_pass_nothing_nearer():
    post = points((0.4, -0.17 - 0.014))
    leaving = 0.1 * np.linspace(0, 0.5, 61)
    alone = first_contact(BARE, straight(0.5, 61), post, 0.02, leaving)
    assert alone is not None
    both = np.vstack((post, points((0.1, 0.1))))
    assert first_contact(BARE, straight(0.5, 61), both, 0.02, leaving) == alone


def test_half_of_the_padding_is_kept_when_leaving():
    padded = Footprint(padding=0.01)
    inside = np.column_stack((np.linspace(-0.2, 1.0, 121), np.full(121, -0.18 + 0.004)))
    leaving = 0.1 * np.linspace(0, 0.3, 61)
    assert first_contact(padded, sideways(0.33), inside, 0.02, leaving) is None
    assert first_contact(padded, sideways(0.33), inside + np.array([0.0, 0.004]), 0.02, leaving) is not None


def test_a_turn_sweeps_its_outer_rear_corner():
    steering = FourWheelSteering()
    poses = swept_poses(steering.body_twist(1.0, 0.4, -0.4), np.linspace(0, 0.3, 31))
    beside_the_tail = points((-0.1, -0.18))
    assert first_contact(BARE, poses, beside_the_tail) is not None
    assert first_contact(BARE, straight(0.3, 31), beside_the_tail) is None


def test_swept_poses_follow_the_arc():
    steering = FourWheelSteering()
    poses = swept_poses(steering.body_twist(1.0, 0.3, -0.3), np.array([0.0, 0.5, -0.5]))
    curvature = steering.curvature(0.3, -0.3)
    assert poses[:, 2] == pytest.approx([0, 0.5 * curvature, -0.5 * curvature])
    crab = swept_poses(steering.body_twist(1.0, 0.3, 0.3), np.array([0.5]))
    assert crab[0] == pytest.approx([0.5 * math.cos(0.3), 0.5 * math.sin(0.3), 0])


def scan(ranges, codes):
    return LaserScan(
        stamp=0,
        received=0,
        seq=0,
        frame="lidar",
        start_angle=-math.pi / 2,
        end_angle=math.pi / 2,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.06,
        range_max=4.0,
        ranges=ranges,
        codes=codes,
    )


def test_scan_points_sit_in_base_and_leave_out_bad_beams():
    found = scan_points(scan([1.0, 2.0, math.inf], [255, 255, 255]), (0.14, 0.0, 0.0))
    assert found == pytest.approx(points((0.14, -1.0), (2.14, 0.0)))
    assert len(scan_points(scan([1.0, 2.0, 3.0], [6, 6, 0]), (0.14, 0.0, 0.0))) == 0
    turned = scan_points(scan([1.0, 2.0, 1.0], [0, 255, 0]), (0.0, 0.1, math.pi / 2))
    assert turned == pytest.approx(points((0.0, 2.1)))


def room(origin=(0.0, 0.0, 0.0)):
    cells = np.zeros((60, 80), dtype=bool)  # 4 x 3 m at 0.05
    cells[30, 40] = True
    return DistanceField(cells, 0.05, origin)


def test_field_values_are_distances_to_cell_centres():
    field = room()
    centre = points((2.025, 1.525))
    assert field.lookup(centre)[0] == pytest.approx(0.0)
    assert field.lookup(np.add(centre, (0.5, 0.0)))[0] == pytest.approx(0.5)
    assert field.lookup(np.add(centre, (0.525, 0.0)))[0] == pytest.approx(0.525)  # between two cell centres
    assert field.lookup(points((-1.0, 1.0), (9.0, 1.0)))[0] == 0.0


def test_the_outside_of_a_grid_is_occupied():
    empty = DistanceField(np.zeros((40, 40), dtype=bool), 0.05)
    assert empty.lookup(points((0.525, 1.0)))[0] == pytest.approx(0.55, abs=1e-7)  # the ring's centre lies outside
    poses = np.array([[1.0, 1.0, 0.0], [0.1, 1.0, 0.0], [1.85, 1.0, 0.0]])
    assert empty.free(Footprint(), poses).tolist() == [True, False, False]


def test_free_is_footprint_true():
    field = room()
    beside = [2.025, 1.525 + 0.18 + 0.025 + 0.01, 0.0]  # long side to the cell: footprint_fits with 10 mm to spare
    turned = [*beside[:2], math.pi / 2]  # nose at the cell: does not
    assert field.free(Footprint(), np.array([beside, turned])).tolist() == [True, False]
    assert field.free(Footprint(), np.array([beside]), margin=0.02).tolist() == [False]


@st.composite
def grids(draw):
    cells = np.zeros((30, 40), dtype=bool)  # 2 x 1.5 m
    for _ in range(draw(st.integers(1, 6))):
        cells[draw(st.integers(0, 29)), draw(st.integers(0, 39))] = True
    return cells


def gap(first, second):
    """Widest gap between the shadows of two convex polygons (n, 2); negative where they overlap."""
    edges = np.concatenate((np.roll(first, -1, 0) - first, np.roll(second, -1, 0) - second))
    normals = np.column_stack((-edges[:, 1], edges[:, 0])) / np.hypot(edges[:, 0], edges[:, 1])[:, None]
    a, b = first @ normals.T, second @ normals.T
    return np.maximum(b.min(0) - a.max(0), a.min(0) - b.max(0)).max()


def slow_gap(footprint, pose, cells, margin):
    """The slow truth: every occupied cell as a polygon, and those round the grid."""
    ringed = np.pad(cells, 1, constant_values=True)
    corners = 0.05 * (np.argwhere(ringed)[:, None, ::-1] - 1 + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
    turn = np.array([[math.cos(pose[2]), math.sin(pose[2])], [-math.sin(pose[2]), math.cos(pose[2])]])
    if isinstance(footprint, DiscFootprint):
        centres = np.column_stack((footprint.centres, np.zeros(len(footprint.centres)))) @ turn + pose[:2]
        nearest = np.clip(centres[:, None], corners[None, :, 0], corners[None, :, 2])
        return np.hypot(*np.moveaxis(nearest - centres[:, None], -1, 0)).min() - footprint.radius - margin
    length, width = footprint.half_length + margin, footprint.half_width + margin
    body = np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    body = (body + np.array([footprint.offset, 0])) @ turn + pose[:2]
    return min(gap(body, square) for square in corners)


@pytest.mark.parametrize("footprint", [Footprint(), Footprint(offset=0.16), DiscFootprint((-0.03, 0.11, 0.26), 0.12)])
@given(cells=grids(), x=st.floats(0.1, 1.9), y=st.floats(0.1, 1.4), yaw=st.floats(-3.2, 3.2), margin=st.floats(0, 0.05))
@settings(max_examples=40, deadline=None)
def test_shortcuts_never_change_the_answer(footprint, cells, x, y, yaw, margin):
    distance = slow_gap(footprint, np.array([x, y, yaw]), cells, margin)
    if abs(distance) > 1e-9:
        assert DistanceField(cells, 0.05).free(footprint, np.array([[x, y, yaw]]), margin)[0] == (distance > 0)


def test_footprints_of_discs():
    discs = DiscFootprint((0.0, 0.3), 0.1)
    assert (discs.circumscribed_radius, discs.inscribed_radius) == (0.4, 0.1)
    for centres, radius in (((), 0.1), ((0.0,), 0.0)):
        with pytest.raises(InputError, match="discs"):
            DiscFootprint(centres, radius)


def test_rows_are_checked_all_the_way():
    cells = np.zeros((60, 80), dtype=bool)
    cells[30, 40] = True
    field = DistanceField(cells, 0.05)
    data, body = field.data(), Footprint().data()
    assert segment_free(data, body, 0.0, 0.01, 0.5, 1.0, 0.0, 3.0, 0.0, 0.0)
    assert not segment_free(data, body, 0.0, 0.01, 0.5, 1.5, 0.0, 3.0, 0.0, 0.0)
    assert not segment_free(data, body, 0.0, 0.01, 3.5, 1.5, 0.0, -3.0, 0.0, 0.0)
    assert not segment_free(data, body, 0.0, 0.01, 0.5, 1.0, 0.0, 3.4, 0.0, 0.0)  # leaves the grid
    assert not segment_free(data, body, 0.0, 0.01, 1.0, 1.1, 0.0, 2.0, 0.0, 0.4)
    assert segment_free(data, body, 0.0, 0.01, 1.0, 0.6, 0.0, 1.5, 0.3, 0.0)


def test_a_turned_grid_turns_its_obstacles():
    field = room((1.0, 2.0, math.pi / 2))
    assert field.lookup(points((1.0 - 1.525, 2.0 + 2.025)))[0] == pytest.approx(0.0)
    beside = np.array([[1.0 - 1.525 - 0.18 - 0.035, 2.0 + 2.025, math.pi / 2]])
    assert field.free(Footprint(), beside).tolist() == [True]
    assert field.free(Footprint(), np.add(beside, (0.02, 0, 0))).tolist() == [False]


def test_unknown_cells_block_unless_configured_otherwise():
    cells = np.zeros((40, 40), dtype=np.int8)
    cells[20, 20] = -1
    grid = Grid(
        stamp=0,
        received=0,
        seq=0,
        frame="map",
        resolution=0.05,
        width=40,
        height=40,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0),
        cells=cells.ravel(),
    )
    pose = np.array([[1.0, 1.0, 0.0]])
    assert not DistanceField.from_grid(grid).free(Footprint(), pose)[0]
    assert DistanceField.from_grid(grid, unknown_blocks=False).free(Footprint(), pose)[0]


def test_bad_grids_are_refused():
    for cells, resolution in ((np.zeros((0, 4), bool), 0.05), (np.zeros(4, bool), 0.05), (np.zeros((4, 4), bool), 0.0)):
        with pytest.raises(InputError, match="grid"):
            DistanceField(cells, resolution)


def test_points_near_holds_every_point_within_reach():
    rng = np.random.default_rng(3)
    footprint = Footprint()
    poses = rng.uniform(-1, 1, (6, 3))
    points = rng.uniform(-3, 3, (500, 2))
    near = points_near(points, poses, footprint.circumscribed_radius + 0.2)
    assert 0 < len(near) < len(points)
    every = rectangle_distance(footprint, poses, points).min(axis=0)
    assert {*map(tuple, points[every <= 0.2])} <= {*map(tuple, near)}
