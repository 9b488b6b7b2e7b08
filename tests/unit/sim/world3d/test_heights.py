"""Beams over a height field: where the project's kernels meet it, MuJoCo's rays do."""

import mujoco
import numpy as np
import pytest

from monstertruck_kinematics.description import truck_description
from monstertruck_sim.world.config import MechanicsConfig, SimTruckConfig
from monstertruck_sim.world.mechanics import mechanics
from monstertruck_sim.world3d.engine import drive_line
from monstertruck_sim.world3d.heights import HeightGrid
from monstertruck_sim.world3d.model import Group, StaticScene, load


@pytest.fixture(scope="module")
def hills():
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.arange(41) * 0.1, np.arange(31) * 0.1)
    z = 0.15 * np.sin(2 * x) * np.cos(1.5 * y) + 0.03 * rng.standard_normal(x.shape)
    return HeightGrid(z, 0.1, (-2.0, -1.5))


@pytest.fixture(scope="module")
def model(hills):
    parts = mechanics(SimTruckConfig(), MechanicsConfig())
    return load(
        truck_description(), drive_line(SimTruckConfig(), parts), 0.5, StaticScene(np.zeros((0, 4)), 0.6, hills)
    )


def beams(count):
    rng = np.random.default_rng(5)
    xs, ys = rng.uniform(-1.7, 1.7, count), rng.uniform(-1.2, 1.2, count)
    return xs, ys, rng.uniform(0.3, 0.5, count), rng.uniform(-3.1, 3.1, count), rng.uniform(-0.6, 0.1, count)


def test_beams_meet_the_ground_where_mujocos_rays_do(hills, model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    xs, ys, zs, headings, rises = beams(60)
    met = hills.cast(xs, ys, zs, headings, rises, 3.0)
    group = np.array([i == Group.GROUND for i in range(mujoco.mjNGROUP)], np.uint8)
    hits = 0
    for i, way in enumerate(met):
        direction = np.array([np.cos(headings[i]), np.sin(headings[i]), rises[i]])
        ray = mujoco.mj_ray(model, data, np.array([xs[i], ys[i], zs[i]]), direction, group, True, -1, None)
        x, y = xs[i] + way * direction[0], ys[i] + way * direction[1]
        inside = -1.99 < x < 1.99 and -1.49 < y < 1.49
        if np.isfinite(way) and inside:
            hits += 1
            assert ray == pytest.approx(way, abs=1e-4)
    assert hits > 20


def test_a_point_of_contact_is_on_the_ground_and_nothing_before_it_is_below(hills):
    xs, ys, zs, headings, rises = beams(200)
    met = hills.cast(xs, ys, zs, headings, rises, 5.0)
    hit = np.isfinite(met)
    assert hit.sum() > 100
    x, y = xs + met * np.cos(headings), ys + met * np.sin(headings)
    assert hills.height(x[hit], y[hit]) == pytest.approx((zs + rises * met)[hit], abs=1e-6)
    for part in np.linspace(0.02, 0.98, 30):
        way = np.where(hit, met, 5.0) * part
        assert (zs + rises * way > hills.height(xs + way * np.cos(headings), ys + way * np.sin(headings)) - 1e-9).all()


def test_beams_from_below_meet_it_at_once_and_upward_ones_never(hills):
    one = np.ones(1)
    assert hills.cast(0 * one, 0 * one, -1.0 * one, 0 * one, 0 * one, 5.0)[0] == 0.0
    assert np.isinf(hills.cast(0 * one, 0 * one, 2.0 * one, 0 * one, 0.1 * one, 5.0)[0])


def test_heights_between_points_are_straight_and_beyond_the_edge_the_edges():
    grid = HeightGrid(np.array([[0.0, 1.0], [2.0, 4.0]]), 1.0, (0.0, 0.0))
    assert grid.height(np.array([0.5, 0.0, 0.75, 0.25]), np.array([0.0, 0.5, 0.25, 0.75])) == pytest.approx(
        [0.5, 1.0, 0.75 + 0.25 * 3, 0.75 * 2 + 0.25 * 2]
    )
    assert grid.height(np.array([-3.0, 9.0]), np.array([-3.0, 9.0])) == pytest.approx([0.0, 4.0])
    assert grid.between(0.1, 0.1, 0.2, 0.2) == (0.0, 4.0)
