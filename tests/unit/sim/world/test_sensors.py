"""What lidar and compass report against what is there."""

from math import degrees, pi, radians

import numpy as np
import pytest

from monstertruck_drivers.emulation import RangeSheet
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import (
    BatteryModelConfig,
    CompassModelConfig,
    Iron,
    LidarConfig,
    SinusoidTilt,
    WorldConfig,
)
from monstertruck_sim.world.obstacles import Box, Disc
from monstertruck_sim.world.sensors import FAILED, NO_RETURN, TOO_NEAR
from monstertruck_sim.world.world import World

ANGLES = (np.arange(769) - 384) * 2 * pi / 1024
WALLS = [(-2.05, -2.05, 2.05, -2.0), (-2.05, 2.0, 2.05, 2.05), (-2.05, -2, -2, 2), (2.0, -2, 2.05, 2)]


def box_ranges(x, y, yaw):
    """Distances to the walls of the 4 m square room, in closed form."""
    c, s = np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)
    c, s = np.where(abs(c) < 1e-12, 1e-12, c), np.where(abs(s) < 1e-12, 1e-12, s)
    return np.minimum((np.where(c > 0, 2, -2) - x) / c, (np.where(s > 0, 2, -2) - y) / s)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.5, -0.3, 2.1)])
def test_scan_at_rest_shows_the_room(field, pose):
    driver = field(walls=WALLS, start=pose)
    scan = driver.world.lidar.scan(driver.now)
    assert scan.shape == (769,)
    assert scan.dtype == np.int32
    lidar = (pose[0] + 0.14 * np.cos(pose[2]), pose[1] + 0.14 * np.sin(pose[2]), pose[2])
    np.testing.assert_allclose(scan[44:726], box_ranges(*lidar)[44:726] * 1000, atol=0.51)
    assert set(scan[:44]) | set(scan[726:]) == {FAILED}


def test_every_beam_leaves_from_where_the_truck_is_then(field):
    for wait_before_asking in (0.0, 0.15):
        driver = field(walls=WALLS)
        driver.steer(0.4, -0.4)
        driver.drive(0.2)
        driver.wait(2)
        began = driver.now
        trail = []
        for k in range(769):
            driver.now = began + k * 97_656
            if wait_before_asking:
                trail.append(driver.world.truth(driver.now))
        if not wait_before_asking:
            driver.now = began
            scan = driver.world.lidar.scan(began)
            continue
        driver.wait(0.05)
        late_scan = driver.world.lidar.scan(began)
    want = np.array(
        [box_ranges(t.x + 0.14 * np.cos(t.yaw), t.y + 0.14 * np.sin(t.yaw), t.yaw)[k] for k, t in enumerate(trail)]
    )
    np.testing.assert_allclose(late_scan[44:726], want[44:726] * 1000, atol=1.5)
    np.testing.assert_allclose(scan[44:726], want[44:726] * 1000, atol=2.5)  # extrapolated
    frozen = box_ranges(
        trail[0].x + 0.14 * np.cos(trail[0].yaw), trail[0].y + 0.14 * np.sin(trail[0].yaw), trail[0].yaw
    )
    assert np.abs(frozen - want)[44:726].max() > 0.02  # the distortion is there


def test_asking_early_does_not_bind_the_future(field):
    driver = field()
    driver.world.lidar.scan(driver.now)
    assert driver.world.truth(driver.now).time_ns == driver.now


def test_noise_follows_the_data_sheet(field):
    driver = field(walls=WALLS, noise=True)
    clean = box_ranges(0.14, 0.0, 0.0)
    errors = []
    for _ in range(60):
        driver.wait(0.1)
        scan = driver.world.lidar.scan(driver.now).astype(float)
        scan[scan < 20] = np.nan
        errors.append(scan / 1000 - clean)
    errors = np.array(errors)[:, 44:726]
    bound = np.maximum(0.01, 0.01 * clean[44:726])
    scaled = errors / bound
    assert np.nanstd(scaled) == pytest.approx(0.5, rel=0.03)
    assert abs(np.nanmean(scaled)) < 0.02
    assert np.isnan(errors).mean() == pytest.approx(0.002, abs=0.001)


