"""Places of sonars from arcs beside a wall: what tells them, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.sensor import SonarEcho, SonarRanges
from monstertruck_schemas.state import Odometry
from monstertruckd.config.calibration import may_set
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.sonar import SonarLeg, SonarPose, result_of
from monstertruckd.tools.calibrate.steps import MoveRecord
from tests.calibration_light import sonar_legs

SETTINGS = Srf08Config()
PLACES = {n: SonarPose(*s.mount.planar) for n, s in SETTINGS.sonars.items()}
TURN = 3.3
WALL = 1.7


def legs(places=PLACES, seed=1):
    return sonar_legs(places, (WALL, 0.02), 0.43, 1.0, np.random.default_rng(seed), TURN)


def swapped(first, second):
    return {**PLACES, first: PLACES[second], second: PLACES[first]}


def test_all_places_and_no_other_key_are_found():
    result = result_of(legs(), SETTINGS, WALL, 0.002)
    assert {e.name for e in result.estimates} == {
        "cone", "speed_of_sound", *(f"{n}_{what}" for n in PLACES for what in ("x", "y", "yaw")),
    }  # fmt: skip
    assert all(e.key is not None and may_set("sonar", e.key) for e in result.estimates)
    assert not may_set("sonar", "devices.sonar.driver.sonars.l.address")
    assert not may_set("sonar", "devices.sonar.driver.sonars.l.x.mount.x")


@pytest.mark.parametrize(("first", "second"), [("l", "r"), ("fl", "fr"), ("l", "fl"), ("f", "r")])
def test_swapped_cables_are_named(first, second):
    with pytest.raises(
        InputError, match=f"{first} receives the echoes expected at {second}, {second} receives .* at {first}"
    ):
        result_of(legs(swapped(first, second)), SETTINGS, WALL, 0.002)


def test_a_wall_that_is_elsewhere_is_no_swap():
    with pytest.raises(InputError, match="too few echoes of the wall: check that it is mounted where configured"):
        result_of(legs(), SETTINGS, 2.6, 0.002)


def test_echoes_of_other_things_are_left_out():
    crowded = []
    for leg in legs():
        ranges = {n: np.where(np.arange(r.size) % 7 == 0, 0.5, r) for n, r in leg.ranges.items()}
        crowded.append(replace(leg, ranges=ranges))
    result = result_of(crowded, SETTINGS, WALL, 0.002)
    for name, place in PLACES.items():
        for what in ("x", "y", "yaw"):
            estimate = result.estimate(f"{name}_{what}")
            assert estimate is not None
            half = (estimate.high - estimate.low) / 2
            assert estimate.value == pytest.approx(getattr(place, what), abs=2 * half)
            assert half < 0.15


def test_pings_are_placed_where_the_robot_was_by_odometry():
    record = MoveRecord(left=3 * SECOND, arrived=9 * SECOND)
    header = {"received": 0, "seq": 1}
    covariance = tuple(np.eye(3).ravel())
    record.others[topics.ODOMETRY.name] = [
        Odometry(
            **header, stamp=k * SECOND, pose=Pose2D(x=2.0, y=1.0 + 0.1 * k, yaw=math.pi / 2),
            twist=Twist2D(vx=0.0, vy=0.0, wz=0.0), pose_covariance=covariance, twist_covariance=covariance, age=0.0,
        )
        for k in range(11)
    ]  # fmt: skip
    echoes = (
        SonarEcho(name="l", range=1.2, stamp=round(4.5 * SECOND)),
        SonarEcho(name="f", stamp=5 * SECOND),
        SonarEcho(name="r", answered=False, stamp=5 * SECOND),
    )
    record.others[topics.SONAR.name] = [
        SonarRanges(**header, stamp=5 * SECOND, sonars=echoes, field_of_view=0.8, range_min=0.1, range_max=3.0)
    ]
    leg = SonarLeg.of(record, (2.0, 1.0, math.pi / 2))
    assert leg.poses["l"][0] == pytest.approx((0.45, 0.0, 0.0))
    assert leg.ranges["l"] == pytest.approx([1.2])
    assert leg.ranges["f"][0] == math.inf
    assert "r" not in leg.poses


def test_short_arcs_and_too_few_echoes_are_refused():
    short = sonar_legs(PLACES, (WALL, 0.0), 0.43, 1.0, np.random.default_rng(1), 0.5)
    with pytest.raises(InputError, match="arcs of at least 1 rad"):
        result_of(short, SETTINGS, WALL, 0.002)
    deaf = [replace(leg, ranges={**leg.ranges, "f": np.full_like(leg.ranges["f"], np.inf)}) for leg in legs()]
    with pytest.raises(InputError, match="sonar f"):
        result_of(deaf, SETTINGS, WALL, 0.002)


def test_ranges_that_come_out_short_mean_a_faster_sound():
    circles = sonar_legs(PLACES, (WALL, 0.02), 0.43, 1.0, np.random.default_rng(1))
    short = [replace(leg, ranges={n: r / 1.01 for n, r in leg.ranges.items()}) for leg in circles]
    sound = result_of(short, SETTINGS, WALL, 0.002).estimate("speed_of_sound")
    assert sound is not None
    assert sound.value == pytest.approx(1.01 * SETTINGS.speed_of_sound, abs=2.5)


def test_a_heading_that_drifts_on_its_arcs_moves_no_sonar(monkeypatch):
    drifting_heading = ASSUMED.model_copy(update={"sonar_arc": (0.0, 0.0, 0.03)})
    monkeypatch.setattr("tests.calibration_light.ASSUMED", drifting_heading)
    drifting = sonar_legs(PLACES, (WALL, 0.02), 0.43, 1.0, np.random.default_rng(3))
    monkeypatch.undo()
    result = result_of(drifting, SETTINGS, WALL, 0.002)
    for name, place in PLACES.items():
        estimate = result.estimate(f"{name}_x")
        assert estimate is not None
        assert estimate.value == pytest.approx(place.x, abs=0.02)
        assert estimate.high - estimate.low < 0.04


def test_the_interval_of_the_sound_holds_wheels_that_roll_less_far_than_odometry_says(monkeypatch):
    """Loaded tyres: on circles of 0.8 m 0.5 % less look like ranges that come out too short."""
    certain_wheels = ASSUMED.model_copy(update={"sonar_scale": (0.01, 0.0)})
    monkeypatch.setattr("tests.calibration_light.ASSUMED", certain_wheels)
    circles = sonar_legs(PLACES, (WALL, 0.02), 0.43, 1.0, np.random.default_rng(3))
    monkeypatch.undo()
    longer = [replace(leg, poses={n: p * (1.005, 1.005, 1.0) for n, p in leg.poses.items()}) for leg in circles]
    first, second = (result_of(each, SETTINGS, WALL, 0.002).estimate("speed_of_sound") for each in (circles, longer))
    assert first is not None
    assert second is not None
    half = (second.high - second.low) / 2
    assert second.value - first.value < 0.6 * half, "0.9 of it if the distance were taken for right"
    assert half < 3.4
