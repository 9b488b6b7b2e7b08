"""Exports: values, times and selections, read back by the libraries people use."""

import csv
import json
import math
import tempfile
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import LogLevel, LogRecord
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.sensor import Battery, BatteryLevel, CompressedImage
from monstertruck_schemas.state import ClockOffset, Grid, Peer, Peers, Transform, Transforms
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.logs import columns
from monstertruckd.tools.logs.export import export_csv, export_mcap, export_npz, in_unix_time
from monstertruckd.tools.logs.messages import Selection, real_offset, utc
from monstertruckd.tools.logs.ros2 import export_ros2
from tests.unit.recorder.conftest import scan
from tests.unit.tools.logs.log_kit import MAY_2026, Writer, clock, gate, odometry

PLAIN = 64

JPEG = b"\xff\xd8picture\xff\xd9"


def image(now, seq):
    return CompressedImage(stamp=now, received=now, seq=seq, frame="camera", data=JPEG, sequence=seq)


def battery(now, seq):
    known = {"voltage": 24.5, "charge": 0.5, "capacity_ah": 5.0} if seq else {}
    return Battery(stamp=now, received=now, seq=seq, raw_voltage=24.0, cells=6, level=BatteryLevel.NORMAL, **known)


def transforms(now, seq):
    row = Transform(
        parent="odom", child="base", stamp=now - 7, translation=(1.0, 2.0, 0.0), rotation=(0.0, 0.0, 0.6, 0.8)
    )
    return Transforms(stamp=now, received=now, seq=seq, frame="map", transforms=(row,))


def grid(now, seq):
    cells = np.arange(-1, 5, dtype=np.int8)
    origin = Pose2D(x=-1.0, y=-2.0, yaw=0.0)
    return Grid(
        stamp=now, received=now, seq=seq, frame="map", resolution=0.05, width=3, height=2, origin=origin, cells=cells
    )


def path(now, seq):
    poses = np.array([0.0, 0.0, 0.0, 1.0, 0.5, math.pi / 2])
    return TruckPath(stamp=now, received=now, seq=seq, frame="odom", poses=poses, directions=[], name="bend")


def health(now, seq):
    row = ServiceHealth(name="lidar", state=ServiceState.READY, since=now - 3)
    return HealthTable(stamp=now, received=now, seq=seq, services=(row,))


MAKERS = {
    t.SCAN: scan,
    t.ODOMETRY: odometry,
    t.CAMERA: image,
    t.BATTERY: battery,
    t.TRANSFORMS: transforms,
    t.MAP: grid,
    t.PATH: path,
    t.HEALTH: health,
    t.GATE: gate,
}


@pytest.fixture
def log(tmp_path):
    file = tmp_path / "run-000001-000.mcap"
    writer = Writer(file, config={"robot": "digger"})
    writer.put(t.CLOCK, clock(SECOND, offset=0))  # the clock was set after the first messages
    for seq in range(10):
        for topic, make in MAKERS.items():
            writer.put(topic, make(SECOND + seq * SECOND // 10, seq))
    writer.put(t.CLOCK, clock(2 * SECOND, 1))
    writer.log.finish()
    return file


def test_offset_is_what_the_log_last_knew(log, tmp_path):
    assert real_offset(open_log(log)) == MAY_2026
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-30])
    assert real_offset(open_log(cut)) == MAY_2026
    silent = tmp_path / "silent.mcap"
    writer = Writer(silent)
    writer.log.finish()
    assert real_offset(open_log(silent)) == 5
    number = b"real_offset_ns\x01\x00\x00\x00"
    silent.write_bytes(silent.read_bytes().replace(number + b"5", number + b"u"))
    with pytest.raises(InputError, match=r"silent\.mcap: metadata run: real_offset_ns is 'u', expected a whole number"):
        real_offset(open_log(silent))
    assert utc(MAY_2026) == "2026-05-01 01:46:40"


