"""Dead time and lag of a tracker are those of the servos unless it has its own."""

from pathlib import Path

import pytest

from monstertruck_drivers.config import Devices
from monstertruck_planners.track.config import LqrConfig
from monstertruckd.assembly.planning import with_response
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

SERVOS = {"steering": {"port": {"path": Path("/dev/truck/steering")}, "driver": {"dead_time": 0.06, "lag": 0.03}}}


@pytest.mark.parametrize(
    ("own", "devices", "expected"),
    [
        ({}, SERVOS, (0.06, 0.03)),
        ({"dead_time": 0.0}, SERVOS, (0.0, None)),
        ({}, {}, (None, None)),
    ],
)
def test_the_servos_response_is_the_default(own, devices, expected):
    found = with_response(LqrConfig(kind="lqr", **own), Devices.model_validate(devices))
    assert (found.dead_time, found.lag) == expected


CONFIGS = Path(__file__).resolve().parents[3] / "configs"
REAL, TO_CALIBRATE = "truck.yaml", "yard.yaml"


def test_shipped_configurations_with_emulated_servos_say_how_late_these_answer():
    """The chain's own share: the simulated servos of these files have neither dead time nor lag."""
    reported = {}
    for file in sorted((*CONFIGS.glob("*.yaml"), *(CONFIGS / "robots").glob("*.yaml"))):
        if file.name == REAL and file.parent == CONFIGS:
            continue
        config = load_config(file, SimulatedTruckConfig)[0]
        servos, truck = config.devices.steering, config.sim.world.truck
        if servos is not None:
            assert truck.front_servo.dead_time == truck.front_servo.lag == 0.0, file.name
            reported[f"{file.parent.name}/{file.name}"] = servos.driver.dead_time, servos.driver.lag
    assert reported.pop(f"configs/{TO_CALIBRATE}") == (None, None)
    assert len(reported) > 10
    assert set(reported.values()) == {(0.012, 0.0)}, reported
