import json

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_runtime.map_files import WorldMap, save_map
from monstertruckd.tools.cli.main import app


@pytest.fixture
def hall(tmp_path):
    cells = np.zeros((80, 120), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:50, 58:62] = 100
    file = tmp_path / "hall.yaml"
    save_map(WorldMap(cells, 0.05, (-1.0, -1.0)), file)
    return file


def run(*arguments):
    return CliRunner().invoke(app, ["plan", *map(str, arguments)])


@pytest.mark.parametrize(
    "options", [(), ("--steering", "2ws", "--planner", "lattice", "--via", "2,2.4,0"), ("--via", "2,2.4")]
)
def test_a_route_in_figures_and_as_a_picture(hall, tmp_path, options):
    picture = tmp_path / "route.png"
    result = run(hall, "-0.3,0,0", "4,0,0", "--reproducible", "--json", "--png", picture, *options)
    assert result.exit_code == 0
    report = json.loads(result.stdout)
    assert report["reason"] == "ok"
    assert report["poses"][0] == pytest.approx([-0.3, 0, 0])
    assert report["poses"][-1] == pytest.approx([4, 0, 0], abs=1e-6)
    assert report["length"] == pytest.approx(sum(segment["length"] for segment in report["segments"]))
    assert report["least_radius"] >= (0.757 if "2ws" in options else 0.378) - 1e-3
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_waypoints_of_a_planner_over_the_grid(hall):
    result = run(hall, "0,0,0", "4,0,0", "--reproducible", "--json", "-p", "grid_astar", "--via", "1,2", "--via", "3,2")
    poses = np.array(json.loads(result.stdout)["poses"])
    assert [poses[0].tolist(), poses[-1].tolist()] == [pytest.approx([0, 0, 0]), pytest.approx([4, 0, 0])]
    for place in ((1, 2), (3, 2)):
        assert np.hypot(*(poses[:, :2] - place).T).min() < 1e-9


def test_words_for_people(hall):
    assert "changes of direction" in run(hall, "0,0,0", "4,0,0", "--reproducible").stdout
    assert "no drivable motion" in run(hall, "0,0,0", "4,0,0", "--reproducible", "--planner", "grid_astar").stdout


@pytest.mark.parametrize(
    ("goal", "reason", "code"),
    [("2,0,0", "goal_blocked", 31), ("9,0,0", "goal_outside", 32), ("nan,0,0", "not_finite", 48)],
)
def test_bad_goals_end_by_reason(hall, goal, reason, code):
    result = run(hall, "0,0,0", goal, "--reproducible", "--json")
    assert (result.exit_code, json.loads(result.stdout)["reason"]) == (code, reason)


def test_nonsense_is_refused(hall):
    for start, options in (
        ("0,0", ()),
        ("a,b,c", ()),
        ("0,0,0", ("--via", "1")),
        ("0,0,0", ("-p", "teleport")),
    ):
        result = run(hall, start, "4,0,0", "--reproducible", *options)
        assert result.exit_code == 3
        assert "expected" in result.stderr
    assert run("no.yaml", "0,0,0", "1,0,0").exit_code == 3
