"""The MuJoCo model: walls cover the map's cells, the robot weighs what its description says."""

import numpy as np
import pytest

from monstertruck_kinematics.description import truck_description
from monstertruck_sim.world.config import MechanicsConfig, SimTruckConfig
from monstertruck_sim.world.mechanics import mechanics
from monstertruck_sim.world3d.engine import drive_line
from monstertruck_sim.world3d.model import Block, StaticScene, load, rectangles


def test_rectangles_cover_every_solid_cell_once_and_no_other():
    solid = np.random.default_rng(1).random((40, 60)) < 0.6
    found = rectangles(solid, 0.05, (-1.0, 2.0), longest=7)
    covered = np.zeros(solid.shape, int)
    for x0, y0, x1, y1 in (found - np.array([-1.0, 2.0, -1.0, 2.0])) / 0.05:
        assert max(x1 - x0, y1 - y0) < 7.01
        covered[round(y0) : round(y1), round(x0) : round(x1)] += 1
    assert (covered == solid).all()


def test_a_solid_map_is_one_rectangle():
    assert rectangles(np.ones((4, 6), bool), 0.5, (0.0, 0.0)).tolist() == [[0.0, 0.0, 3.0, 2.0]]
    assert rectangles(np.zeros((4, 6), bool), 0.5, (0.0, 0.0)).shape == (0, 4)


def test_the_model_has_the_descriptions_mass_and_joints():
    parts = mechanics(SimTruckConfig(), MechanicsConfig())
    description = truck_description(mechanics=parts)
    walls = np.array([[1.0, 1.0, 2.0, 1.1]])
    scene = StaticScene(walls, 0.6, None, (Block(1.0, 0.0, 0.02, 0.1, 1.0, 0.04),))
    model = load(description, drive_line(SimTruckConfig(), parts), 0.5, scene)
    bodies = {model.body(i).name: model.body_mass[i] for i in range(model.nbody)}
    assert sum(bodies[link.name] for link in description.links) == pytest.approx(7.25)
    assert {model.joint(i).name for i in range(1, model.njnt)} == {
        joint.name for joint in description.joints if joint.kind != "fixed"
    }
    assert model.geom("wall_0").pos == pytest.approx([1.5, 1.05, 0.2])
    assert model.geom("block_0").size == pytest.approx([0.05, 0.5, 0.02])
