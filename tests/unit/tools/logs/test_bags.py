"""Scans out of bags and MCAP files by others: topics, clocks, frames, odometry, and what is refused."""

import gzip
import math
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin

from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics as t
from monstertruckd.tools.logs.ros2 import export_ros2
from monstertruckd.tools.logs.scan_log import LogGeometry, ScanLog
from monstertruckd.tools.logs.scans import read_scans
from tests.unit.recorder.conftest import scan as own_scan
from tests.unit.tools.logs.bag_kit import (
    BEAMS,
    MOUNT,
    RANGES,
    ROLL,
    ROS1,
    ROS2,
    SCANS,
    START,
    RosMessages,
    drive,
    stamp,
    write_foxglove,
    write_json,
    write_ros1,
    write_ros2,
)
from tests.unit.tools.logs.log_kit import Writer, odometry

FOXGLOVE = Path(__file__).resolve().parents[3] / "data" / "foxglove_scans.mcap"


def check(log: ScanLog, *, twist: bool = True) -> None:
    """The drive, with odometry at the scans and the mount of the lidar."""
    assert len(log.scans) == SCANS
    for k, scan in enumerate(log.scans):
        assert scan.stamp / SECOND + log.begin == pytest.approx(stamp(k) / SECOND, abs=1e-6)
        assert scan.odom == pytest.approx((0.1 * k, 0.0, 0.1))
        assert scan.mount == pytest.approx(MOUNT)
        assert scan.ranges == pytest.approx(RANGES, abs=1e-6)
        assert scan.start_angle == pytest.approx(-1.5)
        assert scan.angle_increment == pytest.approx(3.0 / (BEAMS - 1))
        if twist:
            assert scan.twist == pytest.approx((math.cos(0.1), -math.sin(0.1), 0.0), abs=1e-3)
            assert (scan.range_min, scan.range_max) == pytest.approx((0.1, 10.0))
            assert scan.time_increment == pytest.approx(1e-4)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_bag_of_ros_2(tmp_path: Path, storage: StoragePlugin):
    log = read_scans(write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)), storage))
    check(log)
    assert log.assumed == ()
    assert log.sources == {"scans": "/scan", "odometry": "/odom", "mount": "laser in base_link"}


def test_one_file_of_a_bag_of_ros_2(tmp_path: Path):
    for storage in StoragePlugin:
        bag = write_ros2(tmp_path / storage.name, drive(RosMessages(ROS2)), storage)
        (file,) = (one for one in bag.iterdir() if one.name != "metadata.yaml")
        check(read_scans(file))


def test_a_bag_of_ros_1(tmp_path: Path):
    log = read_scans(write_ros1(tmp_path / "drive.bag", drive(RosMessages(ROS1))))
    check(log)
    assert log.make == "bag of ROS 1"


def test_foxglove_scans_with_odometry_by_transforms(tmp_path: Path):
    log = read_scans(write_foxglove(tmp_path / "a.mcap"))
    check(log, twist=False)
    assert log.assumed == ("range_min", "range_max")
    assert log.sources["odometry"] == "transforms of base_link"
    check(read_scans(write_foxglove(tmp_path / "b.mcap", "sensor/scan")), twist=False)


def test_scans_as_json(tmp_path: Path):
    log = read_scans(write_json(tmp_path / "a.mcap"))
    assert len(log.scans) == SCANS
    assert log.scans[0].ranges[:-1] == pytest.approx(RANGES[:-1])
    assert math.isnan(log.scans[0].ranges[-1])
    assert "mount" in log.assumed
    with pytest.raises(InputError, match=r"/other contains thing \(json\): expected foxglove.LaserScan or sensor_msgs"):
        read_scans(tmp_path / "a.mcap", topics=("/other",))


def test_a_file_written_by_foxgloves_own_library():
    log = read_scans(FOXGLOVE)
    assert len(log.scans) == 50
    assert log.make == "mcap by others"


def test_our_own_export_reads_as_the_log_does(tmp_path: Path):
    log = Writer(tmp_path / "own.mcap")
    for k in range(4):
        log.put(t.ODOMETRY, odometry((k + 1) * SECOND, k))
        log.put(t.SCAN, own_scan((k + 1) * SECOND, k))
    log.log.finish()
    export_ros2(tmp_path / "own.mcap", tmp_path / "bag")
    own, bag = read_scans(tmp_path / "own.mcap"), read_scans(tmp_path / "bag")
    assert own.make == "mcap"
    assert bag.sources == {"scans": "/sensor/scan", "odometry": "/state/odometry"}
    for one, other in zip(own.scans, bag.scans, strict=True):
        assert other.ranges == pytest.approx(one.ranges, abs=1e-6)
        assert other.odom == pytest.approx(one.odom)
        assert other.stamp - bag.scans[0].stamp == one.stamp - own.scans[0].stamp


