"""Wizards of odometry, lidar, inertial unit and skid-steer bodies through the whole daemon, true values hidden."""

from pathlib import Path

import numpy as np
import pytest

from monstertruckd.config.calibration import CalibrationStore, WizardName, with_values
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate.camera import CameraWizard, camera_wizard
from monstertruckd.tools.calibrate.imu import ImuWizard, imu_wizard
from monstertruckd.tools.calibrate.lidar import LidarWizard, lidar_wizard
from monstertruckd.tools.calibrate.odometry import odometry_wizard
from monstertruckd.tools.calibrate.slip import SlipWizard, slip_wizard
from monstertruckd.tools.calibrate.sonar import SonarWizard, sonar_wizard
from monstertruckd.tools.calibrate.stabiliser import stabiliser_wizard
from monstertruckd.tools.calibrate.wizard import Wizard
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import hidden, run_session, verdicts

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(600)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def truck(folder: Path, seed: int, name: WizardName) -> SimulatedTruckConfig:
    base = load_config(CONFIGS / "yard.yaml", SimulatedTruckConfig)[0]
    plain = SimulatedTruckConfig.model_validate(
        base.model_dump() | {"sim": {"world": {"map": "yard"}}, "state_directory": folder, "recorder": None}
    )
    if name == "imu":
        imu = {"port": {"path": Path("/tmp/monstertruck/imu")}, "driver": {"kind": "wt61"}}
        plain = with_overlay(plain, {"devices": {"imu": imu}})
    return hidden(plain, np.random.default_rng(seed), seed, (name,))


def judged(wizard: Wizard, config: SimulatedTruckConfig, seed: int, outside: int = 0) -> set[str]:
    """Names of the estimates; of many intervals of 95 % some are ``outside``."""
    session = run_session(config, wizard, np.random.default_rng(seed))
    found = verdicts(session.result, config)
    missed = [verdict for verdict in found if not verdict.holds]
    assert len(missed) <= outside, missed
    return {verdict.name.partition(".")[2] for verdict in found}


@pytest.mark.long
def test_odometry(tmp_path: Path):
    config = truck(tmp_path, 1, "odometry")
    assert judged(odometry_wizard(), config, 1) >= {"drive_ratio", "wheelbase", "front_centre", "rear_centre"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    calibrated = with_values(config, current.results.values(), "calibration")
    assert calibrated.geometry.wheelbase != config.geometry.wheelbase


@pytest.mark.long
def test_lidar(tmp_path: Path):
    wizard = lidar_wizard(LidarWizard(heights=True))
    assert judged(wizard, truck(tmp_path, 2, "lidar"), 2) == {"x", "y", "yaw", "pitch", "roll"}


@pytest.mark.long
def test_imu(tmp_path: Path):
    wizard = imu_wizard(ImuWizard(rounds=1))
    assert judged(wizard, truck(tmp_path, 3, "imu"), 3) >= {"rate_z", "rate_scale", "force_x"}


@pytest.mark.long
def test_slip(tmp_path: Path):
    body = {"kind": "skid_steer", "motors": "wheels", "icr_left": 0.08, "icr_right": -0.07, "gain_left": 1.05}
    base = load_config(CONFIGS / "robots" / "skid_stand.yaml", SimulatedTruckConfig)[0]
    overlay = {
        "recorder": None,
        "blackbox": None,
        "state_directory": tmp_path,
        "sim": {"world": {"truck": {"body": body}}},
    }
    config = with_overlay(base, overlay)
    assert judged(slip_wizard(SlipWizard(rounds=1)), config, 4) >= {"icr_left", "icr_right", "gain_left"}


@pytest.mark.long
def test_stabiliser(tmp_path: Path):
    base = load_config(CONFIGS / "full.yaml", SimulatedTruckConfig)[0]
    lean = {"devices": {"camera": None}, "monitors": {"link": None, "host": None}, "planner": None, "path": None}
    overlay = {
        "recorder": None,
        "blackbox": None,
        "state_directory": tmp_path,
        "sim": {"world": {"map": "yard"}},
        **lean,
    }
    config = hidden(with_overlay(base, overlay), np.random.default_rng(6), 6, ("stabiliser",))
    found = judged(stabiliser_wizard(), config, 6)
    assert found == {"pitch_zero", "pitch_direction", "roll_zero", "roll_direction"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    driver = with_values(config, current.results.values(), "calibration").devices.stabiliser.driver
    assert (driver.pitch.direction, driver.roll.direction) == tuple(
        getattr(config.sim.world.mount, joint).direction for joint in ("pitch", "roll")
    )


@pytest.mark.long
def test_camera(tmp_path: Path):
    overlay = {
        "devices": {"camera": {"mount": {"x": 0.18, "z": 0.25}, "driver": {"kind": "webcam", "rate": 5}}},
        "sim": {"world": {"camera": {"noise": 3.0}, "board": {}}},
    }
    overlay["devices"]["camera"]["port"] = {"path": tmp_path / "camera"}
    config = hidden(with_overlay(truck(tmp_path, 7, "camera"), overlay), np.random.default_rng(7), 7, ("camera",))
    found = judged(camera_wizard(CameraWizard(patience=120.0)), config, 7, outside=2)
    assert found >= {"focal_x", "centre_y", "k1", "x", "z", "pitch"}
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    camera = with_values(config, current.results.values(), "calibration").devices.camera
    assert camera.driver.lens.focal_x != config.devices.camera.driver.lens.focal_x
    assert camera.mount != config.devices.camera.mount


@pytest.mark.long
def test_sonar(tmp_path: Path):
    base = load_config(CONFIGS / "robots" / "sonar.yaml", SimulatedTruckConfig)[0]
    overlay = {"recorder": None, "blackbox": None, "state_directory": tmp_path}
    overlay |= {"devices": {"sonar": {"driver": {"speed_of_sound": 340.0}}}}
    config = hidden(with_overlay(base, overlay), np.random.default_rng(5), 5, ("sonar",))
    assert len(judged(sonar_wizard(SonarWizard(turn=3.3, speed=0.25)), config, 5, outside=2)) == 17
    current = CalibrationStore(config.calibration_folder, config.robot).current()
    assert current is not None
    calibrated = with_values(config, current.results.values(), "calibration")
    assert calibrated.devices.sonar.driver.sonars["l"].mount != config.devices.sonar.driver.sonars["l"].mount
