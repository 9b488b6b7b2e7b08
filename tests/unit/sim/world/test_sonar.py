"""What simulated sonars hear against geometry, and what an IMU feels."""

from math import cos, inf, pi, sin, tan

import numpy as np
import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import FIVE_SONARS, ImuModelConfig, SonarModelConfig, SonarPlace
from monstertruck_sim.world.obstacles import Disc, discs_and_segments
from monstertruck_sim.world.raycast import cast_rays, clearance
from monstertruck_sim.world.sonar import SPEED_OF_SOUND, Ping, beam, cone, heard, leaning, placed, surface
from tests.sonar_kit import survey

SECOND = 1_000_000_000
EMPTY = clearance(np.zeros((2, 2), np.bool_))
CONE = SonarModelConfig(critical_angle=0.45)
BEAM = SonarModelConfig(model="beam")


def walls(*segments, discs=()):
    """A caster of exact segments and discs (x, y, radius)."""
    lines = np.array(segments, dtype=float).reshape(-1, 4)
    round_ones, _ = discs_and_segments(Disc(*disc) for disc in discs)

    def cast(xs, ys, angles, reach):
        return cast_rays(EMPTY, 0.05, 100.0, 100.0, xs, ys, angles, reach, round_ones, lines)

    return cast


def alone(cast, ping, model=CONE):
    return cone([surface(cast, ping, model)], ping, model)


WALL = (-50.0, 0.3, 50.0, 0.3)


@pytest.mark.parametrize("angle", [-0.3, 0.0, 0.2, 0.43])
def test_a_cone_measures_the_perpendicular_to_a_wall_within_it(angle):
    assert alone(walls(WALL), Ping(0, 0, pi / 2 + angle)) == pytest.approx(0.3, abs=1e-4)
    assert beam(walls(WALL), Ping(0, 0, pi / 2 + angle), BEAM) == pytest.approx(0.3 / cos(angle))


def test_a_cone_that_does_not_hold_the_perpendicular_sees_the_wall_up_to_the_critical_angle():
    at_45 = alone(walls(WALL), Ping(0, 0, pi / 4))
    assert at_45 == pytest.approx(0.3 / cos(pi / 4 - 0.435), rel=1e-3), "its edge ray, 20 degrees from the normal"
    assert alone(walls(WALL), Ping(0, 0, pi / 4), CONE.model_copy(update={"critical_angle": 0.3})) == inf


def test_corners_and_posts_come_back_whatever_the_angle():
    corner = walls((1.0, -3.0, 1.0, 1.0), (1.0, 1.0, -3.0, 1.0))
    smooth = CONE.model_copy(update={"critical_angle": 0.3})
    assert alone(corner, Ping(0, 0, pi / 4), smooth) == pytest.approx(2**0.5, rel=0.02)
    assert alone(walls(discs=[(1.0, 0.2, 0.05)]), Ping(0, 0, 0.0)) == pytest.approx(1.04**0.5 - 0.05, abs=2e-3)
    edge = walls((0.5, 0.1, 0.5 + 3 * cos(1.2), 0.1 + 3 * sin(1.2)), (0.5, 0.1, 3.5, 0.1))
    assert alone(edge, Ping(0, 0, 0.0)) == pytest.approx(0.51, abs=0.03)


def test_walls_of_a_map_are_smooth_in_spite_of_their_cells():
    cells = np.zeros((400, 400), np.bool_)
    rows, columns = np.mgrid[:400, :400]
    cells[np.abs((columns - 200) * 0.025 + (rows - 200) * 0.025 - 1.2) < 0.08] = True
    none = np.zeros((0, 3)), np.zeros((0, 4))

    def cast(xs, ys, angles, reach):
        return cast_rays(clearance(cells), 0.025, -5.0, -5.0, xs, ys, angles, reach, *none)

    straight = 1.12 / 2**0.5
    assert alone(cast, Ping(0, 0, pi / 4)) == pytest.approx(straight, abs=0.03)
    assert alone(cast, Ping(0, 0, pi / 4 - 1.1), CONE.model_copy(update={"critical_angle": 0.3})) == inf


def test_limits_noise_and_drop_outs():
    model = SonarModelConfig(dropout=0.05)
    assert heard(0.1, model, None) == 0.15
    assert heard(3.01, model, None) == inf
    rng = np.random.default_rng(1)
    drawn = np.array([heard(1.0, model, rng) for _ in range(4000)])
    assert np.isinf(drawn).mean() == pytest.approx(0.05, abs=0.012)
    kept = drawn[np.isfinite(drawn)]
    assert kept.std() == pytest.approx(np.hypot(0.005, 0.01), rel=0.05)
    assert kept.mean() == pytest.approx(1.0, abs=1e-3)


def test_sound_of_a_neighbour_that_fires_at_the_same_time_is_taken_for_ones_own():
    here = walls((-5, 0.6, 5, 0.6))
    slanted, upright = Ping(0.0, 0.0, pi / 2 - 0.9), Ping(0.1, 0.0, pi / 2)
    listener = Ping(0.0, 0.0, pi / 2 - 0.3)
    both = [surface(here, p, CONE) for p in (listener, upright)]
    assert cone(both[:1], listener, CONE) == pytest.approx(0.6, abs=1e-3)
    far = [surface(here, p, CONE) for p in (slanted, upright)]
    own = cone(far[:1], slanted, CONE)
    assert cone(far, slanted, CONE) < own - 0.005, "the neighbour's sound came first"
    assert cone(far, slanted, CONE.model_copy(update={"cross_talk": False})) == own


