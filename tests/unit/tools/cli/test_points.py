"""``points list|export``: tables and files; what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_estimation.points.files import save
from monstertruck_runtime.yaml_files import read_yaml
from monstertruck_schemas.points import PointKind, PointOfInterest
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli import points
from monstertruckd.tools.cli.main import app

TAG = PointOfInterest(
    name="tag-7", kind=PointKind.TAG, tag=7, x=3.0, y=1.0, z=0.25, yaw=3.0, size=0.1, sightings=9, first=1, last=5,
    covariance=np.diag((4e-4, 1e-4, 1e-2)).ravel(),
)  # fmt: skip
MARK = TAG.model_copy(update={"name": "dock", "kind": PointKind.MARK, "tag": None, "size": None})


def run(*arguments: str):
    return CliRunner().invoke(app, ["points", *arguments])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save(tmp_path, [(TAG, b""), (MARK, b"")])
    return tmp_path


def test_a_saved_maps_points_are_listed(folder: Path):
    done = run("list", "--map", str(folder))
    assert done.exit_code == 0
    assert "tag-7" in done.output
    assert "2.0" in done.output, "centimetres of the wider axis"
    assert json.loads(run("list", "--map", str(folder), "--json").output)[1]["name"] == "dock"
    assert run("list", "--map", str(folder / "none")).exit_code == Reason.NOT_FOUND.exit_code


def test_they_are_exported_by_the_files_ending(folder: Path):
    for ending in ("csv", "geojson", "yaml"):
        assert run("export", str(folder / f"p.{ending}"), "--map", str(folder)).exit_code == 0
    head, first, *_ = (folder / "p.csv").read_text().splitlines()
    assert dict(zip(head.split(","), first.split(","), strict=True))["sigma_m"] == "0.02"
    features = json.loads((folder / "p.geojson").read_text())["features"]
    assert features[0]["geometry"]["coordinates"] == [3.0, 1.0, 0.25]
    assert read_yaml(folder / "p.yaml")["points"][1]["kind"] == "mark"
    assert run("export", str(folder / "p.txt"), "--map", str(folder)).exit_code == Reason.BAD_INPUT.exit_code


def test_a_robot_stands_before_a_tag_and_on_a_mark():
    before = TAG.before(0.5)
    assert (before.x, before.y) == pytest.approx((3.0 + 0.5 * np.cos(3.0), 1.0 + 0.5 * np.sin(3.0)))
    assert before.yaw == pytest.approx(3.0 - np.pi)
    assert MARK.before(0.5).x == 3.0
    assert run("mark", "dock", "1.0").exit_code == Reason.BAD_INPUT.exit_code


def test_a_mark_says_where_it_is(monkeypatch):
    monkeypatch.setattr(points, "with_robot", lambda *_, **__: {"x": 2.4, "y": 1.0, "yaw": -0.0001})
    done = run("mark", "dock")
    assert done.stderr == "marked dock at x 2.40, y 1.00 m, heading 0.0 degrees\n"


def test_a_cameras_lens_is_converted_to_and_from_the_forms_of_others(tmp_path):
    robot, ros = "configs/points.yaml", tmp_path / "camera.yaml"
    assert CliRunner().invoke(app, ["convert-lens", robot, str(ros), "-f", "ros"]).exit_code == 0
    assert "distortion_model: plumb_bob" in ros.read_text()
    again = CliRunner().invoke(app, ["convert-lens", str(ros)])
    direct = CliRunner().invoke(app, ["convert-lens", robot])
    assert direct.stdout == again.stdout
    assert direct.stdout.startswith("lens:\n  width: 640\n")
    refused = CliRunner().invoke(app, ["convert-lens", str(ros), "--size", "640"])
    assert (refused.exit_code, refused.stderr) == (3, "--size 640: expected WIDTHxHEIGHT, e.g. 640x480\n")
    bare = tmp_path / "bare.yaml"
    bare.write_text("version: 2\nrobot: truck\ndevices: {}\n")
    refused = CliRunner().invoke(app, ["convert-lens", str(bare)])
    assert "has no camera with lens parameters" in refused.stderr
