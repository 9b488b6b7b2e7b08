"""One device that controls several driven shafts, in the configuration of a whole robot."""

from pathlib import Path
from typing import Any

import pytest

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import SHAFTS
from monstertruckd.assembly.devices import sensor_services
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation.config import load_simulated

STAND = Path(__file__).resolve().parents[3] / "configs" / "robots" / "skid_stand.yaml"


def stand(**changes: Any) -> TruckConfig:
    """The stand's robot with settings of its own, by dotted name with __."""
    data = load_simulated(STAND).model_dump()
    for name, value in changes.items():
        *sections, key = name.split("__")
        place = data
        for section in sections:
            place = place[section]
        place[key] = value
    return TruckConfig.model_validate(data, strict=False)


def test_one_device_serves_all_shafts_and_its_loss_is_theirs():
    config = stand()
    shafts = config.devices.shafts()
    assert tuple(shafts) == SHAFTS
    assert len({id(device) for device in shafts.values()}) == 1
    assert sensor_services(config) == {"wheels": Reason.DRIVE_STALE}
    assert config.missing_actuators() is None
    assert config.body_limits.motor_speed == pytest.approx(250 / 400 * 6.2832 * 0.021, rel=1e-3)


def test_a_side_each_takes_two_motors():
    config = stand(body__motors="sides", devices__wheels__driver__motors=2)
    assert tuple(config.devices.shafts()) == SHAFTS[:2]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"devices__wheels__driver__motors": 3}, "is driven by drive (front left), drive_2 (front right)"),
        ({"gate__speed": 0.1}, "gate.speed 0.1 m/s: at most 0.082"),
        ({"devices__wheels__driver__quick_deceleration": 4000, "gate__quick_deceleration": 1.5}, "to brake with 10 "),
        (
            {"devices__wheels__driver__watchdog": 2.0, "gate__speed": 0.07},
            "devices.wheels.driver.watchdog 2 s: at most",
        ),
        (
            {"devices__drive_3": {"port": {"path": "/dev/x"}, "driver": {"kind": "epos"}}},
            "both publish sensor/drive_3; expected one writer for each topic",
        ),
        (
            {
                "devices__steering": {
                    "port": {"path": "/dev/x"},
                    "driver": {"kind": "maestro", "front_right": {"channel": 2}, "rear_right": {"channel": 3}},
                }
            },
            "body skid_steer has no steering: expected front_right and rear_right of devices.steering null",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(changes: dict[str, Any], said: str):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # pydantic's own; the text is checked
        stand(**changes)
    assert said in str(caught.value)


def test_what_the_robot_cannot_notice_is_said():
    texts = stand().weakened()
    assert any("steppers report the commanded steps" in text for text in texts)
    assert any(text.startswith("devices: no range sensor") for text in texts)
