"""Noise that depends on seed, stream and index alone."""

import numpy as np
import pytest

from monstertruck_sim.world.noise import COMPASS, CURRENT, SlowNoise, WhiteNoise

INDICES = [0, 1, 511, 512, 40_000]


def test_white_noise_does_not_depend_on_the_order_of_asking():
    forwards, backwards = WhiteNoise(3, COMPASS, 2), WhiteNoise(3, COMPASS, 2)
    there = [forwards.at(index) for index in INDICES]
    assert there == [backwards.at(index) for index in reversed(INDICES)][::-1]
    assert len({value for row in there for value in row}) == 2 * len(INDICES)


def test_streams_and_seeds_differ():
    first = WhiteNoise(3, COMPASS).at(7)
    assert first != WhiteNoise(3, CURRENT).at(7) != WhiteNoise(4, COMPASS).at(7)


def test_white_noise_is_standard_normal_from_block_to_block():
    noise = WhiteNoise(1, CURRENT)
    values = np.array([noise.at(index)[0] for index in range(5000)])
    assert values.mean() == pytest.approx(0, abs=0.05)
    assert values.std() == pytest.approx(1, abs=0.05)
    assert abs(np.corrcoef(values[:-512], values[512:])[0, 1]) < 0.05


def test_slow_noise_is_straight_between_draws_and_joins_them():
    noise, white = SlowNoise(1, CURRENT, 2, 100), WhiteNoise(1, CURRENT, 2)
    assert noise.at(51_100) == white.at(511)
    assert noise.at(51_150) == pytest.approx(np.mean([white.at(511), white.at(512)], axis=0))
    assert noise.at(51_200) == white.at(512)
