"""Logs opened in Python: NumPy, pandas, polars and Parquet hold what was recorded."""

import io
import json
import math
import sys
import warnings
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

import monstertruckd
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError, NotInstalledError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel, CompressedImage
from monstertruck_schemas.state import Grid
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.tools.logs import arrow
from monstertruckd.tools.logs.arrow import export_parquet, schema_of
from monstertruckd.tools.logs.messages import Selection
from monstertruckd.tools.logs.pose_files import export_kitti, export_tum
from tests.unit.recorder.conftest import scan
from tests.unit.tools.logs.log_kit import MAY_2026, Writer, clock, odometry

DATA = Path(__file__).resolve().parents[3] / "data"


def jpeg(grey):
    data = io.BytesIO()
    Image.new("RGB", (16, 8), (grey, grey, grey)).save(data, "jpeg")
    return data.getvalue()


@pytest.fixture
def file(tmp_path):
    """Ten scans a tenth of a second apart, odometry 30 ms after each, a battery whose voltage is known at the end."""
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file, config={"robot": "digger"})
    writer.put(t.CLOCK, clock(SECOND))
    for seq in range(10):
        now = SECOND + seq * SECOND // 10
        writer.put(t.SCAN, scan(now, seq))
        writer.put(t.ODOMETRY, odometry(now + 30_000_000, seq))
        voltage = {"voltage": 24.5} if seq == 9 else {}
        head = {"stamp": now, "received": now, "seq": seq}
        writer.put(t.BATTERY, Battery(**head, raw_voltage=24.0, cells=6, level=BatteryLevel.NORMAL, **voltage))
        writer.put(t.CAMERA, CompressedImage(**head, frame="camera", data=jpeg(20 * seq), sequence=seq))
    origin = Pose2D(x=-1.0, y=-2.0, yaw=0.0)
    cells = np.arange(-1, 5, dtype=np.int8)
    writer.put(t.MAP, Grid(**head, frame="map", resolution=0.05, width=3, height=2, origin=origin, cells=cells))
    writer.put(
        t.EVENT,
        Event(**head, reason=Reason.BUSY, severity=Severity.WARNING, source="gate", text="busy", values={"a": 1}),
    )
    writer.log.finish()
    return file


@pytest.fixture
def log(file):
    return monstertruckd.open_log(file)


def test_topics_are_counted_and_found_by_their_last_part(log):
    assert log.topics()["sensor/scan"] == 10
    assert log.config() == {"robot": "digger"}
    assert len(log.numpy("scan")["stamp"]) == len(log.numpy("sensor/scan")["stamp"]) == 10
    with pytest.raises(NotFoundError, match="topic drive: expected one of sensor/drive, plan/drive, cmd/drive"):
        log.numpy("drive")
    with pytest.raises(NotFoundError, match="no topic nose"):
        log.pandas("nose")
    with pytest.raises(NotFoundError, match="state/odometry has no column speed: expected some of log_time"):
        log.pandas("odometry", ["speed"])


def test_arrays_have_a_row_per_message(log):
    columns = log.numpy("scan")
    first = scan(SECOND, 0)
    assert columns["ranges"].shape == (10, len(first.ranges))
    assert np.array_equal(columns["ranges"][0], first.ranges)
    assert columns["time"].tolist() == pytest.approx([0.1 * n for n in range(10)])
    assert columns["log_time"].dtype == np.int64
    assert log.numpy("odometry")["pose.x"].tolist() == pytest.approx([0.1 * n for n in range(10)])
    voltage = log.numpy("battery")["voltage"]
    assert math.isnan(voltage[0])
    assert voltage[-1] == 24.5


def test_tables_of_pandas_and_polars_hold_the_same(log):
    of_pandas, of_polars = log.pandas("odometry"), log.polars("odometry")
    assert of_pandas.index.name == "time"
    assert of_pandas["pose.x"].tolist() == of_polars["pose.x"].to_list()
    assert of_pandas["real_time"].iloc[0].isoformat() == "2026-05-01T01:46:41.030000+00:00"
    assert of_polars.schema["pose_covariance"] == pl.List(pl.Float64)
    assert of_polars["pose_covariance"][0].to_list() == list(range(9))


