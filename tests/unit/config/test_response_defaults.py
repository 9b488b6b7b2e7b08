"""Dead time and lag of a tracker are those of the servos unless it has its own."""

from pathlib import Path

import pytest

from monstertruck_drivers.config import Devices
from monstertruck_planners.track.config import LqrConfig
from monstertruckd.assembly.planning import with_response

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
