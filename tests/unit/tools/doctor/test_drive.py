"""The doctor's drive of 20 cm: what has a wrong sign is named, and what the gate refuses is said."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from monstertruck_sim.world.config import LidarConfig, WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.steps import MoveRecord
from monstertruckd.tools.doctor.context import Level
from monstertruckd.tools.doctor.drive import Movement, by_lidar, judged, signs

CONFIGS = Path(__file__).resolve().parents[4] / "configs"
TRUCK = load_config(CONFIGS / "truck.yaml", TruckConfig)[0]


def moves(*, compass=1, imu=1, lidar=1, motion=1):
    shares = {"compass": 0.93 * compass, "IMU": 1.03 * imu, "lidar": lidar}
    return [
        Movement(
            s * 0.2, t * s * 0.06, {k: share * s * (t * 0.06 + 0.04) for k, share in shares.items()}, motion * s * 0.2
        )
        for t in (1, -1)
        for s in (1, -1)
    ]


def found(rows):
    return {f.check: f for f in judged(rows, lambda *words: " ".join(words)) if f.level is not Level.OK}


@pytest.mark.parametrize(
    ("how", "check", "said", "fix"),
    [
        (
            {"compass": -1},
            "sign compass",
            "opposite to the steering and the IMU, lidar: it is mounted upside down",
            None,
        ),
        ({"imu": -1}, "sign IMU", "upside down", None),
        ({"lidar": -1}, "sign lidar", "upside down", None),
        ({"motion": -1}, "sign lidar", "the lidar faces backwards", None),
        ({"compass": -1, "imu": -1, "lidar": -1}, "sign steering", "wrong", "calibrate steering --rough"),
        ({"compass": -1, "imu": -1, "lidar": -1, "motion": -1}, "sign motor", "wrong", "calibrate drive --sign-only"),
        ({"imu": 0.0}, "sign IMU", "0% of the turn", None),
        ({"compass": 0, "imu": 0, "lidar": 0}, "sign steering", "direction of one axle", "calibrate steering --rough"),
    ],
)
def test_what_has_a_wrong_sign_is_named_alone(how, check, said, fix):
    ((name, finding),) = found(moves(**how)).items()
    assert name == check
    assert said in finding.seen
    assert finding.fix == fix


def test_what_is_right_is_fine_and_a_drive_that_turned_too_little_tells_nothing():
    assert not found(moves())
    assert {f.check for f in judged(moves(), str)} == {"sign motor", "sign compass", "sign IMU", "sign lidar"}
    assert "too little" in found([Movement(0.2, 0.01, {}, None)])["signs"].seen


def test_the_lidar_tells_way_and_turn_by_itself():
    world = World(WorldConfig(map="yard", lidar=LidarConfig(x=0.14)), 3)
    world.truth(0)
    angle = 2 * math.pi / 1024

    def scans(start):
        rows = []
        for k in range(4):
            stamp = start + k * 100_000_000
            mm = world.lidar.scan(stamp)[44:726]
            rows.append(
                LaserScan(
                    stamp=stamp, received=stamp, seq=k, start_angle=-340 * angle, end_angle=341 * angle, scan_time=0.1,
                    time_increment=1e-4, range_min=0.02, range_max=5.6, ranges=np.where(mm < 20, np.inf, mm / 1000),
                    codes=np.where(mm < 20, 0, VALID_BEAM).astype(np.uint8),
                )
            )  # fmt: skip
        return rows

    before = scans(0)
    began = world.truth(1_000_000_000)
    world.carry(1_000_000_000, (began.x + 0.2, began.y + 0.03, began.yaw + 0.3))
    record = MoveRecord(others={"sensor/scan": before + scans(2_000_000_000)}, left=900_000_000, arrived=1_900_000_000)
    for guess in ((0.2, 0.3), (-0.2, -0.3)):
        moved = by_lidar(record, guess, np.array((0.14, 0.0, 0.0)))
        assert moved == pytest.approx((0.2, 0.03, 0.3), abs=0.03)
    assert by_lidar(MoveRecord(), (0.2, 0.3), np.zeros(3)) is None


def corridor(x, yaw, noise, end=100.0):
    """Four scans at rest between two walls at 1 m to each side."""
    angle = 2 * math.pi / 1024
    angles = np.arange(-340, 342) * angle
    s, c = np.sin(angles + yaw), np.cos(angles + yaw)
    ranges = np.minimum(1 / np.maximum(np.abs(s), 1e-9), np.where(c > 0, (end - x) / np.maximum(c, 1e-9), np.inf))
    scans = []
    for k in range(4):
        seen = np.where(ranges < 5.5, ranges + noise.normal(0, 0.01, ranges.size), np.inf)
        scans.append(
            LaserScan(
                stamp=k, received=k, seq=k, start_angle=-340 * angle, end_angle=341 * angle, scan_time=0.1,
                time_increment=1e-4, range_min=0.02, range_max=5.6, ranges=seen,
                codes=np.where(np.isinf(seen), 0, VALID_BEAM).astype(np.uint8),
            )
        )  # fmt: skip
    return scans


def test_a_corridor_tells_the_turn_and_not_the_way():
    noise = np.random.default_rng(2)
    for end, distance in ((100.0, math.nan), (3.0, 0.2)):
        before, after = corridor(0.0, 0.0, noise, end), corridor(0.2, 0.05, noise, end)
        after = [scan.model_copy(update={"stamp": 100 + scan.stamp}) for scan in after]
        record = MoveRecord(others={"sensor/scan": before + after}, left=50, arrived=90)
        moved = by_lidar(record, (0.2, 0.05), np.zeros(3))
        assert moved[0] == pytest.approx(distance, abs=0.02, nan_ok=True)
        assert moved[2] == pytest.approx(0.05, abs=0.01)
    rows = [replace(move, distance_seen=None) for move in moves()]
    assert not found(rows)
    assert "not determined" in next(f.seen for f in judged(rows, str) if f.check == "sign motor")


async def test_what_the_gate_refuses_is_said_and_other_bodies_are_not_driven():
    async def refused(step):
        assert step.metres == 0.2
        raise RequestRefusedError(Reason.OBSTACLE_STOP)

    (finding,) = await signs(refused, TRUCK, str)
    assert (finding.level, finding.reason) == (Level.FAIL, Reason.OBSTACLE_STOP)
    skid = SimpleNamespace(chassis=lambda: None, body=SimpleNamespace(kind="skid_steer"))
    (finding,) = await signs(refused, skid, str)
    assert finding.reason is Reason.NOT_SUPPORTED