def test_tables_hold_daemon_time_and_real_time(log, tmp_path):
    files = export_csv(log, tmp_path / "csv")
    with files["state/odometry"].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert (rows[1]["log_time"], rows[1]["real_time"]) == ("1100000000", "2026-05-01T01:46:41.100000000Z")
    files = export_npz(log, tmp_path / "npz")
    with np.load(files["state/odometry"], allow_pickle=False) as table:
        assert (table["real_time"] - table["log_time"]).tolist() == [MAY_2026] * 10
        assert table["pose.x"].tolist() == pytest.approx([0.1 * i for i in range(10)])


@pytest.mark.parametrize("export", [export_csv, export_npz])
def test_pictures_become_files(log, tmp_path, export):
    files = export(log, tmp_path / "out")
    pictures = sorted((tmp_path / "out" / "sensor_camera").iterdir())
    assert len(pictures) == 10
    assert pictures[0].read_bytes() == JPEG
    assert f"sensor_camera/{pictures[0].name}".encode() in files["sensor/camera"].read_bytes() or export is export_npz


def test_the_journal_whose_column_is_called_file_has_a_table_too(tmp_path):
    writer = Writer(tmp_path / "run.mcap")
    line = LogRecord(stamp=SECOND, received=SECOND, seq=0, level=LogLevel.INFO, name="gate", text="up", file="gate.py")
    writer.put(t.LOG, line)
    writer.log.finish()
    with np.load(export_npz(tmp_path / "run.mcap", tmp_path / "out")["event/log"], allow_pickle=False) as table:
        assert (table["file"].tolist(), table["stamp"].tolist()) == (["gate.py"], [SECOND])


@pytest.mark.parametrize("export", [export_csv, export_npz])
def test_a_table_that_cannot_get_its_name_leaves_nothing_behind(log, tmp_path, export):
    ending = "csv" if export is export_csv else "npz"
    (tmp_path / f"out/state_gate.{ending}").mkdir(parents=True)
    with pytest.raises(IsADirectoryError, match=rf"state_gate\.{ending}'"):
        export(log, tmp_path / "out", Selection(("state/odometry", "state/gate")))
    assert [path.name for path in (tmp_path / "out").iterdir()] == [f"state_gate.{ending}"]


@pytest.mark.parametrize("export", [export_mcap, export_ros2])
def test_a_part_without_messages_leaves_the_name_free(log, tmp_path, export):
    assert export(log, tmp_path / "out", Selection(start=1000.0)) == {}
    assert export(log, tmp_path / "out", Selection(("state/gate",))).keys() == {"state/gate"}


def test_selection_by_topic_and_time(log, tmp_path):
    seen = []
    chosen = Selection(("state/odometry", "state/gate"), start=0.2, end=0.5)
    files = export_npz(log, tmp_path / "npz", chosen, seen.append)
    assert files.keys() == {"state/odometry", "state/gate"}
    with np.load(files["state/gate"], allow_pickle=False) as table:
        assert table["log_time"].tolist() == [1_200_000_000, 1_300_000_000, 1_400_000_000]


def test_selection_that_cannot_be_is_refused():
    with pytest.raises(NotFoundError, match=r"no topic sensor/nose .did you mean sensor/scan"):
        Selection(("sensor/nose",))
    with pytest.raises(InputError, match="expected an end after the start"):
        Selection(start=3.0, end=3.0)


def read_bag(folder):
    """Every message by topic: (bag time, message)."""
    found = {}
    with AnyReader([folder]) as bag:
        for connection, at, data in bag.messages():
            found.setdefault(connection.topic, []).append((at, bag.deserialize(data, connection.msgtype)))
        durable = {
            c.topic
            for c in bag.connections
            if c.ext.offered_qos_profiles[0].durability is QosDurability.TRANSIENT_LOCAL
        }
    return found, durable


def nanoseconds(stamp):
    return stamp.sec * SECOND + stamp.nanosec


