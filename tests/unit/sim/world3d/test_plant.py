"""The rigid robot: at rest, on its springs, driving, against walls and things, on uneven ground."""

from math import atan, degrees, pi

import numpy as np
import pytest

from monstertruck_kinematics.description import WHEELS
from monstertruck_kinematics.linkage import common_motion
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import (
    GroundTilt,
    MechanicsConfig,
    RoughPatch,
    SimTruckConfig,
    SinusoidTilt,
    SteadyTilt,
    WorldConfig,
)
from monstertruck_sim.world.obstacles import Box, Disc
from monstertruck_sim.world.world import World

SECOND = 1_000_000_000


def plant(driver):
    return driver.world._plant


def test_at_rest_it_stands_on_its_springs_with_every_joint_at_zero(solid):
    driver = solid()
    driver.wait(2.0)
    data = plant(driver).data
    for joint in ("suspension", "roll"):
        assert abs(data.joint(f"front_{joint}").qpos[0]) < 1e-4
        assert abs(data.joint(f"rear_{joint}").qpos[0]) < 1e-4
    assert data.qpos[2] == pytest.approx(0.0, abs=1e-3)
    truth = driver.wait(3.0)
    assert (truth.x, truth.y, truth.yaw) == pytest.approx((0.0, 0.0, 0.0), abs=1e-4)
    assert (truth.pitch, truth.roll) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert not truth.stuck


def test_a_load_makes_it_sag_as_its_springs_say(solid):
    driver = solid()
    before = plant(driver).data.qpos[2]
    plant(driver).data.xfrc_applied[plant(driver).model.body("base").id, 2] = -20.0
    driver.wait(3.0)
    expected = 20.0 / (2 * plant(driver).model.joint("front_suspension").stiffness[0])
    tyres = plant(driver).data.qpos[2] - before + expected
    assert before - plant(driver).data.qpos[2] == pytest.approx(expected, rel=0.03), tyres


def test_it_drives_as_the_plane_does(solid, field):
    driver, flat = solid(), field()
    for each in (driver, flat):
        each.drive(0.2)
        each.wait(2.0)
        each.steer(0.3, -0.3)
    rigid, plane = driver.wait(8.0), flat.wait(8.0)
    assert rigid.v == pytest.approx(plane.v, rel=0.03)
    assert 0.93 * plane.wz < rigid.wz < plane.wz
    assert (rigid.front, rigid.rear) == (plane.front, plane.rear)
    for each in (driver, flat):
        each.drive(0.0)
    assert driver.wait(2.0).v == pytest.approx(0.0, abs=1e-3)


def test_two_runs_are_the_same_and_what_is_asked_in_between_changes_nothing(solid):
    def run(looks):
        driver = solid()
        driver.drive(0.2)
        driver.steer(0.2, -0.1)
        for look in looks:
            driver.world.lidar.scan(driver.now + look)
        return driver.wait(1.0)[1:]

    assert run([]) == run([1_000_000, 3_500_000, 3_600_000, 450_000_000])


def test_no_step_is_taken_ahead_of_a_command(solid):
    """A speed commanded within a step is in force in it, whoever has looked before."""
    seen, unseen = solid(), solid()
    seen.world.truth(seen.now + 5_900_000)
    for driver in (seen, unseen):
        driver.now += 5_900_000
        driver.drive(0.2)
    assert seen.wait(0.1)[1:] == unseen.wait(0.1)[1:]


def test_a_wall_stops_it_and_its_clutch_slips(solid):
    driver = solid(walls=[(1.0, -2.0, 1.2, 2.0)])
    driver.drive(0.2)
    truth = driver.wait(8.0)
    assert truth.stuck
    assert truth.clutch_slipping
    assert truth.x == pytest.approx(1.0 - 0.235, abs=0.01)
    data = plant(driver).data
    assert data.actuator_force[-1] == pytest.approx(25.0 * 0.075)
    driver.drive(-0.2)
    assert not driver.wait(2.0).stuck


