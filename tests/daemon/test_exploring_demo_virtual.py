"""The demo of a robot that explores: it finds a tag, comes home, and ends in the report of its log."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from monstertruckd.tools.cli.main import app

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(480)]
pytest.importorskip("cv2", reason="tags are drawn and read by OpenCV")

SMALL = """
include: {points}
version: 2
odometry:
  start: {{ x: -0.6, y: 0.0, yaw: 0.0 }}
sim:
  world:
    map: table
    tags: [{{ tag: 0, x: 1.495, y: 0.6, z: 0.25, yaw: 3.1416 }}]
"""
ROOT = Path(__file__).resolve().parents[2]


def test_it_maps_finds_a_tag_and_ends_at_home_with_map_and_report(tmp_path: Path):
    file = tmp_path / "small.yaml"
    file.write_text(SMALL.format(points=ROOT / "configs/points.yaml"))
    run = tmp_path / "run"
    done = CliRunner().invoke(app, ["demo", "--fast", "--json", "--config", str(file), "--output", str(run)])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert figures["outcome"] == "points_found"
    assert figures["found"] == 1
    assert not figures["collided"]
    assert figures["home_error_m"] < 0.2
    assert figures["known"] > 3.0
    files = [Path(name) for name in figures["files"]]
    assert {file.suffix for file in files} == {".png", ".html", ".mcap"}
    assert all(file.is_file() and file.is_relative_to(run) for file in files)
    assert "1 of 1 tags" in done.stderr or "known" in done.stderr, "progress is shown"
