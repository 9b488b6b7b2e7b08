"""Path files of others: racelines, centrelines, waypoints; in, out, and what is refused."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.path_files import mission_from, path_from, path_text
from monstertruck_runtime.path_forms import PathForm
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.kit import Follower, circle, path, straight

RACELINE = """\
# 26815e17-1d5c-4ef3-9420-b0fa03b8fae9
# 603fd3987364b09f9aacb70d1ed12c268e24dd56
# s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2
0.0; 0.0; 0.0; -1.5707963; 0.0; 0.5; -0.1
1.0; 1.0; 0.0; -1.5707963; 0.0; 0.4; 0.0
2.0; 2.0; 0.0; -1.5707963; 0.0; 0.3; 0.0
"""
PANEL = """\
waypoints:
  waypoint0:
    pose: [0.0, 0.0, 0.0]
    orientation: [1.0, 0.0, 0.0, 0.0]
  waypoint1:
    pose: [1.0, 1.0, 0.0]
    orientation: [0.7071068, 0.0, 0.0, 0.7071068]
"""
ECHOED = """\
header: {stamp: {sec: 1, nanosec: 0}, frame_id: map}
poses:
- header: {frame_id: map}
  pose: {position: {x: 1.0, y: 2.0, z: 0.0}, orientation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}}
- header: {frame_id: map}
  pose: {position: {x: 0.0, y: 2.0, z: 0.0}, orientation: {x: 0.0, y: 0.0, z: 1.0, w: 0.0}}
