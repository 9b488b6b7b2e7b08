"""Clients that are not ours measure the room that the emulated RPLIDARs stand in."""

import numpy as np
import pytest

from monstertruck_drivers.rplidar.protocol import MODELS
from tests.long_kit import mostly_long
from tests.unit.drivers.rplidar.clients import USES, c1, measured, steps_off

pytestmark = pytest.mark.wall

BY_NAME = {name: use for *use, name in USES}
KEPT = {
    "rplidar-roboticia standard",
    "pyrplidar express",
    "pyrplidar ultra",
    "rplidarc1 standard",
    "pyrplidarsdk dense",
}
"""Every client, every way of sending samples."""


@pytest.mark.parametrize("name", mostly_long(BY_NAME, KEPT))
async def test_beams_of_foreign_clients_are_in_the_right_place_to_one_step(tmp_path, name):
    model, client, mode = BY_NAME[name]
    points = await measured(tmp_path, model, client, mode)
    assert len(points[0]) > 300
    sheet = MODELS[model]
    finest = max(each.sample_time for each in sheet.modes)
    off = steps_off(points, 2 * np.pi * finest * sheet.frequency)
    assert np.percentile(off, 99) <= (1.0 if client is not c1 else 3.0)