def test_noise_belongs_to_the_instant_not_to_the_asking(field):
    scans = []
    for extra in (False, True):
        driver = field(walls=WALLS, noise=True, seed=4)
        driver.wait(1)
        if extra:
            driver.world.lidar.scan(driver.now - 200_000_000)
            driver.world.compass.compass(driver.now)
        scans.append(driver.world.lidar.scan(driver.now))
    np.testing.assert_array_equal(*scans)
    other = field(walls=WALLS, noise=True, seed=5)
    other.wait(1)
    assert (other.world.lidar.scan(other.now) != scans[0]).any()


def test_error_codes(field):
    driver = field(lidar=LidarConfig(first_step=43))
    driver.world.add(driver.now, Disc(0.14 + 0.115, 0.0, 0.1))
    scan = driver.world.lidar.scan(driver.now)
    assert scan[384] == TOO_NEAR
    assert scan[384 + 300] == NO_RETURN
    assert scan[42] == FAILED
    assert scan[43] == NO_RETURN


def test_obstacles_come_and_go(field):
    driver = field(walls=WALLS)
    box = Box(1.2, 0.0, 0.2, 0.2)
    before = driver.world.lidar.scan(driver.now)
    driver.world.add(driver.now, box)
    seen = driver.world.lidar.scan(driver.now)
    driver.world.remove(driver.now, box)
    assert seen[384] == pytest.approx(960, abs=1)
    assert before[384] == 1860
    np.testing.assert_array_equal(driver.world.lidar.scan(driver.now), before)


def test_nose_down_sees_the_ground_nose_up_passes_over_walls(field):
    driver = field(walls=WALLS)
    driver.world.set_tilt(driver.now, SinusoidTilt(kind="sinusoid", pitch_deg=14, frequency=0.25))
    driver.wait(1)  # quarter period: nose down
    down = driver.world.lidar.scan(driver.now)
    assert down[384] == pytest.approx(250 / np.sin(radians(14)), rel=0.01)
    driver.wait(2)
    up = driver.world.lidar.scan(driver.now)
    assert up[384] == NO_RETURN
    assert up[384 + 256] == pytest.approx(2000, abs=5)  # level sideways


@pytest.mark.parametrize(("yaw", "heading"), [(0.0, 90.0), (pi / 2, 0.0), (pi, 270.0), (-pi / 2, 180.0), (0.3, 72.811)])
def test_heading_is_clockwise_from_north(field, yaw, heading):
    reading = field(start=(0.0, 0.0, yaw)).world.compass.compass(7_000_000_000)
    assert (reading.heading_deg - heading + 180) % 360 - 180 == pytest.approx(0, abs=1e-3)
    assert reading.acceleration == (0, 0, 1)


def test_north_offset(field):
    driver = field(compass=CompassModelConfig(north_yaw=pi / 2 + radians(10)))
    assert driver.world.compass.compass(driver.now).heading_deg == pytest.approx(100)


def test_heading_survives_tilt_and_vectors_agree(field):
    driver = field(
        start=(0.0, 0.0, 1.0),
        tilt=SinusoidTilt(kind="sinusoid", pitch_deg=15, roll_deg=10),
        compass=CompassModelConfig(horizontal_field=250, vertical_field=-390),
    )
    down = np.array([0.0, 0.0, -1.0])
    signs = set()
    for _ in range(40):
        truth = driver.wait(0.07)
        reading = driver.world.compass.compass(driver.now)
        assert reading.heading_deg == pytest.approx(90 - degrees(1.0), abs=1e-6)
        assert reading.pitch_deg == pytest.approx(-degrees(truth.pitch))
        assert reading.roll_deg == pytest.approx(degrees(truth.roll))
        up, field_vector = np.array(reading.acceleration), np.array(reading.field)
        assert np.linalg.norm(up) == pytest.approx(1)
        assert np.linalg.norm(field_vector) == pytest.approx(np.hypot(250, 390))
        assert field_vector @ up == pytest.approx(-390)
        assert np.sign(up[0]) == np.sign(reading.pitch_deg)  # as in the maker's sample sentence
        assert np.sign(up[1]) == np.sign(reading.roll_deg)
        signs.add((np.sign(up[0]), np.sign(up[1])))
    assert len(signs) == 4
    assert down @ up < 0


