"""A recorder on the virtual clock, and messages for it."""

from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_schemas import topics as t
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import LaserScan
from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.recorder import Recorder


def steering(now: int, seq: int) -> SteeringCommand:
    return SteeringCommand(stamp=now, received=now, seq=seq, front=seq / 100, rear=0.0, front_servo=0.0, rear_servo=0.0)


def scan(now: int, seq: int) -> LaserScan:
    rng = np.random.default_rng(seq)
    return LaserScan(
        stamp=now,
        received=now,
        seq=seq,
        frame="laser",
        start_angle=-2.0,
        end_angle=2.0,
        time_increment=1e-4,
        scan_time=0.1,
        range_min=0.02,
        range_max=5.6,
        ranges=rng.uniform(0.1, 5.0, 682),
        codes=np.full(682, 255),
    )


async def drive(recorder: Recorder, clock: VirtualClock, seconds: float) -> None:
    """Record 50 Hz steering and 10 Hz scans."""
    for seq in range(round(seconds * 50)):
        now = clock.now()
        recorder.record(t.CMD_STEERING, now, wire.encode(t.CMD_STEERING, steering(now, seq)))
        if seq % 5 == 0:
            recorder.record(t.SCAN, now - SECOND // 20, wire.encode(t.SCAN, scan(now, seq // 5)))
        await clock.sleep(0.02)


class Failures(list):
    """Collects what ``on_failure`` was called with."""

    def __call__(self, reason, text):
        self.append((reason, text))


@pytest.fixture
def failures() -> Failures:
    return Failures()


@pytest.fixture
def config(tmp_path: Path) -> RecorderConfig:
    return RecorderConfig(directory=str(tmp_path / "logs"))
