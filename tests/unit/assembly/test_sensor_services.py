"""Which service's loss makes which sensor stale, for the roles that are configured."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruck_drivers.catalog import COMPASS, DEVICES
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.assembly.devices import measures_battery, sensor_services, without
from monstertruckd.config.load import load_truck
from monstertruckd.tools.simulation.config import load_robot

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def test_the_services_of_the_truck():
    config, _ = load_truck(CONFIGS / "truck.yaml")
    assert sensor_services(config) == {
        "lidar": Reason.SCAN_STALE,
        "drive": Reason.DRIVE_STALE,
        "steering": Reason.STEERING_STALE,
        "compass": Reason.ATTITUDE_STALE,
    }


def test_a_role_of_another_name_that_writes_a_sensor_topic(monkeypatch: pytest.MonkeyPatch):
    imu = dataclasses.replace(COMPASS, name="imu")
    monkeypatch.setattr("monstertruckd.assembly.devices.DEVICES", SimpleNamespace(roles={**DEVICES.roles, "imu": imu}))
    plain = SimpleNamespace(kind=SimpleNamespace(also={}), driver=SimpleNamespace())
    config = SimpleNamespace(devices=SimpleNamespace(present=lambda: dict.fromkeys(("imu", "camera"), plain)))
    assert sensor_services(config) == {"imu": Reason.ATTITUDE_STALE}  # type: ignore[arg-type]


def test_who_measures_the_battery():
    config, _ = load_truck(CONFIGS / "truck.yaml")
    devices, monitors = config.devices, config.monitors
    assert devices.steering is not None
    assert devices.steering.driver.battery is not None
    assert measures_battery(config)
    without = devices.steering.driver.model_copy(update={"battery": None})
    blind = devices.model_copy(update={"steering": devices.steering.model_copy(update={"driver": without})})
    assert not measures_battery(config.model_copy(update={"devices": blind}))
    assert not measures_battery(config.model_copy(update={"devices": devices.model_copy(update={"steering": None})}))
    watched = monitors.model_copy(update={"battery": object()})
    assert measures_battery(config.model_copy(update={"devices": blind, "monitors": watched}))


def test_of_two_devices_that_could_measure_the_battery_the_one_that_does_publishes_it():
    config = load_robot(CONFIGS / "robots" / "truck_today.yaml")[0]
    devices = config.devices
    assert devices.steering is not None
    assert devices.actuators is not None
    assert devices.lidar is not None
    assert without(devices.steering.driver) == (topics.BATTERY,)
    assert without(devices.actuators.driver) == without(devices.lidar.driver) == ()
