"""Paths that the body cannot drive: decided by metres, not by the angle at a vertex."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import PurePursuitConfig
from monstertruck_planners.track.drivable import bends, least_radius, require_drivable
from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.kit import Follower, circle, figure_eight, path, straight

GEOMETRY = FourWheelSteering()
PATHS = sorted((FilePath(__file__).parents[4] / "configs" / "paths").glob("*.csv"))


def require(route, **config):
    require_drivable(route, PurePursuitConfig(**config), GEOMETRY)


def corner(degrees):
    turn = math.radians(degrees)
    return [(0.0, 0.0), (2.0, 0.0), (2.0 + 2.0 * math.cos(turn), 2.0 * math.sin(turn))]


def arc(radius, degrees):
    turns = np.radians(np.arange(0.0, degrees + 1.0, 3.0))
    bend = radius * np.column_stack((np.sin(turns), 1.0 - np.cos(turns)))
    end = bend[-1] + 1.5 * np.array([math.cos(turns[-1]), math.sin(turns[-1])])
    return np.vstack(([-1.5, 0.0], bend, end))


def sideways(length):
    return np.vstack((straight(2.0), straight(2.0) + np.array([2.05, length])))


@pytest.mark.parametrize("file", PATHS, ids=lambda file: file.stem)
def test_shipped_paths_are_accepted(file):
    require(load_path(file, closed=file.stem in ("circuit", "loop")))


@pytest.mark.parametrize(
    "route",
    [
        path(circle(1.0), closed=True),
        path(figure_eight(1.0), closed=True),
        path(corner(90)),
        path([(0, 0), (2, 0), (2, 2), (0, 2)], closed=True),
        path(arc(0.2, 60)),
        path(arc(0.38, 360)),
        path(np.vstack((straight(), straight()[::-1])), [1.0] * 41 + [-1.0] * 41),
        path(corner(170), steering=["crab"] * 3),
    ],
    ids=["circle", "eight", "corner", "square", "short bend", "slightly tight", "cusp", "translation"],
)
def test_what_a_tracker_rounds_is_accepted(route):
    require(route)


def test_a_fold_without_a_cusp_is_refused_with_its_place():
    with pytest.raises(
        InputError, match=r"pose 40 at 2\.00, 0\.00 m: .* by 180 degrees in 0\.00 m; .* 0\.42 m, leaves"
    ):
        require(path(np.vstack((straight(), straight()[-2::-1]))))


def test_a_radius_below_the_bodys_is_refused():
    with pytest.raises(InputError, match=r"180 degrees in 0\.63 m \(radius 0\.20 m\)"):
        require(path(arc(0.2, 180)))
    for lap in (circle(0.2), figure_eight(0.7)):
        with pytest.raises(InputError, match=r"leaves it by"):
            require(path(lap, closed=True))
    require(path(arc(0.2, 180)), path_tolerance=0.5)


def test_a_lap_is_examined_where_it_closes():
    with pytest.raises(InputError, match=r"pose 40 at 2\.00"):
        require(path(straight(), closed=True))


def test_a_jump_to_the_side_is_refused_where_headings_contradict_it():
    with pytest.raises(InputError, match=r"pose 40 at 2\.00, 0\.00 m: the path jumps 2\.00 m to the side"):
        require(path(sideways(2.0)))
    require(path(sideways(0.1)))


@pytest.mark.parametrize(("degrees", "accepted"), [(60, True), (90, True), (110, False), (135, False)])
def test_the_least_deviation_is_what_pure_pursuit_shows(degrees, accepted):
    route = path(corner(degrees))
    found = list(bends(route, PurePursuitConfig(path_tolerance=0.01), GEOMETRY))
    follower = Follower(route)
    while follower.step().outcome is Reason.DRIVING:
        pass
    off = max(abs(command.cross_track) for command in follower.log)
    (bend, radius), *_ = found
    assert radius == pytest.approx(0.42, abs=0.005)
    assert bend.deviation <= off + 0.01  # the truck's axles take time
    assert (off < 0.15) is accepted
    assert (bend.deviation < 0.15) is accepted


def test_front_steering_has_twice_the_radius():
    assert least_radius("front", 0.362, GEOMETRY) == pytest.approx(2 * least_radius("hybrid", 0.362, GEOMETRY))
    with pytest.raises(InputError, match=r"minimum radius of 0\.85 m"):
        require(path(arc(0.5, 180)), steering="front")
    require(path(arc(0.5, 180)))
