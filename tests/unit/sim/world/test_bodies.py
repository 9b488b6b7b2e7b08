"""Physics of bodies other than the truck, and of tyres with the body's inertia behind them."""

from math import hypot, pi, tan

import pytest
from pydantic import ValidationError

from monstertruck_schemas.body import (
    AckermannBody,
    DifferentialBody,
    MecanumBody,
    OmniBody,
    SkidSteerBody,
    SynchroBody,
    TricycleBody,
)
from monstertruck_sim.world.config import ServoModelConfig, SimTruckConfig

EXACT = ServoModelConfig(channel=1, dead_band_us=0, resolution_us=0.001)
IDEAL = {
    "front_slip_angle": 0.0,
    "rear_slip_angle": 0.0,
    "slip_per_newton": 0.0,
    "front_servo": EXACT,
    "rear_servo": EXACT.model_copy(update={"channel": 0}),
}
RPM_PER_SPEED = 644 / (2 * pi * 0.075) * 60


def roll(driver, *speeds, seconds=2.0):
    """Every shaft at its wheel speed until it is steady, then two instants ``seconds`` apart."""
    for motor, speed in zip(driver.world.motors, speeds, strict=True):
        motor.command(driver.now, -speed * RPM_PER_SPEED, 50_000)
    return driver.wait(1.5), driver.wait(seconds)


def test_a_differential_drive_goes_round_between_its_wheels(field):
    begin, end = roll(field(truck=SimTruckConfig(body=DifferentialBody(kind="differential"), **IDEAL)), 0.1, 0.2)
    assert begin.wz == pytest.approx(0.1 / 0.26, rel=1e-3)
    assert end.v == pytest.approx(0.15, rel=1e-3)
    assert (end.yaw - begin.yaw) % (2 * pi) == pytest.approx(2 * 0.1 / 0.26, rel=2e-3)


def test_opposite_wheels_turn_it_on_the_spot(field):
    begin, end = roll(field(truck=SimTruckConfig(body=DifferentialBody(kind="differential"), **IDEAL)), -0.1, 0.1)
    assert hypot(end.x, end.y) < 0.002
    assert begin.wz == pytest.approx(0.2 / 0.26, rel=1e-3)


def test_skidding_turns_slower_than_rolling(field):
    body = SkidSteerBody(kind="skid_steer", icr_left=0.2, icr_right=-0.2, icr_x=-0.05)
    begin, _ = roll(field(truck=SimTruckConfig(body=body, **IDEAL)), 0.1, 0.2)
    assert begin.wz == pytest.approx(0.1 / 0.4, rel=1e-3)
    assert begin.v == pytest.approx(hypot(0.15, 0.05 * 0.25), rel=1e-3)


def test_mecanum_wheels_against_each_other_slide_sideways(field):
    begin, end = roll(field(truck=SimTruckConfig(body=MecanumBody(kind="mecanum"), **IDEAL)), -0.1, 0.1, 0.1, -0.1)
    assert (end.x - begin.x, end.y - begin.y) == pytest.approx((0.0, 0.2), abs=0.002)
    assert end.yaw == pytest.approx(0.0, abs=1e-3)


def test_equal_omni_wheels_turn_about_the_middle(field):
    begin, end = roll(field(truck=SimTruckConfig(body=OmniBody(kind="omni", circle=0.2), **IDEAL)), 0.1, 0.1, 0.1)
    assert begin.wz == pytest.approx(0.1 / 0.2, rel=1e-3)
    assert hypot(end.x, end.y) < 0.002


@pytest.mark.parametrize(
    ("body", "speed"),
    [(AckermannBody(kind="ackermann"), 0.2), (TricycleBody(kind="tricycle", driven="rear"), 0.2)],
    ids=["ackermann", "tricycle"],
)
def test_a_car_ignores_its_rear_servo(field, body, speed):
    driver = field(truck=SimTruckConfig(body=body, **IDEAL))
    driver.steer(0.3, 0.3)
    begin, _ = roll(driver, speed)
    assert begin.rear == 0.0
    assert begin.wz == pytest.approx(speed * tan(begin.front) / 0.32, rel=1e-3)
    assert begin.front == pytest.approx(0.3, abs=0.2)  # the tricycle's servo turns its wheel itself


