"""Physics of the truck: distances, radii, lags, clutch, collisions, battery."""

from math import atan, cos, degrees, hypot, pi, radians, sin

import numpy as np
import pytest

from monstertruck_kinematics.linkage import common_motion
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.battery import BatteryModel, rest_voltage
from monstertruck_sim.world.config import (
    BatteryModelConfig,
    MotorConfig,
    ServoModelConfig,
    SimTruckConfig,
    SinusoidTilt,
)
from monstertruck_sim.world.obstacles import Box, Disc

IDEAL = SimTruckConfig(front_slip_angle=0, rear_slip_angle=0, slip_per_newton=0)
ROLLED_PER_TURN = 2 * pi * 0.075 / 644


def test_straight_distance_is_motor_turns_through_the_ratio(field):
    driver = field(truck=IDEAL)
    driver.steer(0.0, 0.0)
    driver.wait(0.5)
    driver.drive(0.2)
    driver.wait(5)
    driver.drive(0.0)
    truth = driver.wait(2)
    turns = -driver.world.motors[0].reading(driver.now).turns
    assert truth.v == pytest.approx(0, abs=1e-6)
    assert hypot(truth.x, truth.y) == pytest.approx(turns * ROLLED_PER_TURN, rel=2e-4)
    assert truth.x == pytest.approx(1.0, rel=0.01)
    assert abs(truth.yaw) < 0.01  # pulses are measured in whole microseconds


@pytest.mark.parametrize(("front", "rear"), [(0.3, 0.0), (0.3, -0.3), (-0.25, 0.25), (0.35, -0.1)])
@pytest.mark.parametrize("speed", [0.2, -0.2])
def test_circle_has_the_radius_of_the_wheels_common_motion(field, front, rear, speed):
    exact = ServoModelConfig(channel=1, dead_band_us=0, resolution_us=0.001)
    servos = {"front_servo": exact, "rear_servo": exact.model_copy(update={"channel": 0})}
    driver = field(truck=IDEAL.model_copy(update=servos))
    driver.steer(front, rear)
    driver.drive(speed)
    begin = driver.wait(2)
    end = driver.wait(3)
    linkage = SteeringPolynomials()
    wheels = [
        angle
        for axle, servo in zip((linkage.front, linkage.rear), linkage.servo_from_axles(front, rear), strict=True)
        for angle in axle.wheels_from_servo(servo)
    ]
    slide, turn, _ = common_motion(FourWheelSteering(), tuple(wheels))
    assert np.tan([begin.front, begin.rear]) == pytest.approx([slide + 0.16 * turn, slide - 0.16 * turn], abs=1e-6)
    turned = (end.yaw - begin.yaw + pi) % (2 * pi) - pi
    chord = hypot(end.x - begin.x, end.y - begin.y)
    radius = 1 / (turn * cos(atan(slide)))
    assert chord == pytest.approx(2 * abs(radius) * sin(abs(turned) / 2), rel=1e-5)
    assert np.sign(turned) == np.sign(radius) * np.sign(speed)
    assert end.v == pytest.approx(end.wz * radius, rel=1e-5)


def test_counter_steer_is_slower_than_its_wheels(field):
    """The motor turns with the mean of the four wheels, which the body drags along larger circles than its centre."""
    driver = field(truck=IDEAL)
    driver.steer(0.4, -0.4)
    driver.drive(0.2)
    truth = driver.wait(3)
    assert truth.v == pytest.approx(0.2 / 1.069, rel=1e-3)


def test_crab_does_not_turn(field):
    driver = field(truck=IDEAL)
    driver.steer(0.3, 0.3)
    driver.drive(0.2)
    driver.wait(1)
    begin = driver.wait(1)
    end = driver.wait(2)
    assert abs(end.yaw - begin.yaw) < 0.01
    assert np.arctan2(end.y - begin.y, end.x - begin.x) == pytest.approx(0.3 + begin.yaw, abs=0.01)
    assert end.v == pytest.approx(0.2, rel=1e-3)


