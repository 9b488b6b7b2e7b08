"""Sonars computed from a lidar's scan, and a body that cannot turn on the spot following a wall by them."""

import math

import numpy as np
import pytest

from monstertruck_planners.behave.lidar_sonars import LidarSonarsConfig, sonars_of
from monstertruck_planners.behave.wall.config import WallPdConfig
from monstertruck_planners.behave.wall.published import WallPd
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from tests.unit.planners.behave.wall_kit import Robot, beam, drive, rectangle

MOUNT = (0.13, 0.0, 0.05)
HALL = rectangle(4.0, 2.2)


def scan_at(x, y, yaw, *, codes=None):
    angles = np.linspace(-2.09, 2.09, 683)
    c, s = math.cos(yaw), math.sin(yaw)
    px, py = x + c * MOUNT[0] - s * MOUNT[1], y + s * MOUNT[0] + c * MOUNT[1]
    ranges = np.array([beam(HALL, px, py, yaw + MOUNT[2] + a) or math.inf for a in angles])
    known = np.where(np.isfinite(ranges), VALID_BEAM, 0).astype(np.uint8)
    return LaserScan(
        stamp=1000, received=1000, seq=0, start_angle=-2.09, end_angle=2.09, time_increment=1e-4, scan_time=0.1,
        range_min=0.02, range_max=4.0, ranges=np.where(np.isfinite(ranges), ranges, np.inf),
        codes=known if codes is None else np.full(683, codes, np.uint8),
    )  # fmt: skip


@pytest.mark.parametrize("yaw", [0.0, 0.5, -2.0])
def test_they_measure_what_beams_from_their_places_would(yaw):
    config = LidarSonarsConfig()
    for echo in sonars_of(scan_at(-0.3, 0.2, yaw), MOUNT, config):
        place, (c, s) = config.sonars[echo.name], (math.cos(yaw), math.sin(yaw))
        true = beam(HALL, -0.3 + c * place.x - s * place.y, 0.2 + s * place.x + c * place.y, yaw + place.yaw)
        assert echo.answered
        assert echo.range == pytest.approx(true, abs=0.003)
        assert echo.stamp >= 1000


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("seam", [0.0, math.pi, 1.0])
def test_a_lidar_of_a_full_turn_measures_across_its_seam_and_either_way(seam, sense):
    angles = seam + sense * np.arange(450) * math.tau / 450
    ranges = np.array([beam(HALL, -0.17, 0.2, a) or math.inf for a in angles])
    message = scan_at(0.0, 0.0, 0.0).model_copy(
        update={
            "start_angle": angles[0],
            "end_angle": angles[-1],
            "ranges": ranges,
            "codes": np.full(450, VALID_BEAM, np.uint8),
        }
    )
    config = LidarSonarsConfig()
    for echo in sonars_of(message, (0.13, 0.0, 0.0), config):
        place = config.sonars[echo.name]
        assert echo.range == pytest.approx(beam(HALL, -0.3 + place.x, 0.2 + place.y, place.yaw), abs=0.003)


@pytest.mark.parametrize(("code", "answered"), [(0, True), (7, False)])
def test_beams_without_an_echo_are_free_and_beams_with_an_error_are_no_answer(code, answered):
    echoes = sonars_of(scan_at(0.0, 0.0, 0.0, codes=code), MOUNT, LidarSonarsConfig())
    assert {(echo.range, echo.answered) for echo in echoes} == {(None, answered)}


def test_a_sonar_that_looks_where_the_lidar_does_not_has_not_answered():
    config = LidarSonarsConfig.model_validate({"sonars": {"back": {"x": -0.2, "yaw": math.pi}}}, strict=False)
    (echo,) = sonars_of(scan_at(0.0, 0.0, 0.0), MOUNT, config)
    assert not echo.answered


def test_a_body_that_cannot_turn_on_the_spot_turns_away_along_its_tightest_arc():
    tightest = 2.9
    config = WallPdConfig(offset=0.05, trigger=0.75, seen=0.6, free=1.0, aligned=0.0, safety=0.25, lap_length=6.0)
    run = drive(WallPd(config, tightest), Robot(rectangle(6.0, 5.0), (0.0, 1.9, 0.0), ahead=0.05), 180.0)
    motions = run.motions()
    assert run.outcome is Reason.BEHAVIOUR_DONE
    assert run.clearance > 0.15
    assert (np.abs(motions[:, 1]) <= tightest * motions[:, 0] + 1e-9).all()
