import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_estimation.odometry import Spread

NUMBER = st.floats(-3.0, 3.0)
ROOT = st.lists(NUMBER, min_size=9, max_size=9).map(lambda numbers: np.reshape(numbers, (3, 3)))


def spread(matrix):
    return Spread(matrix[0, 0], matrix[0, 1], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[2, 2])


def full(found):
    return np.reshape(found.matrix(), (3, 3))


@given(root=ROOT, other=ROOT)
def test_it_stands_for_a_symmetric_matrix_and_adds_like_one(root, other):
    one, two = root @ root.T, other @ other.T
    np.testing.assert_array_equal(full(spread(one)), full(spread(one)).T)
    np.testing.assert_allclose(full(spread(one).plus(spread(two))), one + two, atol=1e-12)


@given(root=ROOT, dx=NUMBER, dy=NUMBER)
def test_a_way_swings_it_with_the_yaw(root, dx, dy):
    covariance = root @ root.T
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(full(spread(covariance).moved(dx, dy)), by_pose @ covariance @ by_pose.T, atol=1e-9)


@given(root=ROOT, noise=st.floats(0.1, 3.0))
def test_a_yaw_corrects_it_as_in_kalmans_filter(root, noise):
    covariance = root @ root.T
    gain = covariance[:, 2] / (covariance[2, 2] + noise)
    expected = (np.eye(3) - np.outer(gain, [0.0, 0.0, 1.0])) @ covariance
    np.testing.assert_allclose(full(spread(covariance).corrected(*gain)), expected, atol=1e-9)