def test_the_accelerometer_feels_the_drive(field):
    driver = field()
    driver.drive(0.5, acceleration=30_000.0)
    driver.wait(0.5)
    first, reading = driver.world.truth(driver.now), driver.world.compass.compass(driver.now)
    gained = (driver.wait(0.01).v - first.v) / 0.01
    assert gained > 0.2
    assert reading.acceleration[0] * 9.81 == pytest.approx(gained, rel=0.3)
    assert reading.pitch_deg == pytest.approx(degrees(np.arctan(gained / 9.81)), rel=0.3)
    driver.wait(5)
    assert driver.world.compass.compass(driver.now).pitch_deg == pytest.approx(0.0, abs=0.01)
    driver.steer(0.4, -0.4)
    truth = driver.wait(2)
    reading = driver.world.compass.compass(driver.now)
    assert reading.acceleration[1] * 9.81 == pytest.approx(truth.v * truth.wz, rel=0.02)
    assert reading.roll_deg == pytest.approx(degrees(np.arctan(truth.v * truth.wz / 9.81)), rel=0.02)


def test_a_ramp_ahead_is_seen_as_geometry(field):
    world = World(WorldConfig(map="ramp", noise=False), seed=1)
    scan = world.lidar.scan(0)
    foot, lidar, rise = 1.0, 0.14, np.tan(radians(8))
    assert LidarConfig().height > 0.2108, "the landing is below the scanning plane"
    low = World(WorldConfig(map="ramp", noise=False, lidar=LidarConfig(height=0.15)), seed=1).lidar.scan(0)
    assert scan[384] == NO_RETURN
    assert low[384] == pytest.approx((foot + 0.15 / rise - lidar) * 1000, abs=2)
    down = World(WorldConfig(map="ramp", noise=False, start=Pose2D(x=1.75, y=0.0, yaw=pi)), seed=1).lidar.scan(0)
    height = 0.25 + (1.75 - foot) * rise - 0.14 * rise  # of the lidar, over the level ground
    assert down[384] == pytest.approx(
        1000 * min(height / np.sin(radians(8)), (1.75 + 1.0 - 0.14) / np.cos(radians(8))), abs=15
    )


def test_compass_error_is_smooth_fixed_and_below_half_a_degree(field):
    errors = []
    for yaw in np.linspace(-3, 3, 25):
        driver = field(start=(0.0, 0.0, float(yaw)), noise=True, compass=CompassModelConfig(noise_deg=0.0))
        heading = driver.world.compass.compass(driver.now).heading_deg
        errors.append((heading - (90 - degrees(yaw)) + 180) % 360 - 180)
    errors = np.array(errors)
    assert 0.2 < np.abs(errors).max() <= 0.41
    assert np.abs(np.diff(errors)).max() < 0.2


def test_compass_noise(field):
    driver = field(noise=True)
    headings, pitches = [], []
    for _ in range(300):
        driver.wait(0.05)
        reading = driver.world.compass.compass(driver.now)
        headings.append(reading.heading_deg)
        pitches.append(reading.pitch_deg)
    assert np.std(headings) == pytest.approx(0.1, rel=0.2)
    assert np.std(pitches) == pytest.approx(0.1, rel=0.2)
    assert 0.01 < abs(np.mean(pitches)) < 0.25


def test_motor_current_and_iron_disturb_the_heading(field):
    driver = field(start=(0.0, 0.0, pi / 2), walls=[(-2, 0.5, 2, 0.6)], compass=CompassModelConfig(motor_field=20.0))
    driver.drive(0.2)
    driver.wait(4)  # against the wall: 0.5 A
    truth = driver.world.truth(driver.now)
    north = pi / 2 - truth.yaw
    want = degrees(np.arctan2(250 * np.sin(north) + 20 * truth.motor_current, 250 * np.cos(north)))
    assert want > 1.5
    assert driver.world.compass.compass(driver.now).heading_deg == pytest.approx(want, rel=1e-6)
    iron = field(start=(0.0, 0.0, pi / 2), compass=CompassModelConfig(iron=Iron(hard_y=25.0, soft_x=0.5)))
    reading = iron.world.compass.compass(iron.now)
    assert reading.field == pytest.approx((125, 25, -390))
    assert reading.heading_deg == pytest.approx(degrees(np.arctan2(25, 125)))
    skewed = field(start=(0.0, 0.0, pi / 2), compass=CompassModelConfig(iron=Iron(soft_xy=0.1)))
    assert skewed.world.compass.compass(skewed.now).field == pytest.approx((250, 25, -390))


