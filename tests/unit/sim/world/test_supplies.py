"""Supplies of the simulated truck that fail one by one."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World


class Pulses:
    """The same pulse at every output."""

    us = 1240.0

    def pulse_us(self, channel, time_ns):
        return self.us


@pytest.fixture
def world():
    made = World(WorldConfig(), seed=1)
    made.servos.attach(Pulses())
    return made


def test_servos_without_supply_stay_where_they_are(world):
    steered = world.truth(SECOND).front
    assert abs(world.truth(2 * SECOND).front - steered) > 0.1
    held = world.truth(2 * SECOND).front
    world.supply_servos(2 * SECOND, on=False)
    Pulses.us = 1640.0
    assert world.truth(3 * SECOND).front == held
    world.supply_servos(3 * SECOND, on=True)
    assert world.truth(4 * SECOND).front == pytest.approx(-held, abs=0.05)
    Pulses.us = 1240.0


def test_a_pulled_battery_reads_nothing_and_comes_back(world):
    full = world.truth(SECOND).supply_v
    world.connect_battery(SECOND, connected=False)
    assert world.truth(2 * SECOND).supply_v == 0
    assert world.servos.analog_volts(5, 3 * SECOND) < 0.1
    world.connect_battery(3 * SECOND, connected=True)
    assert world.truth(4 * SECOND).supply_v == pytest.approx(full, abs=0.5)