def test_ramp_and_lags(field):
    driver = field(truck=IDEAL)
    driver.drive(0.2, acceleration=17_057.0)  # 0.2 m/s in about a second
    driver.wait(0.5)
    reading = driver.world.motors[0].reading(driver.now)
    truth = driver.world.truth(driver.now)
    assert reading.demand_rpm == pytest.approx(-8528.5, rel=1e-3)
    assert abs(reading.demand_rpm) > abs(reading.rpm) > 0.9 * abs(reading.demand_rpm)
    assert 0.05 < truth.v < abs(reading.rpm) * ROLLED_PER_TURN / 60
    driver.drive(None)
    assert driver.wait(1.5).v == pytest.approx(0, abs=1e-4)
    assert driver.world.motors[0].reading(driver.now).current_ma == 0


def test_servo_rate_and_limit(field):
    driver = field()
    driver.pulses = {0: 1439.2, 1: 1439.2 - 10.48 * 60}  # beyond the 45 degree stop
    early, late = driver.wait(0.05), driver.wait(1)
    assert 0.1 < early.front < 0.7 * late.front
    assert radians(25) < late.front < radians(30)
    assert late.rear == pytest.approx(0.0, abs=0.02)


def test_servo_dead_band_and_no_pulses(field):
    driver = field()
    driver.pulses = {0: 1439.2, 1: 1339.0}
    before = driver.wait(1).front
    driver.pulses[1] = 1337.6
    assert driver.wait(1).front == before
    driver.pulses[1] = 1330.0
    assert driver.wait(1).front > before
    driver.pulses[1] = None
    held = driver.wait(1).front
    driver.pulses[1] = None
    assert driver.wait(1).front == held


def test_hidden_calibration_bends_the_straight_line(field):
    off = IDEAL.model_copy(update={"front_servo": ServoModelConfig(channel=1, centre_us=1449.2)})
    driver = field(truck=off)
    driver.steer(0.0, 0.0)
    driver.drive(0.2)
    assert driver.wait(3).yaw > 0.015  # the nominal centre is 10 us too low: to the left


def test_a_stop_of_the_servo_ends_its_travel_on_one_side(field):
    off = IDEAL.model_copy(update={"front_servo": ServoModelConfig(channel=1, left_stop_deg=20.0)})
    driver = field(truck=off)
    driver.steer(0.4, 0.0)
    assert degrees(driver.wait(1).front) == pytest.approx(13.0, abs=0.5)
    driver.steer(-0.4, 0.0)
    assert driver.wait(1).front == pytest.approx(-0.39, abs=0.005)


def test_tyres_understeer(field):
    turned = []
    for truck in (IDEAL, SimTruckConfig()):
        driver = field(truck=truck)
        driver.steer(0.35, -0.35)
        driver.drive(0.2)
        turned.append(driver.wait(4).yaw)
    assert 0.9 * turned[0] < turned[1] < 0.999 * turned[0]


def test_slip_is_noisy_with_noise_only(field):
    ends = []
    for seed in (1, 2, 1):
        driver = field(noise=True, seed=seed)
        driver.steer(0.0, 0.0)
        driver.drive(0.2)
        truth = driver.wait(10)
        ends.append((truth.x, truth.y, truth.yaw))
    assert ends[0] == ends[2] != ends[1]
    assert abs(ends[0][1]) < 0.2


def test_reading_often_changes_nothing_but_rounding(field):
    ends = []
    for period in (1.0, 0.013):
        driver = field(noise=True)
        driver.steer(0.2, -0.1)
        driver.drive(0.2)
        for _ in range(round(3 / period)):
            driver.wait(period)
        driver.now = 10_000_000_000
        truth = driver.world.truth(driver.now)
        ends.append((truth.x, truth.y, truth.yaw))
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)