def test_a_synchro_drive_keeps_its_heading(field):
    driver = field(truck=SimTruckConfig(body=SynchroBody(kind="synchro"), **IDEAL))
    driver.steer(0.2, 0.0)
    begin, end = roll(driver, 0.2)
    assert begin.rear == begin.front > 0.1
    assert end.yaw == begin.yaw == 0.0
    assert (end.y - begin.y) / (end.x - begin.x) == pytest.approx(tan(begin.front), rel=1e-3)


def test_every_motor_has_its_own_noise_and_load(field):
    driver = field(truck=SimTruckConfig(body=DifferentialBody(kind="differential")), noise=True)
    roll(driver, 0.2, 0.0)
    left, right = (motor.reading(driver.now) for motor in driver.world.motors)
    assert abs(left.current_ma) > 100 > abs(right.current_ma)
    assert driver.world.truth(driver.now).motor_current * 1000 == pytest.approx(
        -(left.current_ma + right.current_ma), abs=60
    )


# Single-track dynamics


def circle(field, speed, **more):
    driver = field(truck=SimTruckConfig(**(IDEAL | more)))
    driver.steer(0.3, -0.1)
    driver.drive(speed, 50_000)
    return driver, driver.wait(3.0)


def test_slowly_the_single_track_model_rolls(field):
    _, rolled = circle(field, 0.04)
    _, tyres = circle(field, 0.04, dynamics="single_track")
    assert (tyres.x, tyres.y, tyres.yaw) == pytest.approx((rolled.x, rolled.y, rolled.yaw), abs=1e-9)


def test_soft_front_tyres_understeer_by_the_models_gradient(field):
    front, rear = 3.0, 60.0
    driver, rolled = circle(field, 0.2)
    driver, tyres = circle(field, 0.2, dynamics="single_track", front_stiffness=front, rear_stiffness=rear)
    vx = (tyres.v**2 - driver.world._plant._twist[1] ** 2) ** 0.5
    gradient = 7.25 * (0.16 * rear - 0.16 * front) / (0.32 * front * rear)
    assert tyres.wz < 0.95 * rolled.wz
    assert tyres.wz == pytest.approx(vx * (0.3 + 0.1) / (0.32 + gradient * vx**2), rel=0.03)


def test_inertia_delays_the_turn(field):
    rates = {}
    for inertia in (0.2, 20.0):
        driver = field(truck=SimTruckConfig(dynamics="single_track", yaw_inertia=inertia, **IDEAL))
        driver.steer(0.0, 0.0)
        driver.drive(0.2, 50_000)
        driver.wait(2.0)
        driver.steer(0.3, -0.3)
        rates[inertia] = driver.wait(0.2).wz
        assert driver.wait(4.0).wz == pytest.approx(0.39, abs=0.05)
    assert rates[20.0] < 0.6 * rates[0.2]


def test_tyres_with_inertia_stop_at_a_wall(field):
    driver = field(truck=SimTruckConfig(dynamics="single_track", **IDEAL), walls=[(0.6, -1.0, 0.7, 1.0)])
    driver.steer(0.0, 0.0)
    driver.drive(0.2)
    truth = driver.wait(5.0)
    assert truth.stuck
    assert truth.v == 0.0


@pytest.mark.parametrize("kind", ["differential", "mecanum", "synchro"])
def test_bodies_without_steered_axles_have_no_single_track(kind):
    with pytest.raises(ValidationError, match=f"body {kind} has no steered axles for curves"):
        SimTruckConfig.model_validate({"body": {"kind": kind}, "dynamics": "single_track"})


def test_impossible_bodies_are_refused():
    with pytest.raises(ValidationError, match=r"icr_x is 0\.2: expected -0\.32 to 0"):
        SimTruckConfig.model_validate({"body": {"kind": "skid_steer", "icr_x": 0.2}})