def test_a_part_of_a_log(log):
    assert len(log.pandas("scan", start=0.2, end=0.5)) == 3
    assert log.pandas("odometry", ["pose.x"]).columns.tolist() == ["pose.x"]
    assert len(log.pandas("imu")) == 0


def test_a_frame_pairs_messages_by_their_stamps(log):
    table = log.frame("scan", "odometry", at="scan")
    assert len(table) == 10
    # the odometry of 30 ms later is nearer than that of 70 ms earlier
    assert table["odometry.seq"].tolist() == list(range(10))
    assert table["scan.ranges"].iloc[3].tolist() == scan(SECOND + 3 * SECOND // 10, 3).ranges.tolist()
    other = log.frame("scan", "odometry", at="odometry", columns=["pose.x", "seq"], library="polars")
    assert other.columns == ["time", "scan.seq", "odometry.seq", "odometry.pose.x"]
    assert other["scan.seq"].to_list() == list(range(10))
    near = log.frame("scan", "odometry", within=0.02)
    assert near["odometry.pose.x"].isna().all()
    assert log.frame("scan", "imu")["imu.stamp"].isna().all()
    one = log.frame("odometry", "map", columns=["resolution", "pose.x"])
    assert one["map.resolution"].tolist() == [0.05] * 10
    with pytest.raises(InputError, match="at 'imu': expected one of the topics of the table"):
        log.frame("scan", at="imu")
    with pytest.raises(InputError, match="expected one of the topics of the table"):
        log.frame()
    with pytest.raises(NotFoundError, match="no column speed in scan"):
        log.frame("scan", columns=["speed"])


@pytest.mark.parametrize("at", ["scan", "odometry", "imu"])
@pytest.mark.parametrize("seconds", [0.15, 0.4, 60.0])
def test_a_frame_in_parts_is_the_whole_one(log, at, seconds):
    topics, columns = ("scan", "odometry", "imu"), ["seq", "pose.x"]
    whole = log.frame(*topics, at=at, columns=columns, library="polars")
    parts = list(log.frames(*topics, at=at, columns=columns, library="polars", seconds=seconds))
    assert (pl.concat(parts) if parts else whole).equals(whole)
    pairs = ("scan", "odometry")
    whole = log.frame(*pairs, within=0.02, library="polars")
    assert pl.concat(log.frames(*pairs, within=0.02, library="polars", seconds=seconds)).equals(whole)


def test_parts_of_a_frame_hold_little_of_the_log(tmp_path):
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file)
    for seq in range(600):
        now = SECOND + seq * SECOND // 10
        writer.put(t.SCAN, scan(now, seq))
        writer.put(t.ODOMETRY, odometry(now + 30_000_000, seq))
    writer.log.finish()
    log = monstertruckd.open_log(file)
    rows, most = 0, 0
    for part in log.frames("scan", "odometry", library="polars", seconds=3.0):
        rows, most = rows + len(part), max(most, len(part))
    assert rows == len(log.frame("scan", "odometry", library="polars")) == 600
    assert most <= 35


def test_pictures_maps_and_events(log):
    times, pictures = zip(*log.images(), strict=True)
    assert times[1] == pytest.approx(0.1)
    assert pictures[0].shape == (8, 16, 3)
    assert abs(int(pictures[5][4, 4, 0]) - 100) < 4
    ((_, grid, cells),) = log.maps()
    assert cells.tolist() == [[-1, 0, 1], [2, 3, 4]]
    assert grid.resolution == 0.05
    events = log.events()
    assert events["reason"].tolist() == ["busy"]
    with pytest.raises(InputError, match="state/odometry has no pictures"):
        next(log.images("state/odometry"))


def test_a_damaged_picture_is_refused(tmp_path):
    file = tmp_path / "run.mcap"
    writer = Writer(file)
    picture = CompressedImage(stamp=1, received=1, seq=0, frame="camera", data=jpeg(9)[:40], sequence=0)
    writer.put(t.CAMERA, picture)
    writer.log.finish()
    with pytest.raises(InputError, match=r"run\.mcap: sensor/camera at 0\.000 s"):
        list(monstertruckd.open_log(file).images())


