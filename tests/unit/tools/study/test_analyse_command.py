"""`study analyse` on logs of whole, stopped, stalled and cut runs, and of other robots."""

import json
import math

import pytest
from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.sensor import StandPose
from monstertruckd.tools.cli.main import app
from tests.unit.tools.logs.log_kit import Writer

GEOMETRY = {"wheelbase": 0.061, "track": 0.105, "wheel_radius": 0.021, "length": 0.14, "width": 0.13}
PERIOD = SECOND // 10


def write(path, rates, poses, geometry=GEOMETRY):
    """A log: wheel rates asked for and poses seen every 0.1 s."""
    writer = Writer(path, **({} if geometry is None else {"config": {"geometry": geometry}}))
    for seq, (shafts, (x, y, yaw)) in enumerate(zip(rates, poses, strict=True)):
        now = SECOND + seq * PERIOD
        stamps = {"stamp": now, "received": now, "seq": seq}
        if shafts is not None:
            request = DriveRequest(
                **stamps, source="study", role=Role.STATION, lease=0.25, nonce="n", speed=0.0, front=0.0, shafts=shafts
            )
            writer.put(t.REQ_DRIVE, request)
        pose = Pose2D(x=x, y=y, yaw=yaw)
        seen = StandPose(
            **stamps, frame="stand", pose=pose, observer="simulator", position_sigma=0.001, heading_sigma=0.01
        )
        writer.put(t.STAND_POSE, seen)
    writer.log.finish()
    return path


def circling(count, radius=0.2, rate=0.1):
    angles = [rate * 0.1 * i for i in range(count)]
    return [(radius * math.sin(a), -radius * math.cos(a), a) for a in angles]


def passes(count, each=80, speed=0.03):
    """To and fro, a pause before each."""
    rates, poses, x = [], [], 0.0
    for number in range(count):
        sign = -1.0 if number % 2 else 1.0
        rates += [(0.0, 0.0)] * 5 + [(sign * 1.5, sign * 1.5)] * each
        poses += [(x, 0.0, 0.0)] * 5
        poses += [(x := x + sign * speed * 0.1, 0.0, 0.0) for _ in range(each)]
    return rates, poses


def analyse(*arguments):
    return CliRunner().invoke(app, ["study", "analyse", "--json", *map(str, arguments)])


def test_a_run_that_was_stopped_at_once_is_named_and_does_not_hide_the_others(tmp_path):
    count = 300
    rates = [(0.75, 1.5)] * 20 + [None] * 40 + [(0.75, 1.5)] * count
    log = write(tmp_path / "run.mcap", rates, [(0.0, -0.2, 0.0)] * 60 + circling(count))
    result = analyse(log)
    assert result.exit_code == 0
    (circle,) = json.loads(result.stdout)["circles"]
    assert circle["radius"] == pytest.approx(0.2, rel=1e-3)
    assert "skipped: 2:1, 1.50 rad/s: 0 poses" in result.stderr


def test_runs_of_which_none_says_anything_are_one_line(tmp_path):
    rates, _ = passes(2)
    result = analyse(write(tmp_path / "run.mcap", rates, [(0.0, 0.0, 0.0)] * len(rates)))
    assert result.exit_code == 3
    assert result.stderr.strip() == "line, 1.50 rad/s: pass 1 covers 0.0 mm: expected at least 10"


@pytest.mark.parametrize("rates", [(1.5, 0.0), (-1.0, 1.0)])
def test_the_right_side_locked_and_turns_on_the_spot_have_figures_too(tmp_path, rates):
    other = write(tmp_path / "a.mcap", [(0.75, 1.5)] * 300, circling(300))
    result = analyse(other, write(tmp_path / "b.mcap", [rates] * 300, circling(300, radius=0.01)))
    assert result.exit_code == 0, result.stderr
    circle = json.loads(result.stdout)["circles"][1]
    assert circle["radius"] == pytest.approx(0.01, rel=1e-3)
    assert (circle["radius_deviation"] is None) is (sum(rates) == 0.0)
    assert CliRunner().invoke(app, ["study", "analyse", str(tmp_path / "b.mcap")]).exit_code == 0


def test_a_cut_log_is_used_and_ends_with_its_own_exit_code(tmp_path):
    log = write(tmp_path / "run.mcap", *passes(4))
    log.write_bytes(log.read_bytes()[:-30])
    result = analyse(log)
    assert (result.exit_code, json.loads(result.stdout)["lines"][0]["passes"]) == (9, 4)
    assert "run.mcap: has a damaged index" in result.stderr


@pytest.mark.parametrize(
    ("geometry", "said"),
    [
        (GEOMETRY | {"track": 0.12}, "b.mcap: is of another robot than "),
        (GEOMETRY | {"hoofs": 4}, "b.mcap: config.json: geometry.hoofs: Extra inputs are not permitted"),
        (None, "b.mcap: config.json is not attached"),
    ],
)
def test_logs_of_another_robot_are_refused(tmp_path, geometry, said):
    log = write(tmp_path / "a.mcap", *passes(2))
    result = analyse(log, write(tmp_path / "b.mcap", *passes(2), geometry=geometry))
    assert result.exit_code == 3
    assert said in result.stderr
