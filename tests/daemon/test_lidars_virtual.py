"""The simulated truck with lidars of today: the gate lets it drive its path."""

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import GateMode, GateState
from tests.daemon.slam_kit import CONFIGS, driven, lap

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(240)]


@pytest.mark.parametrize(
    ("driver", "beams"),
    [
        ("kind: ld19", 450),
        pytest.param("kind: rplidar, model: c1", 500, marks=pytest.mark.long),
        pytest.param("kind: hokuyo_lx", 1081, marks=pytest.mark.long),
        pytest.param("kind: sheet_lidar, beams: 720, direction: counter_clockwise", 720, marks=pytest.mark.long),
    ],
)
def test_the_truck_drives_its_path_with_a_lidar_of_another_maker(tmp_path, driver, beams):
    config = tmp_path / "truck.yaml"
    config.write_text(f"include: {CONFIGS}/demo.yaml\nversion: 2\ndevices: {{ lidar: {{ driver: {{ {driver} }} }} }}\n")
    drive = driven(str(config), lap(10.0), topics.SCAN, topics.GATE)
    scans: list[LaserScan] = drive.said[topics.SCAN.name]
    gate: list[GateState] = drive.said[topics.GATE.name]
    assert len(scans) > 90
    assert np.median([len(scan.ranges) for scan in scans]) == pytest.approx(beams, rel=0.03)
    varies = len({len(scan.ranges) for scan in scans}) > 1
    assert varies == ("ld19" in driver or "rplidar" in driver), "of a turning head their number varies"
    driving = [state.mode is GateMode.DRIVING for state in gate if 4.0 < state.stamp / SECOND < 12.0]
    assert len(driving) > 40
    assert all(driving), [event.reason for event in drive.events]
    assert drive.off(after=3.0).max() < 0.05
