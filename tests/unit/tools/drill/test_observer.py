"""What the observer of a drill takes for motion."""

from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruckd.tools.drill.observer import TRUTH_PERIOD, _Standstill


def found(speeds):
    """Rules that a truck breaks which has to stop, by its speeds at every hundredth of a second, m/s."""
    rule, broken, x = _Standstill(), set(), 0.0
    rule.begin(0, must_stop=True, disarms=True)
    for step, speed in enumerate(speeds):
        x += float(speed) * TRUTH_PERIOD / SECOND
        seen = SimpleNamespace(now=step * TRUTH_PERIOD, truth=SimpleNamespace(x=x, y=0.0, v=float(speed)), targets=())
        broken |= {name for name, _ in rule(seen)}
    return broken


BRAKED = np.linspace(0.18, 0.0, 30)
T = np.arange(120) * TRUTH_PERIOD / SECOND


def test_a_truck_that_rocks_where_it_stopped_stands():
    assert found([*BRAKED, *(0.014 * np.sin(20 * T))]) == set()


@pytest.mark.parametrize("speed", [0.013, -0.013])
def test_one_that_creeps_on_does_not(speed):
    assert found([*BRAKED, *np.full(len(T), speed)]) == {"stop", "unarmed"}


def test_one_that_never_stood_has_to():
    assert found(np.full(100, 0.05)) == {"stop"}