def test_a_lifted_wheel_spins_and_the_others_stand(solid):
    """Open differentials: what carries nothing gets all the turning."""
    driver = solid()
    rigid = plant(driver)
    rigid.data.xfrc_applied[rigid.model.body("base").id, :3] = 0.0, 0.0, 0.99 * 7.25 * 9.81
    driver.drive(0.2)
    driver.wait(2.0)
    spins = [rigid.data.joint(f"{wheel}_spin").qvel[0] for wheel in ("front_left", "front_right")]
    assert np.mean(spins) == pytest.approx(0.2 / 0.075, rel=0.05)


def test_tyres_give_way_sideways_and_rigid_wheels_turn_less(solid):
    """Least squares of side slips for tyres of one stiffness; dry friction alone takes the least sum of slips."""
    linkage = SimTruckConfig().chassis().linkage
    angles = linkage.wheel_angles(*SteeringPolynomials().servo_from_axles(0.35, 0.0))
    slide, turn, _ = common_motion(FourWheelSteering(), angles)
    curvature = {}
    for stiffness in (60.0, 0.0):
        driver = solid(mechanics=MechanicsConfig(tyre_stiffness=stiffness))
        driver.steer(0.35, 0.0)
        driver.drive(0.2)
        truth = driver.wait(3.0)
        curvature[stiffness] = truth.wz / truth.v / (turn / np.hypot(1.0, slide))
    assert 0.95 < curvature[60.0] < 1.0
    assert curvature[0.0] < 0.94


def test_a_standing_robot_holds_on_a_slope(solid):
    """A tyre that stands does not give way; the engine's friction creeps by less than 1 mm/s."""
    driver = solid()
    plant(driver).model.opt.gravity[:] = 0.0, 9.81 * np.sin(0.3), -9.81 * np.cos(0.3)
    driver.wait(1.0)
    y = driver.wait(0.5).y
    assert 0.001 < y < 0.02
    assert driver.wait(1.0).y == pytest.approx(y, abs=1e-3)


def test_both_axles_turn_alike(solid):
    driver = solid()
    driver.steer(0.4, 0.0)
    driver.drive(0.2)
    driver.wait(4.0)
    rate = {name: plant(driver).data.joint(f"{name}_spin").qvel[0] for name in WHEELS}
    front, rear = (rate[f"{axle}_left"] + rate[f"{axle}_right"] for axle in ("front", "rear"))
    assert front == pytest.approx(rear, rel=0.01)
    assert rate["front_right"] > 1.1 * rate["front_left"]


def test_standing_scans_are_those_of_the_plane():
    rigid, plane = (World(WorldConfig(engine=engine, noise=False), 1) for engine in ("mujoco", "plane"))
    assert (abs(rigid.lidar.scan(0) - plane.lidar.scan(0)) <= 1).mean() > 0.999


def test_what_is_put_into_the_world_is_seen_and_stops_it(solid):
    driver = solid()
    disc, box = Disc(1.0, 0.0, 0.1), Box(-1.0, 0.0, 0.2, 0.6, pi / 4)
    driver.world.add(driver.now, disc)
    driver.world.add(driver.now, box)
    assert driver.world.obstacles == (disc, box)
    assert driver.world.lidar.scan(driver.now)[384] == pytest.approx(900 - 140, abs=1)
    driver.drive(0.2)
    truth = driver.wait(6.0)
    assert truth.stuck
    assert truth.x == pytest.approx(0.9 - 0.19, abs=0.02)  # the bodywork meets it between the wheels
    driver.world.remove(driver.now, disc)
    driver.wait(2.0)
    assert driver.wait(1.0).x > 1.1
    with pytest.raises(InputError, match="not in the world"):
        driver.world.remove(driver.now, disc)


def test_no_more_is_put_into_it_than_there_is_room_for(solid):
    driver = solid()
    for i in range(24):
        driver.world.add(driver.now, Disc(3.0, 0.1 * i, 0.02))
    with pytest.raises(InputError, match="maximum of 24 of kind disc"):
        driver.world.add(driver.now, Disc(3.0, -1.0, 0.02))


def test_a_carried_robot_stands_elsewhere_at_rest(solid):
    driver = solid()
    driver.drive(0.2)
    driver.wait(2.0)
    driver.drive(0.0)
    driver.wait(1.0)
    driver.world.carry(driver.now, (-2.0, 1.0, pi / 2))
    truth = driver.wait(1.0)
    assert (truth.x, truth.y, truth.yaw) == pytest.approx((-2.0, 1.0, pi / 2), abs=0.02)