def test_an_echo_from_beyond_the_range_meets_the_next_ping():
    far = walls((4.5, -5, 4.5, 5))
    gap = 0.02
    first, second = Ping(0, 0, 0.0, time=0.0), Ping(0, 0, 0.0, time=gap)
    found = [surface(far, first, CONE), surface(far, second, CONE)]
    assert alone(far, first) == inf
    assert cone(found, second, CONE) == pytest.approx(4.5 - gap * SPEED_OF_SOUND / 2, abs=1e-3)
    later = second._replace(time=0.1)
    assert cone([surface(far, first, CONE), surface(far, later, CONE)], later, CONE) == inf


def test_the_whole_ring_along_a_wall():
    ranges = survey(walls((-5, 0.35, 5, 0.35)), (0, 0, 0), CONE, None)
    assert ranges == {
        "l": pytest.approx(0.3, abs=1e-3),
        "fl": pytest.approx(0.3 / cos(pi / 4 - 0.435), abs=2e-3),
        **dict.fromkeys(("f", "r", "fr"), inf),
    }
    straight = survey(walls((-5, 0.35, 5, 0.35)), (0, 0, 0), BEAM, None)
    assert straight["fl"] == pytest.approx(0.3 / cos(pi / 4), rel=1e-4)


def test_fl_reads_at_a_parallel_wall_what_it_would_read_at_the_place_of_l():
    left, fl = (placed(FIVE_SONARS[name], 0, 0, 0) for name in ("l", "fl"))
    there = Ping(left.x, left.y, fl.yaw)
    assert beam(walls(WALL), fl, BEAM) == pytest.approx(beam(walls(WALL), there, BEAM))
    assert fl.x - left.x == pytest.approx(0.05)


def wall_ahead(xs, ys, angles, reach, times_ns=None, /):
    """Ranges to a wall at x = 2 m."""
    with np.errstate(divide="ignore"):
        ranges = np.where(np.cos(angles) > 0, (2.0 - xs) / np.cos(angles), np.inf)
    return np.where(ranges <= reach, ranges, np.inf)


def test_on_a_body_that_leans_the_axis_leans():
    here, ahead = np.zeros(1), np.zeros(1)
    assert leaning(wall_ahead, 0.0, 0.0, 0.0, 0.2) is wall_ahead
    up = leaning(wall_ahead, 0.0, -0.1, 0.0, np.inf)
    assert up(here, here, ahead, 3.0) == pytest.approx([2.0 / np.cos(0.1)])
    assert leaning(wall_ahead, 0.0, -0.1, 0.0, 0.21)(here, here, ahead, 3.0) < np.inf  # 0.2 m up at the wall
    assert leaning(wall_ahead, 0.0, -0.1, 0.0, 0.19)(here, here, ahead, 3.0) == np.inf
    assert leaning(wall_ahead, 0.0, 0.1, 0.0, 0.19)(here, here, ahead, 3.0) < np.inf  # nose down
    aside = np.full(1, np.pi / 4)
    rolled = leaning(wall_ahead, 0.0, 0.0, 0.2, np.inf)(here, here, aside, 6.0)
    assert rolled == pytest.approx([2.0 / np.cos(np.pi / 4)])  # the wall is along the axis of roll
    assert leaning(wall_ahead, 0.0, 0.0, 0.2, 0.1)(here, here, aside, 6.0) == np.inf  # the left side is up
    assert up(here, here, ahead, 2.005) == np.inf


def test_pings_leave_from_the_moving_robot_and_are_repeatable(field):
    def run(seed):
        driver = field(walls=[(2.0, -3.0, 2.1, 3.0)], seed=seed, noise=True)
        driver.drive(0.2)
        driver.wait(1.5)
        heard = []
        for _ in range(10):
            driver.wait(0.1)
            driver.world.sonars.fire("f", driver.now)
            driver.wait(0.03)
            heard.append(driver.world.sonars.range("f"))
        return heard

    ranges = run(1)
    assert ranges == run(1) != run(2)
    assert ranges[0] - ranges[-1] == pytest.approx(0.2 * 9 * 0.13, abs=0.08)


def test_a_sonar_that_the_robot_has_not(field):
    driver = field(sonar=SonarModelConfig(sonars={"f": SonarPlace(x=0.1, y=0, yaw=0)}))
    with pytest.raises(InputError, match=r"no sonar l in sim.world.sonar.sonars; known: f"):
        driver.world.sonars.fire("l", driver.now)
    assert driver.world.sonars.range("f") == inf


def test_the_range_limits_have_to_rise():
    with pytest.raises(ValueError, match="expected increasing values"):
        SonarModelConfig(range_min=3.0, range_max=2.0)


def test_an_imu_feels_turns_gravity_and_acceleration(field):
    driver = field()
    level = driver.world.imu.imu(driver.now)
    assert level.acceleration == (0.0, 0.0, 9.81)
    assert level.angular_velocity == (0.0, 0.0, 0.0)
    driver.steer(0.3, -0.3)
    driver.drive(0.2)
    driver.wait(2)
    turning, truth = driver.world.imu.imu(driver.now), driver.world.truth(driver.now)
    assert turning.angular_velocity[2] == truth.wz > 0.2 * 2 * tan(0.3) / 0.32 * 0.7
    assert turning.acceleration[1] == pytest.approx(truth.v * truth.wz, rel=0.1)


def test_an_imu_has_bias_and_noise_by_its_seed(field):
    def run(seed):
        driver = field(seed=seed, noise=True)
        return np.array([driver.wait(0.01) and driver.world.imu.imu(driver.now).angular_velocity for _ in range(500)])

    drawn = run(3)
    assert np.array_equal(drawn, run(3))
    assert not np.array_equal(drawn, run(4))
    config = ImuModelConfig()
    assert drawn.std(axis=0) == pytest.approx(config.rate_noise, rel=0.15)
    assert 0 < np.abs(drawn.mean(axis=0)).max() < config.rate_bias * 1.1
