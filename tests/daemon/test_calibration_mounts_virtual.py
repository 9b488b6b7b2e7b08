"""Wizards of odometry, lidar, inertial unit and skid-steer bodies through the whole daemon, true values hidden."""

from pathlib import Path

import numpy as np
import pytest

from monstertruckd.config.calibration import CalibrationStore, with_values
from monstertruckd.tools.calibrate.camera import CameraWizard
from monstertruckd.tools.calibrate.imu import ImuWizard
from monstertruckd.tools.calibrate.lidar import LidarWizard
from monstertruckd.tools.calibrate.odometry import OdometryWizard
from monstertruckd.tools.calibrate.slip import SlipWizard
from monstertruckd.tools.calibrate.sonar import SonarWizard
from monstertruckd.tools.calibrate.stabiliser import StabiliserWizard
from monstertruckd.tools.calibrate.wizard import Wizard
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import distance_from_fit, run_session, verdicts
from tests.calibration_robots import robot_of

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(600)]


def judged(wizard: Wizard, config: SimulatedTruckConfig, seed: int, outside: int = 0) -> set[str]:
    """Names of the estimates; of many intervals of 95 % some are ``outside``."""
    session = run_session(config, wizard, np.random.default_rng(seed))
    found = verdicts(session.result, config)
    missed = [verdict for verdict in found if not verdict.holds]
    assert len(missed) <= outside, missed
    assert session.plot is not None
    assert distance_from_fit(session.plot) < 0.05
    return {verdict.name.partition(".")[2] for verdict in found}


@pytest.mark.long
def test_odometry(tmp_path: Path):
    config = robot_of("odometry", tmp_path, 1)
    assert judged(OdometryWizard(), config, 1) >= {"drive_ratio", "wheelbase", "front_centre", "rear_centre"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    calibrated = with_values(config, current.results.values(), "calibration")
    assert calibrated.geometry.wheelbase != config.geometry.wheelbase


@pytest.mark.long
def test_lidar(tmp_path: Path):
    wizard = LidarWizard(heights=True)
    assert judged(wizard, robot_of("lidar", tmp_path, 2), 2) == {"x", "y", "yaw", "pitch", "roll"}


@pytest.mark.long
def test_imu(tmp_path: Path):
    wizard = ImuWizard(rounds=1)
    assert judged(wizard, robot_of("imu", tmp_path, 3), 3) >= {"rate_z", "rate_scale", "force_x"}


@pytest.mark.long
def test_slip(tmp_path: Path):
    config = robot_of("slip", tmp_path, 4)
    assert judged(SlipWizard(rounds=1), config, 4) >= {"icr_left", "icr_right", "gain_left"}


@pytest.mark.long
@pytest.mark.parametrize("engine", ["plane", "mujoco"])
def test_stabiliser(tmp_path: Path, engine: str):
    config = with_overlay(robot_of("stabiliser", tmp_path, 6), {"sim": {"world": {"engine": engine}}})
    found = judged(StabiliserWizard(), config, 6)
    assert found == {"pitch_zero", "pitch_direction", "roll_zero", "roll_direction"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    driver = with_values(config, current.results.values(), "calibration").devices.stabiliser.driver
    assert (driver.pitch.direction, driver.roll.direction) == tuple(
        getattr(config.sim.world.mount, joint).direction for joint in ("pitch", "roll")
    )


@pytest.mark.long
def test_camera(tmp_path: Path):
    config = robot_of("camera", tmp_path, 7)
    found = judged(CameraWizard(patience=120.0), config, 7, outside=2)
    assert found >= {"focal_x", "centre_y", "k1", "x", "z", "pitch"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    camera = with_values(config, current.results.values(), "calibration").devices.camera
    assert camera.driver.lens.focal_x != config.devices.camera.driver.lens.focal_x
    assert camera.mount != config.devices.camera.mount


@pytest.mark.long
def test_sonar(tmp_path: Path):
    config = robot_of("sonar", tmp_path, 5)
    assert len(judged(SonarWizard(turn=3.3, speed=0.25), config, 5, outside=2)) == 17
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    calibrated = with_values(config, current.results.values(), "calibration")
    assert calibrated.devices.sonar.driver.sonars["l"].mount != config.devices.sonar.driver.sonars["l"].mount