def test_damage_is_a_warning_and_what_is_whole_is_read(file, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.8)])
    with pytest.warns(UserWarning, match=r"cut\.mcap: .*only the intact part was read"):
        assert len(monstertruckd.open_log(cut).pandas("scan")) > 0
    with pytest.warns(UserWarning, match=r"cut\.mcap: .*only the intact part was read"):
        assert monstertruckd.open_log(cut).topics()
    with warnings.catch_warnings(action="error"):
        monstertruckd.open_log(file).pandas("scan")


def test_a_topic_of_another_program_is_named():
    log = monstertruckd.open_log(DATA / "foxglove_scans.mcap")
    assert log.topics() == {"/scan": 50}
    with pytest.raises(
        NotFoundError, match=r"foxglove_scans\.mcap: /scan contains foxglove\.LaserScan: expected a topic"
    ):
        log.numpy("/scan")


def test_every_topic_has_columns_without_json():
    for name, topic in BY_NAME.items():
        schema = schema_of(name)
        assert {"log_time", "real_time", "stamp"} <= set(schema.names), topic
    assert schema_of("sensor/scan").field("ranges").type == pa.list_(pa.float64())
    assert schema_of("sensor/scan").field("codes").type == pa.list_(pa.uint8())
    assert pa.types.is_struct(schema_of("health/services").field("services").type.value_type)


def test_batches_bound_what_is_held_and_lose_nothing(log, monkeypatch):
    monkeypatch.setattr(arrow, "BATCH_ROWS", 3)
    parts = list(log.batches("scan", ["seq"]))
    assert [len(part) for part in parts] == [3, 3, 3, 1]
    assert pa.Table.from_batches(parts)["seq"].to_pylist() == list(range(10))
    monkeypatch.setattr(arrow, "BATCH_BYTES", 1)
    assert len(list(log.batches("scan"))) == 10


def test_parquet_holds_arrays_as_lists(file, tmp_path, monkeypatch):
    monkeypatch.setattr(arrow, "BATCH_ROWS", 4)
    files = export_parquet(file, tmp_path / "out")
    table = pq.read_table(files["sensor/scan"])
    assert table.schema.field("ranges").type == pa.list_(pa.float64())
    assert table["ranges"][3].as_py() == scan(SECOND + 3 * SECOND // 10, 3).ranges.tolist()
    assert table["real_time"][0].value == SECOND + MAY_2026
    assert pq.read_table(files["sensor/camera"])["data"][2].as_py() == jpeg(40)
    assert json.loads(pq.read_table(files["event/event"])["values"][0].as_py()) == {"a": 1}
    assert pl.read_parquet(files["state/odometry"])["pose.x"].to_list() == pytest.approx([0.1 * n for n in range(10)])


def test_trajectories_have_a_line_per_pose(file, tmp_path):
    files = export_tum(file, tmp_path)
    assert files.keys() == {"state/odometry"}
    rows = np.loadtxt(files["state/odometry"])
    assert rows.shape == (10, 8)
    assert rows[:, 1].tolist() == pytest.approx([0.1 * n for n in range(10)])
    assert rows[0, 0] == pytest.approx(MAY_2026 / SECOND + 1.03, abs=1e-6)
    matrices = np.loadtxt(export_kitti(file, tmp_path)["state/odometry"])
    assert matrices[4].tolist() == pytest.approx([1, 0, 0, 0.4, 0, 1, 0, 0, 0, 0, 1, 0])
    with pytest.raises(InputError, match="sensor/scan has no poses: expected some of state/odometry"):
        export_tum(file, tmp_path, Selection(("sensor/scan",)))


def test_without_its_extra_the_packages_to_install_are_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "monstertruckd.tools.logs.opened", raising=False)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(NotInstalledError, match=r"pyarrow is not installed; the extra 'tables' contains it: "):
        monstertruckd.open_log("run.mcap")