def test_wall_stops_the_body_and_the_clutch_slips(field):
    driver = field(walls=[(0.8, -2, 0.9, 2)])
    driver.steer(0.0, 0.0)
    driver.drive(0.2)
    driver.wait(5)
    turns = driver.world.motors[0].reading(driver.now).turns
    before = driver.world.truth(driver.now)
    after = driver.wait(2)
    reading = driver.world.motors[0].reading(driver.now)
    assert after.stuck
    assert after.clutch_slipping
    assert after.x == pytest.approx(before.x, abs=1e-4) == pytest.approx(0.8 - 0.235, abs=2e-3)
    assert (reading.turns - turns) * -ROLLED_PER_TURN == pytest.approx(0.4, rel=0.01)
    assert abs(reading.current_ma) > 400
    assert after.v == 0


def test_stuck_stays_stuck_until_backed_out(field):
    driver = field(walls=[(0.8, -2, 0.9, 2)])
    driver.steer(0.0, 0.0)
    driver.drive(0.2)
    stuck = driver.wait(5)
    driver.drive(0.0)
    assert driver.wait(2).stuck
    driver.steer(0.3, -0.3)  # turning into the wall does not help
    driver.drive(0.2)
    still = driver.wait(2)
    assert still.stuck
    assert hypot(still.x - stuck.x, still.y - stuck.y) < 0.005
    driver.drive(-0.2)
    free = driver.wait(2)
    assert not free.stuck
    assert free.x < stuck.x - 0.1


def test_no_step_tunnels_through_a_thin_wall(field):
    driver = field(walls=[(0.8, -2, 0.85, 2)])
    driver.drive(0.22)
    driver.wait(0)
    assert driver.wait(30).x < 0.8


def test_clutch_slips_when_pulled_too_hard(field):
    weak = MotorConfig(clutch_force=6.0)
    driver = field(truck=IDEAL.model_copy(update={"motor": weak}))
    driver.drive(0.2, acceleration=1e6)
    early = driver.wait(0.1)
    assert early.clutch_slipping
    late = driver.wait(3)
    assert not late.clutch_slipping
    assert late.v == pytest.approx(0.2, rel=1e-3)
    turns = -driver.world.motors[0].reading(driver.now).turns
    assert turns * ROLLED_PER_TURN - late.x > 0.005


def test_obstacles_stop_and_free_the_truck(field):
    driver = field()
    disc, box = Disc(1.0, 0.1, 0.2), Box(-1.0, 0.0, 0.4, 0.4, yaw=0.3)
    driver.world.add(driver.now, disc)
    driver.world.add(driver.now, box)
    assert driver.world.obstacles == (disc, box)
    driver.drive(0.2)
    truth = driver.wait(8)
    assert truth.stuck
    assert truth.x == pytest.approx(1.0 - 0.2 - 0.235, abs=0.003)
    driver.drive(-0.2)
    truth = driver.wait(10)
    assert truth.stuck
    assert -0.62 < truth.x < -0.5
    driver.world.remove(driver.now, box)
    truth = driver.wait(5)
    assert not truth.stuck
    assert truth.x < -1


def test_an_obstacle_put_onto_the_truck_can_only_be_left(field):
    driver = field()
    driver.world.add(driver.now, Disc(0.3, 0.0, 0.2))
    driver.drive(0.2)
    assert driver.wait(1).stuck
    driver.drive(-0.2)
    truth = driver.wait(3)
    assert not truth.stuck
    assert truth.x < -0.2


def test_climbing_costs_current(field):
    flat, climbing = field(), field(tilt=SinusoidTilt(kind="sinusoid", pitch_deg=-12, frequency=0.05))
    currents = []
    for driver in (flat, climbing):
        driver.drive(0.15)
        driver.wait(5)  # the slope's peak
        currents.append(-driver.world.motors[0].reading(driver.now).current_ma)
    assert currents[1] > currents[0] + 150


def test_battery_counts_coulombs_and_sags():
    config = BatteryModelConfig(charge=0.8, electronics_w=24.12)
    battery = BatteryModel(config)
    assert rest_voltage(1.0, 6) == pytest.approx(25.2)
    assert rest_voltage(0.0, 6) == pytest.approx(19.62)
    idle = battery.volts
    assert idle == pytest.approx(24.12 - 1.0 * 0.08)
    for _ in range(3600):
        battery.step(0.1, 100.0)
    assert battery.charge == pytest.approx(0.8 - 0.1 * 124.12 / 23.2 / 5.0, abs=0.003)
    loaded = battery.volts
    assert loaded < rest_voltage(battery.charge, 6) - 5 * 0.11
    assert battery.analog_volts == pytest.approx(loaded / 10, abs=0.01)
    battery.step(0.1, 0.0)
    at_once = battery.volts
    for _ in range(1000):
        battery.step(0.1, 0.0)
    assert loaded + 0.3 < at_once < battery.volts - 0.1  # part recovers at once, part slowly


