import math

import numpy as np
import pytest

from monstertruck_planners.track.segments import PathProgress, SegmentedPath
from monstertruck_runtime.errors import InputError
from tests.unit.planners.kit import circle, figure_eight, path, straight


def segmented(route, pose=(0.0, 0.0, 0.0)):
    return SegmentedPath(route, pose, 0.8)


def test_an_open_path_goes_on_straight_behind_its_end():
    run = segmented(path(straight(1.0))).runs[0]
    assert run.length == pytest.approx(1.0)
    assert run.at(0.525).point == pytest.approx((0.525, 0.0))
    assert run.at(1.5).point == pytest.approx((1.5, 0.0))
    assert run.at(99.0).tangent == 0.0


def test_projection_looks_only_where_it_is_reported():
    run = segmented(path(straight(2.0))).runs[0]
    assert run.project(0.73, 0.2, 0.0, 2.0).s == pytest.approx(0.73)
    assert run.project(0.73, 0.2, 1.0, 2.0).s == pytest.approx(1.0)
    assert run.project(0.73, 0.2, 0.0, 0.4).s == pytest.approx(0.4)
    assert run.project(5.0, 0.0, 2.0, 2.0).s == pytest.approx(2.0)


@pytest.mark.parametrize("low", [0.0, 0.31, 1.7])
def test_few_and_many_steps_are_searched_alike(low, monkeypatch):
    run = segmented(path(figure_eight(count=80))).runs[0]
    found = {}
    for many in (10**6, 0):
        monkeypatch.setattr("monstertruck_planners.track.segments.MANY", many)
        points = np.random.default_rng(1).uniform(-1.5, 1.5, (200, 2)).tolist()
        found[many] = [run.project(x, y, low, low + 2.0) for x, y in points]
    assert found[0] == found[10**6]
    assert len({one.s for one in found[0]}) > 20


def test_a_lap_begins_at_the_truck_and_goes_on_where_it_began():
    lap = segmented(path(circle(), closed=True), pose=(1.0, 1.0, math.pi / 2))
    assert lap.length == pytest.approx(math.tau, abs=0.02)
    assert lap.start == PathProgress(0, 0.0)
    run = lap.runs[0]
    assert run.at(0.0).point == pytest.approx((1.0, 1.0), abs=0.05)
    assert run.at(run.length).point == pytest.approx(run.at(0.0).point)
    assert run.at(run.length + 0.4).point == pytest.approx(run.at(0.4).point)


def test_a_lap_that_repeats_its_first_pose_is_the_same():
    points = circle()
    repeated = np.concatenate((points, points[:1]))
    assert segmented(path(repeated, closed=True)).length == pytest.approx(segmented(path(points, closed=True)).length)


def test_an_open_path_is_joined_where_the_truck_stands():
    joined = segmented(path(straight(2.0)), pose=(1.21, 0.03, 0.0))
    assert joined.along(joined.start) == pytest.approx(1.2)


def test_there_and_back_begins_at_the_beginning():
    out = straight(1.0)
    joined = segmented(path(np.concatenate((out, out[::-1][1:])), [1] * 21 + [-1] * 20))
    assert joined.along(joined.start) == 0.0
    assert [run.direction for run in joined.runs] == [1.0, -1.0]
    assert joined.length == pytest.approx(2.0)


def test_at_a_crossing_the_branch_with_the_trucks_heading_counts():
    points = figure_eight()
    for heading in (math.pi / 4, -math.pi / 4 + math.pi):
        lap = segmented(path(points, closed=True), pose=(0.0, 0.0, heading))
        assert lap.runs[0].at(0.1).tangent == pytest.approx(heading, abs=0.3)


def test_joining_in_a_later_run():
    out = straight(1.0)
    back = out[::-1][1:] - (0.0, 0.0)
    sideways = back + np.column_stack((np.zeros(20), np.linspace(0, -0.5, 20)))
    joined = segmented(path(np.concatenate((out, sideways)), [1] * 21 + [-1] * 20), pose=(0.1, -0.45, -0.3))
    assert joined.start.run == 1
    assert joined.along(joined.start) > 1.5


def test_poses_ahead_look_where_the_truck_looks():
    out = straight(1.0)
    forward, backward = segmented(path(out)), segmented(path(out, [-1] * 21), pose=(0, 0, math.pi))
    assert forward.ahead(PathProgress(0, 0.2), 0.4, 3) == pytest.approx(
        np.array([[0.2, 0, 0], [0.4, 0, 0], [0.6, 0, 0]])
    )
    assert backward.ahead(PathProgress(0, 0.2), 0.4, 2)[:, 2] == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("bad", "hint"),
    [
        (path([[0.0, 0.0]]), "expected 2 to 5000 rows"),
        (path([[1.0, 1.0], [1.0, 1.0]]), "expected different poses"),
        (path([[0.0, 0.0], [1.0, 0.0]], [1, 1, 1]), "for each of the 2"),
        (path([[0.0, 0.0], [1.0, 0.0]], [1, 0.5]), r"\+1 or -1"),
        (path([[0.0, 0.0], [math.inf, 0.0]]), "finite"),
    ],
)
def test_impossible_paths_are_refused(bad, hint):
    with pytest.raises(InputError, match=hint):
        segmented(bad)


def test_steps_of_micrometres_that_lead_back_make_no_step_of_length_0():
    there_and_back = [(0.0, 0.0), (0.9e-6, 0.0), (1.8e-6, 0.0), (0.0, 0.0)]
    run = segmented(path([*there_and_back, (1.0, 0.0)])).runs[0]
    assert run.length == pytest.approx(1.0)
    assert run.at(0.0).point == (0.0, 0.0)
    with pytest.raises(InputError, match="one position"):
        segmented(path(there_and_back))
