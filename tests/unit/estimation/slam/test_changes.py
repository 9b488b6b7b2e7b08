"""A lift: what the map shows around its cabin is gone."""

import numpy as np
import pytest

from monstertruck_estimation.slam.mapping import Mapper, MappingEvent
from tests.unit.estimation.slam.kit import box, drifting, scan

CABIN = [
    *[((-1.0, -1.0), (-1.0, 1.0)), ((-1.0, 1.0), (1.0, 1.0)), ((-1.0, -1.0), (1.0, -1.0))],
    *[((1.0, -1.0), (1.0, -0.5)), ((1.0, 0.5), (1.0, 1.0))],
]
DOOR = [((1.0, -0.5), (1.0, 0.5))]


def floor(depth: float, width: float, pillars: list[tuple[float, float]]):
    walls = [((1.0, -width), (1.0, -1.0)), ((1.0, 1.0), (1.0, width)), *box(1.0, -width, depth, width)[:3]]
    return [*CABIN, *walls, *(wall for x, y in pillars for wall in box(x, y, x + 0.5, y + 0.4))]


FIRST = floor(8.0, 4.0, [(3.0, 1.4), (5.0, -1.8), (6.5, 2.2)])
SECOND = floor(9.0, 5.0, [(2.5, -2.0), (4.4, 1.5), (6.0, 3.0), (6.8, -1.7)])


@pytest.mark.parametrize(("there", "changed"), [(FIRST, 0), (SECOND, 1)])
def test_another_floor_behind_the_door_of_a_lift_is_reported_once(there, changed: int):
    turns = np.linspace(np.pi, 0.0, 30)
    way_in = np.column_stack((np.linspace(6.0, 0.0, 80), np.zeros(80), np.full(80, np.pi)))
    inside = np.column_stack((np.zeros((30, 2)), turns))
    way_out = np.column_stack((np.linspace(0.0, 6.0, 80), np.zeros((80, 2))))
    truth = np.concatenate((way_in, inside, np.zeros((20, 3)), way_out))
    odom, mapper, rng = drifting(truth), Mapper(), np.random.default_rng(1)
    events = []
    for k, pose in enumerate(truth):
        walls = FIRST if k < 110 else [*CABIN, *DOOR] if k < 130 else there
        step = mapper.step(scan(walls, pose, noise=0.01, rng=rng), (k + 1) * 10**8, odom[k])
        assert step is not None
        events += step.events
    assert events.count(MappingEvent.CHANGED) == changed