def test_one_of_several_topics_is_chosen(tmp_path: Path):
    ros = RosMessages(ROS2)
    rows = [
        *drive(ros),
        *(("/rear", stamp(k), ros.scan(stamp(k), RANGES + 1.0)) for k in range(2)),
        *(("/odom/slow", stamp(k), ros.odometry(stamp(k), 5.0)) for k in (0, 4)),
        *(("/amcl", stamp(k), ros.odometry(stamp(k), 7.0, "map")) for k in range(-9, 9)),
    ]
    bag = write_ros2(tmp_path / "bag", rows)
    with pytest.raises(InputError, match=r"several topics of scans: /scan \(5\), /rear \(2\): choose one with --topic"):
        read_scans(bag)
    check(read_scans(bag, topics=("/scan",)))
    rear = read_scans(bag, topics=("/rear", "/odom/slow"))
    assert len(rear.scans) == 2
    assert rear.scans[1].odom == pytest.approx((5.0, 0.0, 0.1))
    with pytest.raises(InputError, match=r"no topic /front: it has /amcl, /odom, /odom/slow, /rear, /scan"):
        read_scans(bag, topics=("/front",))


def test_stamps_that_do_not_rise_give_way_to_the_recorders_times(tmp_path: Path):
    ros = RosMessages(ROS2)
    rows = [("/scan", stamp(k), ros.scan(0)) for k in range(SCANS)]
    log = read_scans(write_ros2(tmp_path / "bag", rows))
    assert np.diff([scan.stamp for scan in log.scans]).tolist() == [SECOND // 10] * (SCANS - 1)
    assert log.sources["times"] == "recorder"
    rows = [("/scan", START, ros.scan(0)) for _ in range(SCANS)]
    with pytest.raises(InputError, match=r"/scan: expected increasing times: all 5 scans have the same time"):
        read_scans(write_ros2(tmp_path / "still", rows))


def test_a_lidar_that_hangs_upside_down_sees_the_same(tmp_path: Path):
    upright = read_scans(write_ros2(tmp_path / "upright", drive(RosMessages(ROS2)))).scans[0]
    rows = drive(RosMessages(ROS2), roll=ROLL)
    hanging = read_scans(write_ros2(tmp_path / "hanging", rows)).scans[0]
    points, mirrored = (prepare_input(scan, 30.0).points for scan in (upright, hanging))
    c, s = math.cos(MOUNT[2]), math.sin(MOUNT[2])
    axes = np.array(((c, -s), (s, c)))
    in_lidar, in_hanging = ((values - MOUNT[:2]) @ axes for values in (points, mirrored))
    assert len(points) == len(mirrored) == BEAMS
    assert in_hanging * (1, -1) == pytest.approx(in_lidar, abs=0.05), "but for the motion during the sweep"


def test_a_lidar_that_is_not_level_is_refused(tmp_path: Path):
    rows = drive(RosMessages(ROS2), pitch=0.3)
    with pytest.raises(
        InputError, match=r"/scan: laser is tilted by 17\.2 degrees in base_link: expected at most 5\.7"
    ):
        read_scans(write_ros2(tmp_path / "bag", rows))


def test_what_is_given_overrides_the_bag(tmp_path: Path):
    bag = write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)))
    scan = read_scans(bag, LogGeometry(range_max=4.0, mount=(1.0, 2.0, 0.0))).scans[0]
    assert (scan.range_max, scan.mount) == (4.0, (1.0, 2.0, 0.0))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.bag", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "a git-LFS pointer"),
        ("a.bag", gzip.compress(b"x" * 99, mtime=0), "compressed with gzip: decompress it first"),
        ("a.mcap", b"\x28\xb5\x2f\xfd" + b"x" * 99, "compressed with zstd"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"x" * 99, "expected a bag of ROS 1"),
        ("a.bag", b"#ROSBAG V1.1\n" + b"x" * 99, "expected a bag of ROS 1: ReaderError: Bag version 101"),
        ("a.db3", b"SQLite format 3\0" + b"x" * 99, "expected a bag of ROS 2"),
    ],
)
def test_strangers_are_refused_by_name(tmp_path: Path, name: str, content: bytes, said: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: {said}"):
        read_scans(tmp_path / name)


def test_folders_and_topics_of_logs_that_have_none_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"a folder without metadata\.yaml: expected a ROS 2 bag"):
        read_scans(tmp_path)
    np.savez(tmp_path / "a.npz", t=np.arange(3.0), ranges=np.ones((3, 9)))
    with pytest.raises(InputError, match=r"/scan: a log of this format \(npz\) has no topics"):
        read_scans(tmp_path / "a.npz", topics=("/scan",))
    rows = [row for row in drive(RosMessages(ROS2)) if row[0] != "/scan"]
    with pytest.raises(InputError, match=r"no scans: expected a topic of foxglove.LaserScan or sensor_msgs/LaserScan"):
        read_scans(write_ros2(tmp_path / "bag", rows))


