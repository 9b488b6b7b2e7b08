"""Clients that are not ours measure the room that the emulated RPLIDARs stand in."""

import numpy as np
import pytest

from monstertruck_drivers.rplidar.protocol import MODELS
from tests.unit.drivers.rplidar.clients import USES, c1, measured, steps_off

pytestmark = pytest.mark.wall


@pytest.mark.parametrize(("model", "client", "mode"), [use[:3] for use in USES], ids=[use[3] for use in USES])
async def test_beams_of_foreign_clients_are_in_the_right_place_to_one_step(tmp_path, model, client, mode):
    points = await measured(tmp_path, model, client, mode)
    assert len(points[0]) > 300
    sheet = MODELS[model]
    finest = max(each.sample_time for each in sheet.modes)
    off = steps_off(points, 2 * np.pi * finest * sheet.frequency)
    assert np.percentile(off, 99) <= (1.0 if client is not c1 else 3.0)
