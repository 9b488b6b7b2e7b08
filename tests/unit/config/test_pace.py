"""Settings that do not keep up with the robot's speed are refused by name."""

from pathlib import Path

import pytest

from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.odometry import OdometryConfig
from monstertruck_estimation.slam.config import MapperConfig, SlamConfig
from monstertruck_planners.goals.config import LocalConfig, PlannerConfig, WindowConfig
from monstertruck_planners.local.config import RsbandConfig
from monstertruck_planners.track.config import LqrConfig
from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.load import load_config
from monstertruckd.config.pace import distance_to_stop, too_slow
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

ROBOTS = Path(__file__).resolve().parents[3] / "configs" / "robots"
TRACKER = LqrConfig(kind="lqr", speed=1.0, deceleration=0.5)


@pytest.mark.parametrize("odometry", [OdometryConfig(max_speed=1.25), FusionConfig(kind="fusion", max_speed=1.25)])
def test_the_odometry_believes_the_speed_of_the_robot(odometry):
    assert list(too_slow(1.0, odometry, None, None, None, consistent=True)) == []
    (text,) = too_slow(1.01, odometry, None, None, None, consistent=True)
    assert text == "odometry.max_speed 1.25 m/s: expected at least 1.2625, 1.25 times gate.speed"


def test_the_mapping_believes_it_too():
    slam = SlamConfig(mapper=MapperConfig(fastest=(2.0, 1.0)))
    believes = OdometryConfig(max_speed=10.0)
    assert list(too_slow(1.6, believes, None, None, slam, consistent=True)) == []
    (text,) = too_slow(1.7, believes, None, None, slam, consistent=True)
    assert text.startswith("slam.mapper.fastest 2 m/s")


def test_the_tracker_stops_within_what_the_planner_looks_at():
    planner = PlannerConfig(blocked_scans=3, rate=10.0, look_ahead=1.3)
    assert distance_to_stop(1.0, planner, TRACKER) == pytest.approx(0.3 + 1.0)
    believes = OdometryConfig(max_speed=10.0)
    assert list(too_slow(1.0, believes, TRACKER, planner, None, consistent=True)) == []
    (text,) = too_slow(1.0, believes, TRACKER, planner.model_copy(update={"look_ahead": 1.2}), None, consistent=True)
    assert text.startswith("planner.look_ahead 1.2 m: expected at least 1.30: the tracker stops within 1.30 m")
    slow = too_slow(0.5, believes, TRACKER, planner.model_copy(update={"look_ahead": 0.5}), None, consistent=True)
    assert list(slow) == [], "the gate limits the tracker"


def test_a_local_planner_sees_as_far_in_its_window():
    narrow = LocalConfig(window=WindowConfig(size=2.5))
    planner = PlannerConfig(look_ahead=2.0, local_planner=RsbandConfig(), local=narrow)
    (text,) = too_slow(1.0, OdometryConfig(max_speed=10.0), TRACKER, planner, None, consistent=True)
    assert text.startswith("planner.local.window.size 2.5 m: expected at least 2.60")


def test_a_configuration_so_written_is_refused(tmp_path):
    file = tmp_path / "fast.yaml"
    file.write_text(f"include: {ROBOTS}/turtle.yaml\nversion: 2\nodometry: {{ max_speed: 0.6 }}\n")
    with pytest.raises(ConfigError, match=r"odometry.max_speed 0.6 m/s: expected at least 1, 1.25 times gate.speed"):
        load_config(file, SimulatedTruckConfig)


def test_the_comparison_of_sensors_ends_at_its_speed():
    believes = OdometryConfig(max_speed=10.0)
    assert list(too_slow(4.0, believes, None, None, None, consistent=True)) == []
    (text,) = too_slow(4.1, believes, None, None, None, consistent=True)
    assert text.startswith("gate.speed 4.1 m/s: at most 4, the limit for the comparison of sensors")
    assert list(too_slow(4.1, believes, None, None, None, consistent=False)) == []