def test_the_ground_wire_offsets_the_battery_input(field):
    volts = [
        field(battery=BatteryModelConfig(analog_offset=offset)).world.servos.analog_volts(5, 8 * 10**9)
        for offset in (0.0, 0.02)
    ]
    assert volts[1] - volts[0] == pytest.approx(0.02)


def test_readings_have_the_controllers_sign(field):
    driver = field()
    driver.world.motors[0].command(driver.now, 3000.0, 1e5)
    truth = driver.wait(1)
    reading = driver.world.motors[0].reading(driver.now)
    assert truth.v < 0  # inverted: the controller's positive sense is backwards
    assert reading.turns > 0
    assert reading.rpm == pytest.approx(3000, rel=1e-3)
    assert reading.current_ma > 0


def test_current_and_analog_noise(field):
    driver = field(noise=True)
    driver.drive(0.0)
    currents, volts = [], []
    for _ in range(300):
        driver.wait(0.05)
        currents.append(driver.world.motors[0].reading(driver.now).current_ma)
        volts.append(driver.world.servos.analog_volts(5, driver.now))
    assert np.std(currents) == pytest.approx(10, rel=0.2)
    assert np.std(volts) == pytest.approx(0.003, rel=0.2)
    assert driver.world.motors[0].reading(driver.now).current_ma == currents[-1]  # the same instant, the same draw


def test_beams_of_any_scanner_meet_the_room_and_keep_to_its_data_sheet(field):
    driver = field(walls=WALLS)
    bearings = np.linspace(np.pi, -np.pi, 500)
    times = driver.now + np.arange(500) * 200_000
    reach = RangeSheet(0.02, 2.3, 0.03, 0.01)
    ranges = driver.world.lidar.beams(bearings, times, reach)
    c, s = np.cos(bearings), np.sin(bearings)
    true = np.minimum((np.where(c > 0, 2, -2) - 0.14) / c, np.where(s > 0, 2, -2) / np.where(s == 0, 1e-12, s))
    np.testing.assert_allclose(ranges, np.where(true <= 2.3, true, np.inf), atol=1e-6)


def test_the_errors_of_beams_are_those_of_the_data_sheet():
    config = WorldConfig(map="workshop", lidar=LidarConfig(dropout=0.1, max_range=8.0))
    noisy, exact = World(config, 1), World(config.model_copy(update={"noise": False}), 1)
    bearings, times = np.linspace(-np.pi, np.pi, 400), 10**9 + np.arange(400) * 10_000
    sheet = RangeSheet(0.02, 30.0, 0.04, 0.0)
    first, again, true = (world.lidar.beams(bearings, times, sheet) for world in (noisy, noisy, exact))
    np.testing.assert_array_equal(first, again)
    assert (true[np.isfinite(true)] <= 8.0).all()
    off = (first - true)[np.isfinite(true) & np.isfinite(first)]
    assert off.std() == pytest.approx(0.02, rel=0.2)
    assert np.isnan(first).mean() == pytest.approx(0.1, abs=0.04)


def test_a_beam_that_meets_nothing_is_no_failure_whatever_the_errors_of_the_data_sheet():
    world = World(WorldConfig(map="workshop", lidar=LidarConfig(dropout=0.0, max_range=1.0)), 1)
    bearings, times = np.linspace(-np.pi, np.pi, 400), 10**9 + np.arange(400) * 10_000
    for relative in (0.0, 0.01):
        ranges = world.lidar.beams(bearings, times + round(relative * 10**11), RangeSheet(0.02, 30.0, 0.04, relative))
        assert np.isinf(ranges).any()
        assert not np.isnan(ranges).any()