def test_things_stay_where_they_are_while_the_robot_is_carried(solid):
    driver = solid()
    driver.world.add(driver.now, Box(1.0, 0.0, 0.2, 1.0))
    driver.wait(0.1)
    driver.world.carry(driver.now, (0.3, 0.0, 0.0))
    driver.drive(0.2)
    assert driver.wait(5.0).x == pytest.approx(0.9 - 0.235, abs=0.01)


def test_the_robot_of_the_built_in_ramp_tilts_by_its_slope():
    world = World(WorldConfig(engine="mujoco", map="ramp", noise=False, start=Pose2D(x=1.75, y=0.0, yaw=0.0)), 1)
    truth = world.truth(0)
    assert degrees(-truth.pitch) == pytest.approx(8.0, abs=0.4)
    scan, plane = (
        World(WorldConfig(engine=engine, map="ramp", noise=False), 1).lidar.scan(0) for engine in ("mujoco", "plane")
    )
    assert (abs(scan - plane) <= 30).mean() > 0.98


def test_springs_level_a_little_of_a_side_slope(solid):
    """On a slope of rough ground the body rolls further than the ground: its mass is above the springs."""
    driver = solid(rough=(RoughPatch(x=0.0, y=0.0, length=6.0, width=6.0, height=0.4, wavelength=6.0),))
    truth = driver.world.truth(driver.now)
    slope = atan(0.2 * 2 * pi / 6.0)
    assert abs(truth.pitch) == pytest.approx(slope, rel=0.15)


def test_gravity_and_motion_are_what_imu_and_compass_feel(solid):
    driver = solid()
    driver.wait(1.0)
    reading = driver.world.imu.imu(driver.now)
    assert reading.acceleration == pytest.approx((0.0, 0.0, 9.81), abs=1e-3)
    driver.drive(0.2, 5000.0)
    felt = []
    for _ in range(30):
        driver.wait(0.02)
        felt.append(driver.world.imu.imu(driver.now).acceleration[0])
    assert 0.05 < max(felt) < 1.0
    driver.steer(0.3, -0.3)
    driver.wait(4.0)
    assert driver.world.imu.imu(driver.now).angular_velocity[2] == pytest.approx(
        driver.world.truth(driver.now).wz, abs=1e-4
    )


def test_a_car_turns_by_its_front_wheels_and_is_driven_by_the_rear_ones(solid):
    car = SimTruckConfig.model_validate({"body": {"kind": "ackermann"}})
    driver = solid(truck=car)
    driver.steer(0.3, 0.3)
    driver.drive(0.2)
    driver.wait(3.0)
    truth = driver.wait(2.0)
    expected = np.tan(truth.front) / 0.32  # of the rear axle's middle
    assert truth.wz / truth.v == pytest.approx(expected / np.hypot(1.0, 0.16 * expected), rel=0.02)
    data = plant(driver).data
    assert data.joint("rear_left_steer").qpos[0] == pytest.approx(0.0, abs=0.01)
    assert data.joint("front_left_steer").qpos[0] > data.joint("front_right_steer").qpos[0] + 0.02


@pytest.mark.parametrize("motors", ["sides", "wheels"])
def test_a_skid_steer_robot_turns_on_the_spot_by_skidding(solid, motors):
    driver = solid(truck=SimTruckConfig.model_validate({"body": {"kind": "skid_steer", "motors": motors}}))
    left = (0,) if motors == "sides" else (0, 2)
    for i, motor in enumerate(driver.world.motors):
        speed = -0.15 if i in left else 0.15
        motor.command(driver.now, -speed * 644 / (2 * pi * 0.075) * 60, 20_000.0)
    driver.wait(2.0)
    truth = driver.wait(2.0)
    assert 0.2 < truth.wz < 2 * 0.15 / 0.26  # less than without skidding
    assert (truth.x, truth.y) == pytest.approx((0.0, 0.0), abs=0.05)
    rate = [plant(driver).data.joint(f"{wheel}_spin").qvel[0] for wheel in WHEELS]
    assert rate[1] == pytest.approx(0.15 / 0.075, rel=0.1)
    assert rate[0] == pytest.approx(-rate[1], rel=0.1)