def test_battery_reaches_the_analog_input_and_can_be_exchanged(field):
    driver = field()
    assert driver.world.servos.analog_volts(5, driver.now) == pytest.approx(rest_voltage(0.95, 6) / 10, abs=0.02)
    assert driver.world.servos.analog_volts(4, driver.now) == 0
    driver.world.set_charge(driver.now, 0.1)
    truth = driver.wait(1)
    assert driver.world.servos.analog_volts(5, driver.now) == pytest.approx(truth.supply_v / 10, abs=0.001)
    assert truth.supply_v < 22.2
    assert driver.world.motors[0].reading(driver.now).supply_v == truth.supply_v


def test_contact_is_tested_whenever_something_is_near(field):
    """Free room that is known spares tests, never a contact."""
    world = field(walls=[(0.85, -2, 0.9, 2), (-2, 0.3, 2, 0.35)]).world
    t = np.linspace(0, 20, 3000)
    poses = np.stack([0.5 + 0.2 * np.sin(t), 0.1 * np.cos(0.7 * t), 0.3 * t], axis=1).tolist()
    depths = [world._space.contact(*pose) for pose in poses]
    assert depths == [world._footprint._depth(tuple(pose)) for pose in poses]
    assert 300 < np.count_nonzero(depths) < 2700


def test_an_obstacle_put_beside_the_truck_is_felt_at_once(field):
    world = field().world
    assert world._space.contact(0.0, 0.0, 0.0) == 0.0
    world.add(0, Disc(0.3, 0.0, 0.1))
    assert world._space.contact(0.0, 0.0, 0.0) == pytest.approx(0.1 - (0.3 - 0.235))


@pytest.mark.parametrize(
    ("charge", "cell"), [(-0.1, 3.27), (0.0, 3.27), (0.025, 3.44), (0.5, 3.84), (1.0, 4.2), (1.1, 4.2)]
)
def test_rest_voltage_is_straight_between_the_tables_points(charge, cell):
    assert rest_voltage(charge, 6) == pytest.approx(6 * cell)
    assert rest_voltage(charge, 3) == pytest.approx(3 * cell)


def test_a_carried_truck_stands_elsewhere_and_its_lidar_sees_no_way_between(field):
    driver = field(truck=IDEAL, walls=[(3.0, -6.0, 3.2, 6.0)])
    driver.drive(0.2)
    driver.wait(2)
    before = driver.world.motors[0].reading(driver.now).turns
    driver.world.carry(driver.now, (-2.0, 1.0, pi / 2))
    truth = driver.world.truth(driver.now)
    assert (truth.x, truth.y, truth.yaw, truth.v) == (-2.0, 1.0, pi / 2, 0.0)
    driver.now += 50_000_000  # half a revolution before, half after
    ranges = driver.world.lidar.scan(driver.now - 100_000_000)
    assert ranges[384 - 256] / 1000 == pytest.approx(5.0, abs=0.02)
    assert driver.wait(3).y > 1.4, "the motor turns on"
    assert driver.world.motors[0].reading(driver.now).turns < before


@pytest.mark.parametrize("pose", [(3.1, 0.0, 0.0), (1.0, 1.0, 0.0)])
def test_a_truck_is_not_carried_into_things(field, pose):
    driver = field(walls=[(3.0, -6.0, 3.2, 6.0)])
    driver.world.add(driver.now, Disc(1.0, 1.0, 0.1))
    with pytest.raises(InputError, match="carry"):
        driver.world.carry(driver.now, pose)
    assert driver.world.truth(driver.now).x == 0.0
