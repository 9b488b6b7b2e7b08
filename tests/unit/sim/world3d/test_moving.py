"""Beams leave from where the moving robot is, and robots that share a world see and stop each other."""

from math import pi

import mujoco
import numpy as np
import pytest

from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import Hills, WorldConfig
from monstertruck_sim.world.obstacles import Disc
from monstertruck_sim.world.world import World, make_scene

SECOND = 1_000_000_000
RPM = 644 / (2 * pi * 0.075) * 60


@pytest.mark.parametrize("steering", [0.0, 0.35])
def test_every_beam_of_a_sweep_leaves_from_where_the_robot_is_then(solid, steering):
    """Put where the robot was at its instant, every beam ends on the straight wall; by one pose for all it does not.

    Over a sweep the robot drives 0.02 m, or turns by 2 degrees as well.
    """
    driver = solid(walls=[(3.0, -5.0, 3.2, 5.0)])
    driver.steer(steering, -steering)
    driver.drive(0.2)
    driver.wait(2.0)
    begin = driver.now
    poses = []
    for _ in range(51):
        truth = driver.world.truth(driver.now)
        poses.append((truth.x, truth.yaw))
        driver.wait(0.002)
    driver.wait(0.05)
    scan = driver.world.lidar.scan(begin) / 1000
    steps = np.arange(210, 450, 10)
    x, yaw = (np.interp(steps * 0.1 / 1024, np.arange(51) * 0.002, row) for row in np.transpose(poses))
    bearings = (steps - 384) * 2 * pi / 1024

    def ends(x, yaw):
        return x + 0.14 * np.cos(yaw) + scan[steps] * np.cos(yaw + bearings)

    assert ends(x, yaw) == pytest.approx(3.0, abs=0.002)
    assert abs(ends(*poses[0]) - 3.0).max() > 0.007
    assert abs(poses[-1][1] - poses[0][1]) > 0.035 or not steering


def pair(gap, **world):
    starts = [Pose2D(x=x, y=0.0, yaw=0.0) for x in (0.0, gap)]
    configs = [WorldConfig(engine="mujoco", map="yard", noise=False, start=start, **world) for start in starts]
    scene = make_scene(configs[0], 1, configs[1:])
    return [World(config, 1, scene, f"robot_{i}") for i, config in enumerate(configs)]


def test_robots_see_each_other_and_the_one_behind_is_stopped():
    behind, ahead = pair(1.0)
    assert behind.lidar.scan(0)[384] == pytest.approx(1000 - 140 - 235, abs=2)
    behind.motors[0].command(0, -0.2 * RPM, 20_000.0)
    for tenth in range(1, 60):
        behind.truth(tenth * SECOND // 10)
        ahead.truth(tenth * SECOND // 10)
    truth = behind.truth(6 * SECOND)
    assert truth.stuck
    assert truth.x == pytest.approx(1.0 - 0.47, abs=0.02)
    assert [contact.other for contact in behind.scene.contacts] == ["robot_1"]


def test_a_robot_that_drives_away_is_followed_to_where_it_is():
    behind, ahead = pair(0.8)
    ahead.motors[0].command(0, -0.2 * RPM, 20_000.0)
    behind.motors[0].command(0, -0.2 * RPM, 20_000.0)
    for tenth in range(1, 60):
        behind.truth(tenth * SECOND // 10)
        ahead.truth(tenth * SECOND // 10)
    assert behind.truth(6 * SECOND).x == pytest.approx(ahead.truth(6 * SECOND).x - 0.8, abs=0.01)
    assert not behind.truth(6 * SECOND).stuck


def test_the_ground_is_the_same_for_both_and_level_where_either_begins():
    behind, ahead = pair(3.0, ground=[Hills(kind="hills", height=0.05, wavelength=1.0)])
    assert (behind.plant.model.hfield_data == ahead.plant.model.hfield_data).all()
    assert [world.plant.ground(x, 0.2) for world in (behind, ahead) for x in (0.0, 3.0)] == [0.0] * 4
    assert abs(behind.plant.ground(1.5, 0.2)) > 1e-4


def test_a_robot_whose_daemon_is_gone_stands_in_the_way_until_another_daemon_drives_it():
    behind, ahead = pair(0.7)
    ahead.motors[0].command(0, -0.2 * RPM, 20_000.0)
    ahead.truth(SECOND // 2)
    ahead.motors[0].command(SECOND // 2, None, 20_000.0)
    behind.motors[0].command(SECOND // 2, -0.2 * RPM, 20_000.0)
    for tenth in range(5, 30):  # nobody asks for the other one, not even where it is
        behind.truth(tenth * SECOND // 10)
    stopped = behind.truth(3 * SECOND)
    assert stopped.stuck
    behind.motors[0].command(3 * SECOND, 0.0, 20_000.0)
    stood = ahead.truth(3 * SECOND)
    assert stopped.x == pytest.approx(stood.x - 0.47, abs=0.02)
    assert abs(stood.v) < 0.01
    ahead.motors[0].command(3 * SECOND, -0.2 * RPM, 20_000.0)
    assert ahead.truth(4 * SECOND).x > stood.x + 0.08


def test_spare_bodies_cost_no_contact_and_no_picture_until_they_stand_for_something(solid):
    driver = solid()
    model = driver.world.plant.model
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "disc_0")
    geom = model.body_geomadr[body]

    def costs():
        driver.wait(0.01)
        return int(model.geom_contype[geom]), int(model.body_contype[body]), float(model.geom_rgba[geom, 3])

    assert costs() == (0, 0, 0.0)
    driver.world.add(driver.now, Disc(1.5, 0.0, 0.1))
    assert costs() == (9, 9, 1.0)
    driver.world.remove(driver.now, Disc(1.5, 0.0, 0.1))
    assert costs() == (0, 0, 0.0)
