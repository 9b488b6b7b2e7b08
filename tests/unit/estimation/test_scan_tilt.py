"""Tilt of a scan's plane from compass and joints."""

import math

import numpy as np
import pytest

from monstertruck_estimation.scan_tilt import NO_TILT, AngleHistory, ScanAngles, TiltStamper, plane_tilt
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import Delivery, Mailbox
from monstertruck_schemas.sensor import Attitude, LaserScan, StabiliserFeedback, StabiliserJoint, TorqueState
from monstertruck_schemas.state import Odometry
from tests.unit.estimation.kit import felt_tilt
from tests.unit.planners.behave.wall_kit import odometry

RECENT = Delivery(16, counted=False)
HOLDING = StabiliserJoint(torque=TorqueState.HOLDING)
MS = SECOND // 1000


class Kept:
    def __init__(self) -> None:
        self.scans: list[LaserScan] = []

    def next_seq(self) -> int:
        return len(self.scans)

    def put(self, message: LaserScan) -> None:
        self.scans.append(message)


def scan(stamp: int) -> LaserScan:
    """100 beams of 1 ms: its middle is 50 ms after its stamp."""
    return LaserScan(
        stamp=stamp,
        received=stamp + 100 * MS,
        seq=0,
        start_angle=-1.0,
        end_angle=1.0,
        time_increment=0.001,
        scan_time=0.1,
        range_min=0.02,
        range_max=5.6,
        ranges=np.ones(100),
        codes=np.full(100, 255, np.uint8),
    )


def attitude(stamp: int, pitch: float, roll: float = 0.0, *, valid: bool = True) -> Attitude:
    return Attitude(stamp=stamp, received=stamp, seq=0, heading=0.0, roll=roll, pitch=pitch, tilt_valid=valid)


def joints(stamp: int, pitch: float | None, roll: float | None = 0.0) -> StabiliserFeedback:
    return StabiliserFeedback(
        stamp=stamp, received=stamp, seq=0, pitch=pitch, roll=roll, pitch_joint=HOLDING, roll_joint=HOLDING
    )


def rotation(pitch: float, roll: float) -> np.ndarray:
    cp, sp, cr, sr = math.cos(pitch), math.sin(pitch), math.cos(roll), math.sin(roll)
    return np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


def test_the_tilt_is_that_of_the_composed_rotations():
    rng = np.random.default_rng(1)
    for roll, pitch, a, b in rng.uniform(-0.6, 0.6, (50, 4)):
        up = (rotation(pitch, roll) @ rotation(a, b))[2, 2]
        assert plane_tilt(roll, pitch, a, b) == pytest.approx(math.acos(up))
    assert plane_tilt(0.0, 0.3, -0.3) == pytest.approx(0.0, abs=1e-7)


def test_a_track_goes_straight_between_its_readings_and_a_little_beyond():
    track = AngleHistory()
    assert track.at(0) is None
    track.extend([(0, (0.0, 1.0))])
    assert track.at(100 * MS) == (0.0, 1.0)
    track.extend([(50 * MS, (0.1, 0.9)), (100 * MS, (0.3, 0.8))])
    assert track.at(75 * MS) == pytest.approx((0.2, 0.85))
    assert track.at(125 * MS) == pytest.approx((0.4, 0.75))
    assert track.at(400 * MS) is None


def test_without_a_stabiliser_the_scan_has_the_bodys_tilt_in_its_middle():
    out, compass = Kept(), Mailbox[Attitude](RECENT)
    stamper = TiltStamper(out, ScanAngles(compass, None))
    stamper.put(scan(0))
    compass.put(attitude(100 * MS, pitch=0.1))
    compass.put(attitude(150 * MS, pitch=0.2))
    compass.put(attitude(160 * MS, pitch=9.0, valid=False))
    stamper.put(scan(75 * MS))
    assert out.scans[0].tilt is None
    assert out.scans[1].tilt == pytest.approx(0.15)


def test_acceleration_by_the_odometry_is_no_tilt_of_the_scan():
    out, compass, moved = Kept(), Mailbox[Attitude](RECENT), Mailbox[Odometry](RECENT)
    stamper = TiltStamper(out, ScanAngles(compass, None, moved))
    for i in range(12):
        moved.put(odometry(vx=0.02 * i, now=20 * i * MS))  # 1 m/s^2
    for at in (150, 200):
        compass.put(attitude(at * MS, felt_tilt(1.0, 0.0, 0.0, 0.0).pitch))
    stamper.put(scan(125 * MS))
    assert out.scans[0].tilt == pytest.approx(0.0, abs=0.002)


def test_joints_level_what_the_body_tilts():
    out, compass, feedback = Kept(), Mailbox[Attitude](RECENT), Mailbox[StabiliserFeedback](RECENT)
    stamper = TiltStamper(out, ScanAngles(compass, feedback))
    for at in (0, 50, 100):
        compass.put(attitude(at * MS, pitch=0.002 * at))
        feedback.put(joints(at * MS, pitch=-0.002 * at))
    stamper.put(scan(25 * MS))
    assert out.scans[0].tilt == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("reading", [None, joints(0, None), joints(0, 0.0, None)])
def test_a_mount_that_tells_nothing_makes_the_worst_of_the_scan(reading: StabiliserFeedback | None):
    out, compass, feedback = Kept(), Mailbox[Attitude](RECENT), Mailbox[StabiliserFeedback](RECENT)
    compass.put(attitude(0, pitch=0.0))
    if reading is not None:
        feedback.put(reading)
    TiltStamper(out, ScanAngles(compass, feedback)).put(scan(0))
    assert out.scans[0].tilt == NO_TILT
