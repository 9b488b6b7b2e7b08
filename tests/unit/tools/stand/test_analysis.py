"""Estimates against the stand: frames laid over each other, and the latency."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.topics import ODOMETRY, STAND_POSE
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.stand.analysis import error_of, latency_of
from tests.unit.tools.logs.log_kit import Writer, odometry


def test_a_cut_log_is_analysed_as_far_as_it_goes_and_called_so(tmp_path: Path):
    file = tmp_path / "run.mcap"
    writer = Writer(file)
    for seq in range(400):
        now, pose = SECOND + seq * SECOND // 20, Pose2D(x=0.1 * seq, y=0.0, yaw=0.0)
        stamps = {"stamp": now, "received": now, "seq": seq}
        seen = StandPose(**stamps, frame="stand", pose=pose, observer="overhead", position_sigma=0.0, heading_sigma=0.0)
        writer.put(STAND_POSE, seen)
        writer.put(ODOMETRY, odometry(now, seq))
        if seq % 50 == 0:
            writer.log.flush()
    writer.log.finish()

    def analyse() -> tuple[int, str, int]:
        result = CliRunner().invoke(app, ["stand", "analyse", "--json", str(file)])
        return result.exit_code, result.stderr, json.loads(result.stdout)["estimates"][0]["poses"]

    assert analyse() == (0, "", 400)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    code, said, poses = analyse()
    assert (code, 40 < poses < 400) == (Reason.LOG_DAMAGED.exit_code, True)
    assert "the intact part was used" in said


def drive(times):
    yaw = 0.8 * np.sin(0.9 * times)
    x = np.cumsum(0.1 * np.cos(yaw)) * 0.02
    y = np.cumsum(0.1 * np.sin(yaw)) * 0.02
    return np.column_stack((times, x, y, yaw))


TIMES = np.arange(0.0, 20.0, 0.02)


def turned(poses, yaw, x, y):
    c, s = math.cos(yaw), math.sin(yaw)
    return np.column_stack(
        (poses[:, 0], c * poses[:, 1] - s * poses[:, 2] + x, s * poses[:, 1] + c * poses[:, 2] + y, poses[:, 3] + yaw)
    )


def test_another_frame_is_no_error():
    row = error_of("odometry", turned(drive(TIMES), 1.0, 3.0, -2.0), drive(TIMES))
    assert row.position_rms < 1e-3
    assert row.heading_rms < 1e-3


def test_a_drift_is_one():
    seen = turned(drive(TIMES), 0.4, 1.0, 0.0)
    off = drive(TIMES)
    off[:, 1] *= 1.05
    assert error_of("odometry", seen, off).position_end > 0.01


@pytest.mark.parametrize("latency", [-0.05, 0.0, 0.08])
def test_the_latency_is_the_shift_of_time_at_which_turns_agree(latency):
    seen = drive(TIMES)
    seen[:, 0] += latency
    assert latency_of(seen, drive(TIMES)) == pytest.approx(latency, abs=0.003)


def test_a_straight_tells_no_latency_and_too_little_is_refused():
    straight = drive(TIMES)
    straight[:, 3] = 0.0
    assert latency_of(straight, straight) is None
    with pytest.raises(InputError, match="expected 40"):
        error_of("odometry", drive(TIMES)[:10], drive(TIMES))