def test_a_log_cut_off_before_its_first_scan_says_so(tmp_path: Path):
    file = write_foxglove(tmp_path / "a.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(InputError, match=r"no scans: expected a topic of .*; it is damaged at byte"):
        read_scans(file)


def test_a_bag_that_was_cut_off_names_the_remedy(tmp_path: Path):
    whole = write_ros1(tmp_path / "a.bag", drive(RosMessages(ROS1))).read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"cut\.bag: expected a bag with an index: .*: `rosbag reindex .*cut\.bag`"):
        read_scans(tmp_path / "cut.bag")


@pytest.mark.parametrize("packing", ["bz2", "lz4"])
def test_a_chunk_of_ros_1_is_bounded_before_it_is_unpacked(tmp_path: Path, packing: str):
    ros, file = RosMessages(ROS1), tmp_path / "a.bag"
    bag = Ros1Writer(file)
    bag.set_compression(Ros1Writer.CompressionFormat[packing.upper()])
    with bag:
        topic = bag.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=ROS1)
        scan = ros.scan(START, np.zeros(40_000_000, np.float32))
        bag.write(topic, START, ROS1.serialize_ros1(scan, "sensor_msgs/msg/LaserScan"))
    assert file.stat().st_size < 2_000_000
    with pytest.raises(InputError, match=r"a\.bag: expected a bag of ROS 1: a compressed chunk is more than 128 MB"):
        read_scans(file)


def test_bags_of_ros_2_that_are_packed_or_describe_too_much_are_refused(tmp_path: Path):
    bag = write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)))
    about = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(about.replace("compression_mode: ''", "compression_mode: MESSAGE"))
    with pytest.raises(InputError, match=r"bag: compressed with message .*decompress it first"):
        read_scans(bag)
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
    bomb += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10))
    (bag / "metadata.yaml").write_text(bomb + about)
    with pytest.raises(InputError, match=r"metadata\.yaml:.*more than 20000 keys and values"):
        read_scans(bag)


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i, 1, i, zeroblob(100) FROM n"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (f"CREATE VIEW messages(id, topic_id, timestamp, data) AS {ENDLESS}", "messages is a view or virtual table"),
        (
            "CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB AS (zeroblob(9e8)))",
            "table messages has computed columns",
        ),
        (
            "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
            "messages is a view or virtual table",
        ),
    ],
)
def test_a_database_that_computes_its_messages_is_refused(tmp_path: Path, change: str, said: str):
    bag = write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)))
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("ALTER TABLE messages RENAME TO others")
        database.execute(change)
    for path in (bag, file):
        with pytest.raises(InputError, match=rf"{file.name}: .*{said}"):
            read_scans(path)


def test_a_database_whose_messages_belong_to_several_topics_is_refused(tmp_path: Path):
    """Each message would be read once per topic with its id: the number of rows grows as the square of the file."""
    bag = write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)))
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("CREATE TABLE repeated AS SELECT * FROM topics UNION ALL SELECT * FROM topics")
        database.execute("DROP TABLE topics")
        database.execute("ALTER TABLE repeated RENAME TO topics")
    with pytest.raises(InputError, match=rf"{file.name}: several topics have the id 1: expected unique ids"):
        read_scans(bag)


def test_a_database_that_uses_its_pages_twice_is_refused(tmp_path: Path):
    """Pages of a tree that share their children multiply rows at each level."""
    ros = RosMessages(ROS2)
    bag = write_ros2(tmp_path / "bag", [*drive(ros), *(("/scan", stamp(k), ros.scan(stamp(k))) for k in range(5, 99))])
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        ((root,),) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
        ((size,),) = database.execute("PRAGMA page_size")
    pages = bytearray(file.read_bytes())
    page = (root - 1) * size
    assert pages[page] == 5, "an interior page of a table"
    first, second = (int.from_bytes(pages[page + 12 + 2 * k : page + 14 + 2 * k]) for k in range(2))
    pages[page + second : page + second + 4] = pages[page + first : page + first + 4]
    file.write_bytes(pages)
    with pytest.raises(InputError, match=r"Rowid \d+ out of order"):
        read_scans(bag)


@contextmanager
def named(file: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        if str(file) not in str(error):
            pytest.fail(f"names no file: {error}")
        raise


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "foxglove"])
def test_damage_is_refused_or_harmless(tmp_path: Path, kind: str):
    """Whatever byte is overwritten: a log, or one of our refusals that names the file."""
    match kind:
        case "ros1":
            file = write_ros1(tmp_path / "a.bag", drive(RosMessages(ROS1)))
        case "sqlite3":
            folder = write_ros2(tmp_path / "bag", drive(RosMessages(ROS2)))
            (file,) = folder.glob("*.db3")
        case _:
            file = write_foxglove(tmp_path / "a.mcap")
    sound = file.read_bytes()
    rng = np.random.default_rng(1)
    for place in rng.integers(16, len(sound), 60).tolist():
        damaged = bytearray(sound)
        damaged[place : place + 2] = rng.bytes(2)
        file.write_bytes(damaged)
        with suppress(InputError), named(file):
            read_scans(file)
