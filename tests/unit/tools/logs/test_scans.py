"""Scans out of logs of many makes."""

import math
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
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
        ("a.log", b"nothing\n", "no scans"),
        ("a.npz", b"PK\x03\x04broken", "expected arrays"),
        ("a.dat", b"1 2 3\n", "expected 707 numbers"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, name: str, content: bytes, said: str):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_scans(tmp_path / name)


def test_no_such_file(tmp_path: Path):
    with pytest.raises(NotFoundError):
        read_scans(tmp_path / "none")
