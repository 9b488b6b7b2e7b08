"""Scans out of logs of many makes."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruckd.tools.logs.scan_log import LogGeometry
from monstertruckd.tools.logs.scans import read_scans

URG = Path(__file__).resolve().parents[3] / "data" / "urg04lx_exp2.dat.gz"


def test_urg_text():
    log = read_scans(URG)
    assert (log.make, len(log.scans)) == ("urg", 641)
    first = log.scans[0]
    assert first.start_angle + 341 * first.angle_increment == pytest.approx(0.0)
    assert not (first.ranges < 0.02).any()
    assert (log.scans[-1].stamp - first.stamp) / SECOND == pytest.approx(63.2, abs=0.1)


def test_carmen_text(tmp_path: Path):
    file = tmp_path / "a.log"
    file.write_text("# comment\nODOM 0 0 0 0 0 0 0 x 0\nFLASER 3 1.5 81.9 2.5 9 9 9 0.1 0.2 0.3 12.5 host 0.5\n")
    (scan,) = read_scans(file).scans
    assert scan.odom == (0.1, 0.2, 0.3)
    assert scan.start_angle == -math.pi / 2
    assert scan.angle_increment == pytest.approx(math.pi / 2)
    assert (scan.ranges < scan.range_max).tolist() == [True, False, True]


FLASER = "FLASER 3 1.5 81.9 2.5 9 9 9 {x} 0.2 0.3 {time} host {logged}\n"
HEAD = "ROBOTLASER1 0 -1.2 2.4 1.2 20.0 0.01 0 3 1.5 20.0 2.5 2 7 8"
ROBOTLASER = HEAD + " {laser} {x} 0.2 0.0 0.5 0.1 0.2 0.2 0.3 {time} host {logged}\n"


def test_carmens_robotlaser_brings_geometry_and_mount(tmp_path: Path):
    file = tmp_path / "a.log"
    rows = [ROBOTLASER.format(laser=f"{k + 0.3:.3f} 0.2 0.0", x=k, time=9.0 + k, logged=k) for k in range(4)]
    file.write_text("".join(rows))
    log = read_scans(file)
    assert [scan.odom for scan in log.scans] == [(float(k), 0.2, 0.0) for k in range(4)]
    scan = log.scans[0]
    assert scan.mount == pytest.approx((0.3, 0.0, 0.0))
    assert len({one.mount for one in log.scans}) == 1, "or the scans would be of different geometries"
    assert (scan.start_angle, scan.angle_increment, scan.range_max) == (-1.2, 1.2, 20.0)
    assert (scan.ranges < scan.range_max).tolist() == [True, False, True]
    assert log.assumed == ("range_min", "time_increment")
    file.write_text("".join(rows) + FLASER.format(x=1.0, time=9.0, logged=1.0))
    assert len(read_scans(file).scans) == 4
    assert len(read_scans(file, topics=("FLASER",)).scans) == 1
    with pytest.raises(InputError, match="no lines RLASER; lines with scans: ROBOTLASER1, FLASER"):
        read_scans(file, topics=("RLASER",))
    moved = [ROBOTLASER.format(laser=f"{2 * k} 0.2 0.0", x=k, time=9.0 + k, logged=k) for k in range(4)]
    file.write_text("".join(moved))
    assert "mount" in read_scans(file).assumed


def seconds(log) -> list[float]:
    return [(scan.stamp - log.scans[0].stamp) / SECOND for scan in log.scans]


def test_carmen_with_coarse_stamps_takes_the_loggers_times(tmp_path: Path):
    """A time of day printed with ten digits too few is the same in every line."""
    file = tmp_path / "a.log"
    file.write_text("".join(FLASER.format(x=k, time="1.08442e+09", logged=0.25 * k) for k in range(9)))
    log = read_scans(file)
    assert seconds(log) == pytest.approx([0.25 * k for k in range(9)])
    assert log.sources == {"scans": "FLASER", "times": "logger"}
    file.write_text("".join(FLASER.format(x=k, time=f"{0.2 * k:.6f}", logged=int(0.2 * k)) for k in range(9)))
    assert seconds(read_scans(file)) == pytest.approx([0.2 * k for k in range(9)])


def test_scans_of_one_second_are_spread_over_it(tmp_path: Path):
    file = tmp_path / "a.log"
    file.write_text("".join(FLASER.format(x=k, time=5 + k // 4, logged=5 + k // 4) for k in range(10)))
    assert seconds(read_scans(file)) == pytest.approx([0.25 * k for k in range(10)])
    file.write_text("".join(FLASER.format(x=k, time=5, logged=5) for k in range(10)))
    with pytest.raises(InputError, match=r"a\.log: expected increasing times: all 10 scans have the same time"):
        read_scans(file)


def test_single_repeated_stamps_stay(tmp_path: Path):
    file = tmp_path / "a.log"
    times = [0.0, 0.1, 0.25, 0.25, 0.31, 0.9]
    file.write_text("".join(FLASER.format(x=0, time=t, logged=10 * k) for k, t in enumerate(times)))
    assert seconds(read_scans(file)) == pytest.approx(times)


def test_arrays(tmp_path: Path):
    file = tmp_path / "a.npz"
    np.savez(file, t=np.array([5.0, 5.5]), ranges=np.full((2, 180), 50.0, np.float32), odom=np.zeros((2, 3)))
    log = read_scans(file)
    assert log.make == "npz"
    assert log.scans[1].stamp - log.scans[0].stamp == SECOND // 2
    assert math.degrees(log.scans[0].angle_increment) == pytest.approx(1.0)
    assert not (log.scans[0].ranges < log.scans[0].range_max).any()


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.log", b"FLASER 3 1 2\n", "a.log:1: expected FLASER"),
        ("a.log", b"ROBOTLASER1 0 0 0 0 9 0 0 1 5 0 1 1 1 2 2 2 0 0 0 0 0 7 h 7\n", "a.log:1: expected ROBOTLASER1"),
        ("a.log", b"FLASER 1 1 0 0 0 0 0 0 nan host 1\n", "a.log:1: expected FLASER .*: time nan"),
        ("a.log", b"nothing\n", "no scans"),
        ("a.npz", b"PK\x03\x04broken", "expected arrays"),
        ("a.dat", b"1 2 3\n", "expected 707 numbers"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, name: str, content: bytes, said: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_scans(tmp_path / name)


GOOD = {"t": np.arange(3.0), "ranges": np.full((3, 180), 2.0), "odom": np.zeros((3, 3))}


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("t", np.array((0.0, math.nan, 1.0)), "t: expected finite seconds, got nan in row 1"),
        ("t", np.zeros((3, 2)), r"t: expected numbers of shape \(3\), got float64 of shape \(3, 2\)"),
        ("ranges", np.full((3, 180), math.nan), "ranges: expected metres, got no finite value"),
        ("ranges", np.zeros(3), r"ranges: expected numbers of shape \(n, n\)"),
        ("odom", np.zeros((3, 2)), r"odom: expected numbers of shape \(3, 3\), got float64 of shape \(3, 2\)"),
        ("odom", np.zeros((2, 3)), r"odom: expected numbers of shape \(3, 3\)"),
        ("t", np.array(("a", "b", "c")), "t: expected numbers"),
        ("mount", np.zeros(2), "mount: expected numbers of shape"),
        ("angle_increment", np.array(0.0), "angle_increment: expected finite numbers, not 0"),
        ("range_max", np.array(math.nan), "range_max: expected finite numbers, got nan"),
    ],
)
def test_arrays_that_are_wrong_are_named(tmp_path: Path, name: str, value: np.ndarray, said: str):
    file = tmp_path / "a.npz"
    np.savez(file, **GOOD | {name: value})
    with pytest.raises(InputError, match=rf"a\.npz: {said}"):
        read_scans(file)


def test_infinite_ranges_are_no_returns_and_the_others_stay(tmp_path: Path):
    file = tmp_path / "a.npz"
    ranges = np.random.default_rng(1).uniform(0.5, 5.5, (3, 180))
    ranges[:, ::7] = math.inf
    odom = np.zeros((3, 3))
    odom[1] = math.nan
    np.savez(file, t=GOOD["t"], ranges=ranges, odom=odom)
    log = read_scans(file)
    assert [scan.odom is None for scan in log.scans] == [False, True, False]
    for scan, row in zip(log.scans, ranges, strict=True):
        assert ((scan.ranges >= scan.range_min) & (scan.ranges < scan.range_max)).tolist() == np.isfinite(row).tolist()


def test_the_geometry_is_the_callers_or_the_logs_and_what_is_assumed_is_said(tmp_path: Path):
    file = tmp_path / "a.npz"
    np.savez(file, **GOOD, start_angle=np.array(-2.0), angle_increment=np.array(0.02), mount=np.array((0.1, 0.0, 0.5)))
    log = read_scans(file, LogGeometry(range_max=4.0, start_angle=-1.5))
    scan = log.scans[0]
    assert (scan.start_angle, scan.angle_increment, scan.range_max) == (-1.5, 0.02, 4.0)
    assert scan.mount == (0.1, 0.0, 0.5)
    assert log.assumed == ("range_min", "time_increment")
    with pytest.raises(InputError, match=r"range_max: a log of this format \(urg\) contains its geometry"):
        read_scans(URG, LogGeometry(range_max=4.0))
    np.savez(file, **GOOD)
    assert set(read_scans(file).assumed) >= {"start_angle", "angle_increment", "range_max", "mount"}


def test_no_such_file(tmp_path: Path):
    with pytest.raises(NotFoundError):
        read_scans(tmp_path / "none")