def test_bag_holds_the_values_of_the_log(log, tmp_path):
    export_ros2(log, tmp_path / "bag")
    bag, durable = read_bag(tmp_path / "bag")
    at, ros = bag["/sensor/scan"][3]
    mine = scan(1_300_000_000, 3)
    assert (at, nanoseconds(ros.header.stamp), ros.header.frame_id) == (
        1_300_000_000 + MAY_2026,
        mine.stamp + MAY_2026,
        "laser",
    )
    assert (ros.angle_min, ros.angle_max, ros.range_max) == pytest.approx(
        (mine.start_angle, mine.end_angle, mine.range_max)
    )
    assert ros.angle_increment == pytest.approx(mine.angle_increment)
    assert np.array_equal(ros.ranges, mine.ranges.astype(np.float32))
    _, ros = bag["/state/odometry"][4]
    assert (ros.header.frame_id, ros.child_frame_id) == ("odom", "base")
    assert (ros.pose.pose.position.x, ros.pose.pose.orientation.w, ros.twist.twist.linear.x) == pytest.approx(
        (0.4, 1.0, 1.0)
    )
    covariance = ros.pose.covariance.reshape(6, 6)
    assert covariance[np.ix_((0, 1, 5), (0, 1, 5))].ravel().tolist() == list(range(9))
    assert covariance.sum() == sum(range(9))
    _, ros = bag["/tf"][0]
    (row,) = ros.transforms
    assert (row.header.frame_id, row.child_frame_id, nanoseconds(row.header.stamp)) == (
        "odom",
        "base",
        SECOND - 7 + MAY_2026,
    )
    assert (row.transform.translation.y, row.transform.rotation.z) == (2.0, 0.6)
    _, ros = bag["/state/map"][0]
    assert (ros.info.width, ros.info.height, ros.info.origin.position.y) == (3, 2, -2.0)
    assert ros.data.tolist() == [-1, 0, 1, 2, 3, 4]
    _, ros = bag["/plan/path"][0]
    assert [pose.pose.position.y for pose in ros.poses] == [0.0, 0.5]
    assert ros.poses[1].pose.orientation.z == pytest.approx(math.sqrt(0.5))
    _, ros = bag["/sensor/camera/compressed"][0]
    assert (ros.format, ros.data.tobytes()) == ("jpeg", JPEG)
    assert math.isnan(bag["/sensor/battery"][0][1].voltage)
    assert (bag["/sensor/battery"][1][1].voltage, bag["/sensor/battery"][1][1].percentage) == (24.5, 0.5)
    text = json.loads(bag["/state/gate"][0][1].data)
    assert (text["mode"], text["stamp"], text["real_offset"]) == ("driving", SECOND, MAY_2026)
    assert durable >= {"/state/map", "/plan/path", "/tf"}
    assert "/state/odometry" not in durable