@pytest.mark.parametrize(
    ("body", "speeds"),
    [
        ({"kind": "differential"}, (0.1, 0.2)),
        ({"kind": "mecanum"}, (-0.2, 0.2, 0.2, -0.2)),
        ({"kind": "mecanum"}, (0.0, 0.2, 0.0, 0.2)),
        ({"kind": "omni", "circle": 0.15}, (0.1, -0.1, 0.2)),
        ({"kind": "omni", "circle": 0.15, "count": 4}, (0.2, 0.2, -0.1, -0.1)),
    ],
)
def test_a_platform_moves_as_its_wheels_say(solid, body, speeds):
    truck = SimTruckConfig.model_validate({"body": body})
    driver = solid(truck=truck)
    for motor, speed in zip(driver.world.motors, speeds, strict=True):
        motor.command(driver.now, -speed * 644 / (2 * pi * 0.075) * 60, 20_000.0)
    driver.wait(1.6)
    expected = truck.chassis().predicted(speeds)
    assert plant(driver).twist == pytest.approx(expected, rel=0.03, abs=0.003)
    truth = driver.wait(0.5)
    assert (truth.pitch, truth.roll) == pytest.approx((0.0, 0.0), abs=0.002)


def test_a_wheel_with_rollers_holds_along_their_axis_by_friction_only(solid):
    """On a side slope wheels that stand hold a mecanum robot; pushed harder than friction holds, it slides."""
    driver = solid(truck=SimTruckConfig.model_validate({"body": {"kind": "mecanum"}}))
    rigid = plant(driver)
    base = rigid.model.body("base").id
    rigid.data.xfrc_applied[base, 1] = 0.6 * 0.5 * 7.25 * 9.81 / 2**0.5
    driver.wait(1.0)
    assert abs(rigid.pose[1]) < 0.01
    rigid.data.xfrc_applied[base, 1] = 0.5 * 7.25 * 9.81 * 1.2
    driver.wait(1.0)
    assert rigid.pose[1] > 0.1


def test_a_platform_is_stopped_by_a_wall(solid):
    driver = solid(walls=[(1.0, -2.0, 1.2, 2.0)], truck=SimTruckConfig.model_validate({"body": {"kind": "mecanum"}}))
    for motor in driver.world.motors:
        motor.command(driver.now, -0.3 * 644 / (2 * pi * 0.075) * 60, 20_000.0)
    truth = driver.wait(4.0)
    assert truth.stuck
    assert truth.x == pytest.approx(1.0 - 0.235, abs=0.01)


class Shafts:
    """Of a stabiliser, at fixed angles; that of pitch may turn at a rate from the start on."""

    def __init__(self, pitch, roll, rate=0.0):
        self.pitch, self.roll, self.rate = pitch, roll, rate

    def angles(self, times_ns):
        return self.pitch + self.rate * times_ns / 1e9, np.full(len(times_ns), self.roll)


def test_the_lidar_follows_the_shafts_of_its_mount_and_its_weight_pushes_them(solid):
    driver = solid()
    driver.world.carry_lidar(Shafts(0.3, -0.2))
    driver.wait(1.0)
    data = plant(driver).data
    assert data.joint("lidar_pitch").qpos[0] == pytest.approx(0.3, abs=0.002)
    assert data.joint("lidar_roll").qpos[0] == pytest.approx(-0.2, abs=0.002)
    weight = 0.16 * 9.81 * 0.02  # of the lidar, above the joints: it wants to fall further
    assert driver.world.mount_torque(0) == pytest.approx(weight * np.sin(0.3) * np.cos(0.2), rel=0.05)
    assert driver.world.mount_torque(1) == pytest.approx(-weight * np.cos(0.3) * np.sin(0.2), rel=0.05)


def test_the_lidar_does_not_trail_a_shaft_that_turns(solid):
    driver = solid()
    shafts = Shafts(-0.5 * driver.now / 1e9, 0.0, 0.5)
    driver.world.carry_lidar(shafts)
    driver.wait(0.3)
    joint = plant(driver).data.joint("lidar_pitch")
    assert joint.qvel[0] == pytest.approx(0.5, abs=0.01)
    assert joint.qpos[0] == pytest.approx(0.15, abs=0.003)


