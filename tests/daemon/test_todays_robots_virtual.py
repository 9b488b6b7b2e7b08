"""Robots that can be bought today, each whole: a lap of the circuit at top speed while it maps; virtual clock."""

from functools import cache
from typing import Any

import pytest

from benchmarks.robots import CROSS_TRACK, MAP_ERROR, MAPPING, configured, lap_of
from monstertruck_schemas.reasons import Reason

pytestmark = [pytest.mark.virtual, pytest.mark.long, pytest.mark.timeout(600)]

SPEEDS = {"turtle": 0.8, "truck_today": 1.5, "f1tenth": 3.0}


@cache
def lap(name: str) -> dict[str, Any]:
    return lap_of(name)


@pytest.mark.parametrize("name", MAPPING)
def test_it_drives_a_lap_at_its_top_speed_and_touches_nothing(name: str):
    assert configured(name).gate.speed == SPEEDS[name]
    drive = lap(name)
    assert drive["outcome"] == Reason.GOAL_REACHED.value
    assert drive["contacts"] == drive["stops"] == 0
    assert drive["fastest_m_s"] == pytest.approx(SPEEDS[name], rel=0.03)


@pytest.mark.parametrize("name", ["turtle", "truck_today"])
def test_it_keeps_to_its_path(name: str):
    assert lap(name)["cross_track_m"] <= CROSS_TRACK * SPEEDS[name]


@pytest.mark.parametrize("name", MAPPING)
def test_the_walls_of_its_map_are_true(name: str):
    assert lap(name)["wall_mean_m"] <= MAP_ERROR


@pytest.mark.parametrize("name", ["turtle", "f1tenth"])
def test_a_robot_without_a_compass_says_what_that_weakens(name: str):
    config = configured(name)
    assert config.devices.compass is config.devices.imu is None
    assert any(text.startswith("gate.attitude null") for text in config.weakened())
