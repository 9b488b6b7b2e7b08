"""Rerun recordings of logs, read back through rerun, and the cage its viewer runs in."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from typer.testing import CliRunner

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import CommandFailedError, InputError, NotFoundError, NotInstalledError
from monstertruck_runtime.extras import needs_extra
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruck_schemas.state import Ground
from monstertruckd.tools.cli.logs import app
from monstertruckd.tools.logs.messages import Selection
from monstertruckd.tools.logs.rerun_view import TIMELINE, convert, environment, show
from tests.unit.recorder.conftest import scan
from tests.unit.tools.logs.log_kit import MAY_2026, Writer, clock, gate, odometry
from tests.unit.tools.logs.test_export import grid, image, path, transforms


def record(now, seq):
    return LogRecord(stamp=now, received=now, seq=seq, level=LogLevel.WARNING, name="gate", text="late")


def ground(now, seq):
    tilt, rough = np.full(6, 255, np.uint8), np.full(6, 255, np.uint8)
    tilt[1], rough[1] = 40, 30
    corner = Pose2D(x=0.0, y=0.0, yaw=0.0)
    return Ground(
        stamp=now,
        received=now,
        seq=seq,
        frame="map",
        resolution=0.1,
        width=3,
        height=2,
        origin=corner,
        tilt=tilt,
        roughness=rough,
    )


MAKERS = {
    t.SCAN: scan,
    t.ODOMETRY: odometry,
    t.POSE: odometry,
    t.GATE: gate,
    t.TRANSFORMS: transforms,
    t.CAMERA: image,
    t.LOG: record,
}
GOLDEN = sorted((Path(__file__).parents[3] / "data" / "golden").glob("*/run.mcap"))


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file, config={"geometry": {"length": 0.5, "width": 0.3}})
    writer.put(t.CLOCK, clock(SECOND))
    writer.put(t.MAP, grid(SECOND, 0))
    writer.put(t.PATH, path(SECOND, 0))
    writer.put(t.GROUND, ground(SECOND, 0))
    for seq in range(20):
        for topic, make in MAKERS.items():
            writer.put(topic, make(SECOND + seq * SECOND // 10, seq))
    writer.log.finish()
    return file


def read(file):
    """Chunks by entity."""
    found = {}
    for chunk in rr.chunk.RrdReader(file).stream():
        found.setdefault(chunk.entity_path, []).append(chunk)
    return found


def rows(chunks):
    return sum(chunk.num_rows for chunk in chunks if not chunk.is_static)


def test_every_kind_of_message_becomes_an_entity(log, tmp_path):
    found = read(convert(log, tmp_path / "out" / "run.rrd"))
    assert {
        "/scan",
        "/map",
        "/ground",
        "/path",
        "/way",
        "/camera",
        "/frames/base",
        "/truck",
        "/states/gate",
    } <= found.keys()
    assert rows(found["/scan"]) == rows(found["/camera"]) == rows(found["/frames/base"]) == 20
    assert rows(found["/events/journal"]) == 20
    assert rows(found["/states/gate"]) == 1, "only changes of a state"
    assert rows(found["/signals/speed/measured"]) == 20
    assert all(chunk.timeline_names == [TIMELINE] for chunk in found["/scan"])


def test_rough_ground_is_red_and_tilted_ground_blue_where_it_is_known(log, tmp_path):
    (chunk,) = (c for c in read(convert(log, tmp_path / "run.rrd"))["/ground"] if not c.is_static)
    data = chunk.to_record_batch().column("GridMap:data")[0].as_py()
    pixels = np.array(data, np.uint8).reshape(2, 3, 4)[::-1]  # row 0 is the lowest y again
    red, green, blue, alpha = pixels[0, 1].tolist()
    assert red == 255
    assert green == 0
    assert 0 < blue < 255
    assert alpha == 255
    assert pixels[1].max() == 0


def test_values_and_dates_survive(log, tmp_path):
    found = read(convert(log, tmp_path / "run.rrd"))
    (speeds,) = (chunk for chunk in found["/signals/yaw/in_odom"] if not chunk.is_static)
    batch = speeds.to_record_batch()
    times = batch.column(TIMELINE).to_numpy(zero_copy_only=False)
    assert times[0] == np.datetime64(SECOND + MAY_2026, "ns")
    scans = [chunk.to_record_batch() for chunk in found["/scan"] if not chunk.is_static]
    positions = np.array(scans[0].column("Points3D:positions")[0].as_py())
    mine = scan(SECOND, 0)
    assert len(positions) == np.count_nonzero((mine.codes == 255) & np.isfinite(mine.ranges))
    assert np.hypot(*positions[:, :2].T).max() <= mine.range_max + 1e-6


def test_blueprint_is_shipped_and_gives_room_to_what_there_is(log, tmp_path):
    with_camera = rr.chunk.RrdReader(convert(log, tmp_path / "a.rrd"))
    without = rr.chunk.RrdReader(convert(log, tmp_path / "b.rrd", Selection(("state/odometry",))))
    views = [
        sum("/view/" in str(chunk.entity_path) for chunk in reader.stream(store=reader.blueprints()[0]))
        for reader in (with_camera, without)
    ]
    assert views[0] > views[1] > 0


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda file: file.parent.name)
def test_golden_logs_convert(golden, tmp_path):
    found = read(convert(golden, tmp_path / "run.rrd"))
    assert {
        "/scan",
        "/path",
        "/way",
        "/events",
        "/states/gate",
        "/signals/cross-track_error/left_positive",
    } <= found.keys()


def test_a_name_that_is_no_text_is_shown_as_far_as_it_is(log, tmp_path, capfd):
    odd = log.with_name(os.fsdecode(b"dr\xffve\n.mcap"))
    odd.write_bytes(log.read_bytes())
    assert convert(odd, tmp_path / "odd.rrd").stat().st_size > 0
    assert capfd.readouterr().err == ""


def test_errors_name_the_file(log, tmp_path):
    with pytest.raises(NotFoundError, match=r"gone\.mcap: no such log"):
        convert(tmp_path / "gone.mcap", tmp_path / "x.rrd")
    with pytest.raises(InputError, match="cannot be written"):
        convert(log, log / "x.rrd")


def test_viewer_reaches_nobody_and_leaves_the_users_files_alone(tmp_path):
    confined = environment(tmp_path)
    for name in ("HTTPS_PROXY", "https_proxy", "ALL_PROXY"):
        assert confined[name] == "http://127.0.0.1:9"
    command = [sys.executable, "-m", "rerun_cli", "analytics"]
    subprocess.run([*command, "disable"], env=confined, check=True, capture_output=True)
    shown = subprocess.run([*command, "config"], env=confined, check=True, capture_output=True).stdout
    config = json.loads(shown)
    assert config["analytics_enabled"] is False
    assert config["config_file_path"].startswith(str(tmp_path))
    assert confined["PATH"] == os.environ["PATH"]


def test_command_saves_a_recording(log, tmp_path):
    done = CliRunner().invoke(app, ["view", str(log), "--save", str(tmp_path / "x.rrd"), "--end", "0.5"])
    assert done.exit_code == 0, done.output
    assert rows(read(tmp_path / "x.rrd")["/scan"]) == 5


def test_without_a_display_nothing_is_started(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(CommandFailedError, match="needs a display, but none is available; --save"):
        show(tmp_path / "x.rrd")


def test_missing_extra_is_named():
    with (
        pytest.raises(NotInstalledError, match=r"no_such_viewer is not installed; the extra .view. .*bootstrap sync"),
        needs_extra("view"),
    ):
        import no_such_viewer  # noqa: F401
