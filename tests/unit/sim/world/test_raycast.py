"""The compiled walk against a slow exact reference that knows nothing of walking."""

from math import cos, inf, pi, sin
from timeit import timeit

import numpy as np
import pytest

from monstertruck_sim.world.raycast import cast_rays, clearance, grid_penetration

NO_DISCS, NO_SEGMENTS = np.zeros((0, 3)), np.zeros((0, 4))


def slab_reference(occupied, resolution, origin, x, y, angle, reach):
    """Least entry distance over all occupied cells, each intersected as a box of its own."""
    rows, columns = np.nonzero(occupied)
    low_x, low_y = origin[0] + columns * resolution, origin[1] + rows * resolution
    with np.errstate(divide="ignore", invalid="ignore"):
        tx = np.sort(np.stack([low_x - x, low_x + resolution - x]) / cos(angle), axis=0)
        ty = np.sort(np.stack([low_y - y, low_y + resolution - y]) / sin(angle), axis=0)
    enter, leave = np.maximum(tx[0], ty[0]), np.minimum(tx[1], ty[1])
    hit = (enter <= leave) & (leave >= 0)
    best = np.maximum(enter[hit], 0).min(initial=inf)
    return best if best <= reach else inf


@pytest.mark.parametrize("seed", range(4))
def test_every_range_is_exact(seed):
    rng = np.random.default_rng(seed)
    occupied = rng.random((60, 80)) < 0.02
    origin, resolution, reach = (-1.3, 0.7), 0.05, 3.0
    xs = rng.uniform(-2, 3.5, 250)  # some outside the grid, some inside walls
    ys = rng.uniform(0, 4.5, 250)
    angles = rng.uniform(-10, 10, 250)
    got = cast_rays(clearance(occupied), resolution, *origin, xs, ys, angles, reach, NO_DISCS, NO_SEGMENTS)
    want = [slab_reference(occupied, resolution, origin, *ray, reach) for ray in zip(xs, ys, angles, strict=True)]
    np.testing.assert_allclose(got, want, atol=1e-9)
    assert 0 < np.isinf(got).sum() < 250


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3])
def test_clearance_is_the_distance_to_the_nearest_occupied_cell(share):
    occupied = np.random.default_rng(1).random((40, 300)) < share
    rows, columns = np.nonzero(occupied)
    got = clearance(occupied)
    for row, column in np.ndindex(occupied.shape):
        want = np.maximum(abs(rows - row), abs(columns - column)).min(initial=255)
        assert got[row, column] == want


@pytest.mark.parametrize(("angle", "want"), [(0.0, 0.475), (pi / 2, inf), (pi, inf), (-pi / 2, inf)])
def test_axis_parallel_rays(angle, want):
    occupied = np.zeros((20, 20), bool)
    occupied[:, 10] = True
    got = cast_rays(
        clearance(occupied),
        0.1,
        0.0,
        0.0,
        np.array([0.525]),
        np.array([0.5]),
        np.array([angle]),
        9.0,
        NO_DISCS,
        NO_SEGMENTS,
    )
    assert got[0] == pytest.approx(want)


def test_discs_and_segments_hide_the_map():
    occupied = np.zeros((10, 10), bool)
    discs = np.array([[2.0, 0.0, 0.5]])
    segments = np.array([[-1.0, -1.0, -1.0, 1.0]])
    angles = np.array([0.0, pi, 0.2, 1.0])
    zeros = np.zeros(4)
    got = cast_rays(clearance(occupied), 0.1, 5.0, 5.0, zeros, zeros, angles, 5.0, discs, segments)
    grazing = 2 * cos(0.2) - np.sqrt(0.25 - (2 * sin(0.2)) ** 2)
    np.testing.assert_allclose(got, [1.5, 1.0, grazing, inf])


def test_ray_from_inside_a_disc_is_zero_long():
    got = cast_rays(
        clearance(np.zeros((1, 1), bool)), 1.0, 0.0, 0.0, np.zeros(1), np.zeros(1), np.zeros(1), 5.0,
        np.array([[0.1, 0.0, 0.3]]), NO_SEGMENTS,
    )  # fmt: skip
    assert got[0] == 0


def test_a_scan_is_fast():
    occupied = np.zeros((240, 240), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    angles = np.linspace(-2.1, 2.1, 682)
    xs = np.full(682, 6.0)
    args = (clearance(occupied), 0.05, 0.0, 0.0, xs, xs, angles, 5.6, NO_DISCS, NO_SEGMENTS)
    cast_rays(*args)
    seconds = min(timeit(lambda: cast_rays(*args), number=1) for _ in range(20))
    print(f"682 beams to 5.6 m: {seconds * 1e6:.0f} us")
    assert seconds < 1e-3


def test_rectangle_touches_only_what_it_covers():
    occupied = np.zeros((40, 40), bool)
    occupied[20, 30] = True  # x 1.50..1.55, y 1.00..1.05 at 0.05 m

    def depth(x, y, yaw):
        return grid_penetration(occupied, 0.05, x, y, yaw, 0.47, 0.34)

    assert depth(1.26, 1.02, 0.0) == 0
    assert depth(1.27, 1.02, 0.0) == pytest.approx(0.005)
    assert depth(1.30, 1.02, 0.0) > depth(1.28, 1.02, 0.0)
    assert depth(1.34, 1.02, pi / 2) > 0
    assert depth(1.32, 1.02, pi / 2) == 0
    # A corner of the turned rectangle: its bounding box covers the cell, the rectangle does not.
    assert depth(1.25, 0.80, pi / 4) == 0


@pytest.mark.parametrize("seed", range(3))
def test_penetration_agrees_with_sampling(seed):
    rng = np.random.default_rng(seed)
    occupied = rng.random((40, 40)) < 0.02
    grid_x, grid_y = np.meshgrid(np.linspace(-0.235, 0.235, 120), np.linspace(-0.17, 0.17, 90))
    for _ in range(50):
        x, y, yaw = rng.uniform(0.5, 1.5), rng.uniform(0.5, 1.5), rng.uniform(-4, 4)
        columns = ((x + cos(yaw) * grid_x - sin(yaw) * grid_y) / 0.05).astype(int)
        rows = ((y + sin(yaw) * grid_x + cos(yaw) * grid_y) / 0.05).astype(int)
        depth = grid_penetration(occupied, 0.05, x, y, yaw, 0.47, 0.34)
        if occupied[rows, columns].any():
            assert depth > 0
        else:
            assert depth < 0.01  # a sliver between samples at most