---
"""


def read(text: str, name: str = "lap.csv", **options: object) -> Path:
    return path_from(text, FilePath(name), **({"closed": False} | options))  # type: ignore[arg-type]


def poses(found: Path) -> np.ndarray:
    return found.poses.reshape(-1, 3)


def test_a_raceline_is_driven_along_its_points_with_its_speeds():
    found = read(RACELINE)
    assert poses(found).tolist() == [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    assert found.speeds.tolist() == [0.5, 0.4, 0.3]
    assert found.name == "lap"


def test_a_trajectory_for_a_local_planner_is_its_shifted_reference():
    found = read("# x_ref_m; y_ref_m; x_normvec_m; y_normvec_m; alpha_m; vx_racetraj_mps\n0;0;0;-1;.5;2\n1;0;0;-1;.5;2")
    assert poses(found).tolist() == [[0, -0.5, 0], [1, -0.5, 0]]
    assert found.speeds.tolist() == [2, 2]


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("# x_m, y_m, w_tr_right_m, w_tr_left_m\n0.0, 0.0, 1.1, 1.1\n1.0, 0.0, 1.1, 1.1\n", ()),
        ("x,y\n0,0\n1,0\n", ()),
        ("0,0\n1,0\n", ()),
        ("0,0,3.0,9\n1,0,3.0,9\n", ("x", "y", "yaw", "gear")),
        ("a;b\n0;0\n1;0\n", ("x", "y")),
    ],
)
def test_columns_are_named_by_a_header_a_comment_or_the_caller(text: str, columns: tuple[str, ...]):
    found = read(text, columns=columns)
    assert poses(found).tolist() == [[0, 0, 0], [1, 0, 0]]
    assert not len(found.speeds)


def test_our_own_table_may_have_speeds():
    found = read("x,y,yaw,direction,speed\n0,0,1,1,.2\n1,0,1,-1,.1\n")
    assert poses(found).tolist() == [[0, 0, 1], [1, 0, 1]]
    assert (found.directions.tolist(), found.speeds.tolist()) == ([1, -1], [0.2, 0.1])
    swapped = read("direction,x,y,yaw\n1,0,0,1\n-1,1,0,1\n")
    assert (poses(swapped).tolist(), swapped.directions.tolist()) == ([[0, 0, 1], [1, 0, 1]], [1, -1])


@pytest.mark.parametrize(
    "head", ["# x y v", "# x [m] y [ m ] v (m/s)", "# saved by numpy\n# x y v\n# one lap of the hall"]
)
def test_a_table_of_numpy_is_read(head):
    found = poses(read(f"{head}\n0.00e+00 0.00e+00 1.00e+00\n1.00e+00 0.00e+00 5.00e-01\n"))
    assert found.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_a_comment_with_units_names_the_columns_in_its_order():
    assert poses(read("# y [m] x [m]\n0 1\n0 2\n")).tolist() == [[1, 0, 0], [2, 0, 0]]


def test_waypoints_may_be_json():
    found = poses(read('{"waypoints": [{"x": 0, "y": 0, "yaw": 0}, {"x": 1, "y": 0, "yaw": 0}]}', "way.json"))
    assert found[-1].tolist() == pytest.approx([1, 0, 0])


def test_waypoints_of_nav2_become_a_curve_through_their_headings():
    found = poses(read(PANEL, "way.yaml"))
    assert found[0].tolist() == [0, 0, 0]
    assert found[-1].tolist() == pytest.approx([1, 1, math.pi / 2], abs=0.05)
    assert np.hypot(*np.diff(found[:, :2], axis=0).T).max() < 0.08
    listed = (
        "waypoints:\n- {x: 0, y: 0, yaw: 0}\n- position: {x: 1, y: 1}\n  orientation: {z: 0.7071068, w: 0.7071068}\n"
    )
    assert poses(read(listed, "way.yml")) == pytest.approx(found, abs=1e-6)
    lap = poses(read(PANEL, "way.yaml", closed=True))
    assert np.hypot(*(lap[-1] - lap[0])[:2]) < 0.08


def test_a_path_of_ros_is_taken_as_it_is():
    assert poses(read(ECHOED, "plan.yaml")) == pytest.approx(np.array([[1, 2, math.pi], [0, 2, math.pi]]))


@pytest.mark.parametrize(
    ("name", "text", "refusal"),
    [
        ("p.csv", "0,0,1,2\n1,0,1,2\n", r"p\.csv:1: expected columns .* by --columns; found column 1"),
        ("p.csv", "x,y\n0,0\n1,nan\n", r"p\.csv:3: expected 2 finite numbers \(x,y\), found 1,nan"),
        ("p.csv", "x,y\n", r"p\.csv: expected at least two poses, found 0"),
        ("p.csv", "x,y,v\n0,0,-1\n1,0,2\n", r"p\.csv:2: expected a speed of zero or more, found 0,0,-1"),
        ("p.csv", "x,y,yaw,direction\n0,0,0,1\n1,0,0,2\n", r"p\.csv:3: expected a direction of 1 or -1"),
        ("p.yaml", "steps: []\n", r"p\.yaml: expected a mapping with waypoints"),
        ("p.yaml", "waypoints: [{latitude: 1, longitude: 2}]\n", r"waypoints 0: has a latitude"),
        ("p.yaml", "waypoints: [{x: 1, y: 2}]\n", r"waypoints 0: expected a yaw \(rad\) or an orientation"),
        ("p.yaml", "waypoints: [{x: 1, y: 2, yaw: 90}]\n", r"waypoints 0: yaw 90: expected radians from -2 pi to 2 pi"),
        ("p.yaml", "waypoints: [{yaw: 1}]\n", r"waypoints 0: expected x and y"),
        ("p.yaml", "waypoints: [{x: .inf, y: 2, yaw: 1}]\n", r"waypoints 0: expected finite numbers, found inf"),
        ("p.yaml", "waypoints:\n  a: {pose: [0, 0, 0], orientation: [1]}\n", r"waypoints a: expected an orientation"),
        ("p.yaml", "frame_id: laser\nwaypoints: [{x: 1, y: 2, yaw: 1}]\n", r"frame 'laser': expected map or odom"),
        ("p.yaml", "waypoints: []\n", r"expected at least one pose under waypoints"),
        ("p.yaml", "waypoints: [{x: 1, y: 2, yaw: 1}]\n", r"expected at least two poses, found 1"),
        ("p.yaml", "waypoints: [{x: 0, y: 0, yaw: 0}, {x: 9000, y: 0, yaw: 0}]\n", r"expected at most 250 m"),
        ("p.yaml", "waypoints: [\n", r"p\.yaml: expected waypoints: not valid YAML"),
    ],
)  # fmt: skip
def test_what_is_no_path_is_refused_by_name(name: str, text: str, refusal: str):
    with pytest.raises(InputError, match=refusal):
        read(text, name)


@pytest.mark.parametrize("form", PathForm)
def test_what_is_written_is_read_again(form: PathForm, tmp_path: FilePath):
    points = circle(2.0)
    route = path(points, closed=True).model_copy(update={"speeds": np.linspace(0.1, 0.3, len(points))})
    file = tmp_path / ("lap.yaml" if form is PathForm.NAV2 else "lap.csv")
    file.write_text(path_text(route, form, width=0.4))
    found = load_path(file, closed=True)
    if form is PathForm.NAV2:
        assert np.hypot(*poses(found).T[:2]).max() <= 4.1
    else:
        assert poses(found)[:, :2] == pytest.approx(points, abs=1e-6)
    if form not in (PathForm.NAV2, PathForm.CENTRELINE):
        assert found.speeds == pytest.approx(route.speeds, abs=1e-6)


def test_the_two_racelines_count_headings_from_their_own_axes():
    route = path(straight(1.0))
    rows = [path_text(route, form, speed=0.2).splitlines()[1].split(";") for form in (PathForm.F1TENTH, PathForm.TUM)]
    assert [float(row[3]) for row in rows] == pytest.approx([0.0, -math.pi / 2])
    bend = path_text(path(circle(2.0), closed=True), PathForm.TUM, speed=0.2).splitlines()[20].split(";")
    assert float(bend[4]) == pytest.approx(0.5, rel=0.01)


def test_a_form_that_cannot_hold_the_path_is_refused():
    with pytest.raises(InputError, match="has no speeds, which a raceline needs"):
        path_text(path(straight(1.0)), PathForm.TUM)
    with pytest.raises(InputError, match="a centreline needs the width"):
        path_text(path(straight(1.0)), PathForm.CENTRELINE)
    with pytest.raises(InputError, match="drives backward, which the form nav2 cannot hold"):
        path_text(path(straight(1.0), -np.ones(21)), PathForm.NAV2)
    with pytest.raises(InputError, match="repeats a point"):
        path_text(path([[0, 0], [0, 0], [1, 0]]), PathForm.TUM, speed=1.0)


@pytest.mark.parametrize("closed", [False, True])
def test_a_tracker_obeys_the_paths_speeds_within_its_own(closed: bool):
    points = circle(1.0) if closed else straight(3.0)
    x = np.linspace(0.0, 1.0, len(points))
    wanted = np.where((x > 0.3) & (x < 0.6), 0.08, 9.0)
    follower = Follower(path(points, closed=closed).model_copy(update={"speeds": wanted}), speed=0.16)
    assert follower.run() is Reason.GOAL_REACHED
    along, speed = follower.along() / follower.path.length, np.array([c.speed for c in follower.log])
    slow = (along > 0.32) & (along < 0.58)
    assert speed[slow].max() <= 0.08 + 1e-9
    assert speed[slow].min() >= 0.07
    assert speed.max() == pytest.approx(0.16)
    assert speed[(along > 0.2) & (along < 0.3)].min() < 0.16, "it brakes before the slow part"


def test_waypoints_are_a_mission_that_drives_to_each():
    mission = mission_from(PANEL, FilePath("Round 2.yaml"))
    assert mission.name == "round_2"
    assert [(step.do, step.x, step.y) for step in mission.steps] == [("goto", 0, 0), ("goto", 1, 1)]  # type: ignore[union-attr]
    assert mission.steps[1].yaw == pytest.approx(math.pi / 2)  # type: ignore[union-attr]
    many = "waypoints:\n" + "- {x: 1, y: 2, yaw: 0}\n" * 501
    with pytest.raises(InputError, match=r"many\.yaml: expected waypoints of a mission: steps: .* at most 500"):
        mission_from(many, FilePath("many.yaml"))
