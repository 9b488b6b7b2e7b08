"""Poses one by one and many at once."""

import numpy as np
import pytest

from monstertruck_kinematics.se2 import between, compose, inverse


@pytest.mark.parametrize("algebra", [compose, between, lambda outer, inner: inverse(compose(outer, inner))])
def test_a_single_pose_is_to_the_last_bit_the_one_of_many(algebra, rng):
    outer, inner = rng.normal(0.0, 3.0, (2, 200, 3))
    many = algebra(outer, inner)
    assert many.shape == (200, 3)
    assert np.array_equal([algebra(one, other) for one, other in zip(outer, inner, strict=True)], many)
    assert np.array_equal(algebra(outer[0], inner), algebra(np.broadcast_to(outer[0], inner.shape), inner))
    assert algebra(outer[0], inner[0]).shape == (3,)


def test_there_and_back_is_nothing(rng):
    outer, inner = rng.normal(0.0, 3.0, (2, 200, 3))
    assert between(outer, compose(outer, inner))[:, :2] == pytest.approx(inner[:, :2])
    assert compose(outer, inverse(outer)) == pytest.approx(0.0, abs=1e-12)