def test_bag_never_overwrites(log, tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(InputError, match="the bag cannot be created"):
        export_ros2(log, tmp_path / "bag")


def test_dated_log_shows_dates_in_stock_readers(log, tmp_path):
    dated = tmp_path / "dated.mcap"
    export_mcap(log, dated)
    with dated.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages(topics=["state/odometry", "state/transforms"]):
            assert message.log_time // SECOND == 1_777_600_001
            first = decoded if channel.topic == "state/odometry" else decoded.transforms[0]
            assert abs(first.timestamp.seconds * SECOND + first.timestamp.nanos - message.log_time) < 10
        assert [a.name for a in reader.iter_attachments()] == ["config.json"]


def test_every_instant_in_a_message_is_dated():
    peer = Peer(robot="digger", pose=Pose2D(x=0.0, y=0.0, yaw=0.0), twist=Twist2D(vx=0.0, vy=0.0, wz=0.0), heard=7)
    dated = in_unix_time(Peers(stamp=9, received=9, seq=0, peers=(peer,)), MAY_2026)
    assert (dated.stamp, dated.received, dated.peers[0].heard) == (MAY_2026 + 9, MAY_2026 + 9, MAY_2026 + 7)
    stepped = ClockOffset(stamp=9, received=9, seq=0, offset=MAY_2026 + 5, stepped=3)
    assert (in_unix_time(stepped, MAY_2026).offset, in_unix_time(stepped, MAY_2026).stepped) == (5, 3)


def test_dated_log_is_a_log_like_any_other(log, tmp_path):
    dated = tmp_path / "dated.mcap"
    export_mcap(log, dated)
    before, after = list(open_log(log)), list(open_log(dated))
    assert [(m.topic, m.log_time + MAY_2026, m.sequence) for m in before] == [
        (m.topic, m.log_time, m.sequence) for m in after
    ]
    assert real_offset(open_log(dated)) == 0
    (row,) = next(m.decode() for m in after if m.topic == "health/services").services
    assert row.since == SECOND - 3 + MAY_2026
    with pytest.raises(InputError, match=r"dated\.mcap: already exists"):
        export_mcap(log, dated)


def columns_of(values: list[Any], folder: Path) -> dict[str, Any]:
    with tempfile.TemporaryFile() as file, zipfile.ZipFile(folder / "table.npz", "w") as archive:
        column = columns.Spool(file).column(lambda value: "" if value is None else str(value))
        for value in values:
            column.add(value)
        column.write(archive, "file")
    with np.load(folder / "table.npz", allow_pickle=False) as table:
        return dict(table)


@pytest.mark.parametrize(
    ("values", "dtype"),
    [
        ([True, False] * 50, "bool"),
        ([True] * 90 + [7] * 10, "int64"),
        ([2**62] * 90 + [0.5], "float64"),
        ([None] * 50 + [3] * 50, "float64"),
        ([1.5] * 90 + ["much later a text"], "<U17"),
        ([None] * 50 + ["a"], "<U1"),
    ],
)
def test_a_column_has_the_type_of_all_its_values_however_late_they_come(values, dtype, tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "KEPT_BYTES", 10 * PLAIN)
    found = columns_of(values, tmp_path)["file"]
    assert found.dtype == dtype
    if dtype.startswith("<U"):
        assert found.tolist() == ["" if value is None else str(value) for value in values]
    else:
        np.testing.assert_array_equal(found, np.array([np.nan if v is None else v for v in values], dtype))


def test_numbers_that_no_array_holds_are_refused(tmp_path):
    with pytest.raises(InputError, match="at most 64 bits"):
        columns_of([2**70, 1], tmp_path)


def test_arrays_of_equal_and_of_different_lengths(tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "KEPT_BYTES", 1000)
    same = [np.full((3, 2), i, np.uint8 if i else np.int16) for i in range(30)]
    found = columns_of(same, tmp_path)
    assert found.keys() == {"file"}
    assert found["file"].dtype == np.int16
    np.testing.assert_array_equal(found["file"], np.stack(same))
    different = [np.arange(i % 4, dtype=float) for i in range(30)]
    found = columns_of(different, tmp_path)
    np.testing.assert_array_equal(found["file"], np.concatenate(different))
    assert found["file.lengths"].tolist() == [i % 4 for i in range(30)]


def test_a_table_of_any_length_takes_little_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "KEPT_BYTES", 400_000)
    tracemalloc.start()
    try:
        with tempfile.TemporaryFile() as file, zipfile.ZipFile(tmp_path / "table.npz", "w") as archive:
            spool = columns.Spool(file)
            arrays, texts = spool.column(str), spool.column(str)
            for number in range(800):
                arrays.add(np.full(1000, float(number)))
                texts.add("x" * 1000)
            arrays.write(archive, "arrays")
            texts.write(archive, "texts")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 4_000_000, "the values are 7 MB, as array of text 10 MB"
    with np.load(tmp_path / "table.npz", allow_pickle=False) as table:
        assert table["arrays"][799, 999] == 799.0
        assert table["texts"].shape == (800,)