def test_the_mount_of_the_plane_feels_nothing(field):
    driver = field()
    driver.world.carry_lidar(Shafts(0.3, -0.2))
    assert driver.world.mount_torque(0) == 0.0


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (
            {"truck": {"body": {"kind": "synchro"}}},
            "does not support body synchro; expected one of truck, ackermann, skid_steer, differential, omni, mecanum",
        ),
        ({"tilt": {"kind": "sinusoid"}}, "tilt sinusoid: not supported"),
    ],
)
def test_what_the_engine_cannot_do_is_refused(config, text):
    with pytest.raises(ValueError, match=text):
        WorldConfig.model_validate({"engine": "mujoco", **config})


def test_nothing_rocks_it(solid):
    driver = solid()
    with pytest.raises(InputError, match="tilt sinusoid: not supported"):
        driver.world.set_tilt(driver.now, SinusoidTilt(kind="sinusoid"))


@pytest.mark.parametrize(("pitch", "roll"), [(9.0, 0.0), (0.0, 11.0), (-6.0, -6.0)])
def test_on_blocks_it_leans_as_high_as_they_are_and_stands(solid, pitch, roll):
    driver = solid(start=(1.0, 0.5, 0.7))
    driver.world.set_tilt(driver.now, SteadyTilt(kind="steady", pitch_deg=pitch, roll_deg=roll))
    before = driver.wait(1.0)
    truth = driver.wait(1.0)
    assert (degrees(truth.pitch), degrees(truth.roll)) == pytest.approx((pitch, roll), abs=0.8), "its springs give"
    assert (truth.x, truth.y, truth.yaw) == pytest.approx((before.x, before.y, before.yaw), abs=1e-4)
    assert (truth.x, truth.y) == pytest.approx((1.0, 0.5), abs=0.02), "let go it settles on its springs"
    driver.world.set_tilt(driver.now, GroundTilt())
    truth = driver.wait(1.0)
    assert (truth.pitch, truth.roll) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_it_drives_off_the_blocks_that_it_began_on(solid):
    driver = solid(tilt=SteadyTilt(kind="steady", pitch_deg=9.0))
    assert degrees(driver.wait(0.5).pitch) > 8.0
    driver.drive(0.3)
    truth = driver.wait(3.0)
    assert abs(degrees(truth.pitch)) < 0.5
    assert truth.x > 0.5


def test_without_blocks_a_tilt_of_zero_does_not_stop_it(solid):
    driver = solid()
    driver.drive(0.3)
    driver.wait(1.5)
    driver.world.set_tilt(driver.now, GroundTilt())
    assert driver.world.truth(driver.now).v == pytest.approx(0.3, abs=0.02)


def test_blocks_on_which_it_cannot_stand_are_refused_and_it_stays_where_it_was(solid):
    driver = solid()
    with pytest.raises(InputError, match="falls off blocks that tilt it by pitch 0 deg and roll 80 deg"):
        driver.world.set_tilt(driver.now, SteadyTilt(kind="steady", roll_deg=80.0))
    truth = driver.wait(0.5)
    assert (truth.x, truth.y, truth.pitch, truth.roll) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-3)


def test_people_walk_into_it_and_are_felt():
    person = {"waypoints": [{"x": 2.0, "y": 0.0}, {"x": -2.0, "y": 0.0}], "before": "walk_on", "pause": 0.0}
    config = WorldConfig.model_validate(
        {
            "engine": "mujoco",
            "map": "yard",
            "noise": False,
            "people": [person],
            "start": {"x": 0.0, "y": 0.0, "yaw": 0.0},
        }
    )
    world = World(config, 1)
    world.motors[0].command(0, -0.2 * 644 / (2 * pi * 0.075) * 60, 20_000.0)
    for t in range(1, 60):
        world.truth(t * SECOND // 10)
    assert world.scene.contacts


def test_a_heavier_load_is_refused_where_no_body_is_left():
    with pytest.raises(InputError, match="expected more than the wheels and axles"):
        World(WorldConfig(engine="mujoco", mechanics=MechanicsConfig(wheel_mass=2.0)), 1)
